"""The alternation of AdaAfford: rollouts, the prior, AAP, AIP, a policy; then rollouts of that policy, and so on.

    collect-random, train-prior,
    train-aap-1, train-aip-1, publish-1,
    collect-aip-1, train-aap-2, train-aip-2, publish-2, ...

`alternation` is this order. `perform` does one of its steps. Where the rollouts come from is up to `Rollouts`: a store
that grows no more (`Finished`), collectors that work beside the learner (`learner.rounds`), or a campaign, which
collects them itself (`cluster.campaign.campaign`).

RUN/ of `alternate`
    prior/, aap-1/, aip-1/, aap-2/, ...   one folder a training (see `learner.stages.jobs`), each resumable by itself
    alternation.json                      the rounds, which of them is the best, and why they ended; written last
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, Field

from learner.settings import PUBLISHED_FILE, AlternationConfig, LearnerConfig
from learner.stages.jobs import DONE_FILE, MAX_DONE_BYTES, Memory, StageJob, StageName, read_done, run_stage
from learner.training import data_parallel
from learner.training.checkpoint import refuse_foreign
from learner.training.hardware import Hardware
from shared.errors import StoreError, UsageError
from shared.io.documents import read_document
from shared.io.files import make_folder, write_atomically
from shared.plan import parse_plan_key
from shared.policies.methods import BaselineName
from shared.store.store import Store

ALTERNATION_FILE = "alternation.json"
ADOPTED = "adopted"
"""Folder of a policy that stands in the place of the first round's."""
LEAVES = rf"prior|{ADOPTED}|(aap|aip)-\d+|data-\d+\.json|{re.escape(PUBLISHED_FILE)}|{re.escape(ALTERNATION_FILE)}"
"""Names in the folder of an alternation; the first is there as soon as it trains or waits."""


@dataclass(frozen=True, slots=True)
class AlternationStep:
    """One step of an alternation, or of what is around it.

    Attributes:
        name: unique, and the same in every attempt: what a run's log calls it.
    """

    name: str


@dataclass(frozen=True, slots=True)
class Collect(AlternationStep):
    """Rollouts whose interactions policy `version` proposed; 0 stands for random ones."""

    version: int

    @property
    def proposer(self) -> str:
        """Who proposes."""
        return "aip" if self.version else "random"


@dataclass(frozen=True, slots=True)
class Train(AlternationStep):
    """The training of one network.

    Attributes:
        network: which one.
        round: from 1; 0 is the prior.
        folder: what the folder is called that gets the policy.
        init: the folder of the policy that it starts from; None: whatever the alternation itself starts from.
    """

    network: StageName
    round: int
    folder: str
    init: str | None


@dataclass(frozen=True, slots=True)
class Publish(AlternationStep):
    """The policy in `folder` becomes version `version`, which proposes from then on."""

    version: int
    folder: str


def alternation(
    goes_on: Callable[[int], bool], *, adopts: bool = False, baselines: Sequence[BaselineName] = ()
) -> Iterator[AlternationStep]:
    """The steps of an alternation, in order.

    Args:
        goes_on: whether another round follows when so many have been trained.
        adopts: whether a policy is there that stands in the place of the first round's.
        baselines: networks that are added to the last policy.
    """

    def train(network: StageName, number: int, folder: str, init: str | None) -> Train:
        return Train(f"train-{folder}", network, number, folder, init)

    yield Collect("collect-random", 0)
    yield AlternationStep("adopt") if adopts else train("prior", 0, "prior", None)
    left, number, more = ADOPTED if adopts else "prior", 0, True
    while more:
        number += 1
        if number > 1:
            yield Collect(f"collect-aip-{number - 1}", number - 1)
        if number > 1 or not adopts:
            yield train("aap", number, f"aap-{number}", left)
            yield train("aip", number, f"aip-{number}", f"aap-{number}")
            left = f"aip-{number}"
        more = goes_on(number)
        for name in () if more else baselines:
            yield train(name, number, name, left)
            left = name
        yield Publish(f"publish-{number}", number, left)


class Rollouts(Protocol):
    """Where the rollouts of an alternation come from, and where its policies go."""

    def collect(self, step: Collect) -> Mapping[str, Any]:
        """See that the rollouts of a policy version are there; returns what to note of it."""
        ...

    def job(self, number: int) -> StageJob:
        """What round `number` learns from, the prior being 0; `out` is the folder around those of all trainings."""
        ...

    def publish(self, step: Publish) -> Mapping[str, Any]:
        """Take a policy; returns what to note of it."""
        ...


def perform(step: AlternationStep, rollouts: Rollouts, train: Callable[[StageJob], object]) -> Mapping[str, Any]:
    """Do one step of an alternation, which may have been done before; returns what to note of it.

    Args:
        step: of `alternation`.
        rollouts: where they come from.
        train: runs a training, or goes on with it, or finds it done.
    """
    match step:
        case Collect():
            return rollouts.collect(step)
        case Publish():
            return rollouts.publish(step)
        case Train(network=network, folder=folder):
            job = rollouts.job(step.round)
            init = job.init if step.init is None else job.out / step.init
            train(replace(job, stage=network, out=job.out / folder, init=init))
            return {"policy_folder": f"{job.out.name}/{folder}"}
    raise ValueError(f"'{step.name}' is no step of an alternation")


class Finished(Rollouts):
    """`Rollouts` of a store that grows no more; policies stay in their folders.

    Where the store holds rollouts that policies proposed, round V of training learns from what versions below V
    proposed, as a campaign would have had it (AdaAfford, Training Strategy); later rounds, from all rows.

    Args:
        job: the store and the learner's folder.

    Attributes:
        out: the learner's folder.
        at_least: rounds that it takes to have learnt from all that is there.
    """

    def __init__(self, job: StageJob) -> None:
        refuse_foreign(job.out, LEAVES)
        self._job, self.out = job, job.out
        self._store = Store.open(job.store)
        # By the names of shards, which say it also where the file of a plan was lost.
        self._newest = max((parse_plan_key(each.plan_key)[1] for each in self._store.jobs()), default=0)
        self.at_least = self._newest + 1

    def collect(self, step: Collect) -> Mapping[str, Any]:
        return {}

    def job(self, number: int) -> StageJob:
        return replace(self._job, newest_policy=number - 1) if 1 <= number <= self._newest else self._job

    def publish(self, step: Publish) -> Mapping[str, Any]:
        return {}


def alternate(rollouts: Finished, config: LearnerConfig, hardware: Hardware | None = None) -> Path:
    """Train rounds until they bring no more, or go on with them after a kill; returns the folder of the best policy.

    A round counts if it lowers the best validation loss of AAP by more than `config.alternation.improvement` of it. The
    rounds end when `patience` of them in a row did not count and every round of the store has been learnt from.

    Raises:
        UsageError: see `run_stage`.
        StoreError: see `run_stage`.
    """
    memory, out = Memory(), rollouts.out
    make_folder(out)
    scores: list[float] = []

    def goes_on(number: int) -> bool:
        scores.append(best_score(out / f"aap-{number}"))
        return not converged(scores, config.alternation, rollouts.at_least)

    for step in alternation(goes_on):
        perform(step, rollouts, lambda job: run_stage(job, config, hardware, memory))
    best = scores.index(min(scores)) + 1
    if data_parallel.rank() == 0:
        rounds = [{"round": number, "score": score} for number, score in enumerate(scores, start=1)]
        ended_early = len(scores) < config.alternation.rounds
        told = {"rounds": rounds, "best": best, "converged": ended_early}
        write_atomically(out / ALTERNATION_FILE, json.dumps(told, indent=1).encode())
        why = "converged" if ended_early else "no more rounds allowed"
        print(f"{out}: {why} after {len(scores)}; the best policy is {out / f'aip-{best}'}", flush=True)
    return out / f"aip-{best}"


def converged(scores: list[float], config: AlternationConfig, at_least: int) -> bool:
    """Whether rounds with these scores, the lower the better, are the last.

    Args:
        scores: of each round so far.
        config: the criterion.
        at_least: rounds that are needed to have learnt from all of the store.
    """
    if len(scores) >= config.rounds:
        return True
    best, misses = math.inf, 0
    for score in scores:
        counts = score < best * (1.0 - config.improvement)
        misses = 0 if counts else misses + 1
        best = min(best, score)
    return len(scores) >= at_least and misses >= config.patience


class AlternationRecord(BaseModel):
    """What is read again of an alternation's record."""

    best: int = Field(ge=1, le=1000)


def is_training(out: Path) -> bool:
    """Whether a folder is the --out of an alternation, or of a single stage that is finished."""
    return (out / ALTERNATION_FILE).is_file() or (out / DONE_FILE).is_file()


def trained_in(out: Path) -> Path:
    """The folder of the best policy in the --out of an alternation, or of a single stage.

    Raises:
        UsageError: no finished training.
        StoreError: its record is damaged.
    """
    record, policy = out / ALTERNATION_FILE, out
    if record.is_file():
        advice = "damaged; the same training again writes it anew"
        policy = out / f"aip-{read_document(AlternationRecord, record, MAX_DONE_BYTES, advice).best}"
    if not (policy / DONE_FILE).is_file():
        raise UsageError(f"{out}: holds no finished training; name the --out of `adaafford train alternate` or aap")
    return policy


def best_score(folder: Path) -> float:
    """The best validation score of a finished stage.

    Raises:
        StoreError: its done.json is damaged.
    """
    score = read_done(folder / DONE_FILE).metrics.get("score")
    if score is None:
        raise StoreError(f"{folder / DONE_FILE}: damaged; remove the folder to train this stage again")
    return score
