"""The alternation: prior, AAP, AIP, then AAP fine-tuned and AIP again, until that brings no more.

RUN/ of an alternation
    prior/, aap-1/, aip-1/, aap-2/, ...   one folder a stage (see `learner.stages`), each resumable by itself
    alternation.json                      the rounds, which of them is the best, and why they ended; written last

What each round learns from is up to `Rounds`: of a finished store (`Finished`), or of one that still grows
(`learner.following`).
"""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from pydantic import BaseModel, Field

from learner import sharing
from learner.configuration import AlternationConfig, LearnerConfig
from learner.hardware import Hardware
from learner.recipes import ORACLE_FILE
from learner.stages import DONE_FILE, MAX_DONE_BYTES, Memory, StageJob, StageName, read_done, run_stage
from shared.documents import read_document
from shared.errors import StoreError, UsageError
from shared.files import write_atomically
from shared.plan import parse_plan_key
from shared.policy import Policy
from shared.store.store import Store

ALTERNATION_FILE = "alternation.json"


@dataclass(frozen=True, slots=True)
class Round:
    """One AAP and the AIP that was trained for it.

    Attributes:
        number: from 1.
        score: best validation loss of AAP, nats.
    """

    number: int
    score: float


class Rounds(Protocol):
    """What the rounds of an alternation learn from, and what becomes of their policies."""

    at_least: int
    """Rounds that it takes to have learnt from all that is there."""

    def data(self, job: StageJob, number: int) -> StageJob:
        """The job with what round `number`, from 1, learns from, the prior being 0; waits until there is enough."""
        ...

    def done(self, number: int, policy: Path) -> None:
        """Take note that a round has left its policy in a folder."""
        ...


class Finished:
    """The rounds of a store that grows no more.

    Where it holds rounds that policies proposed, round V of training learns from what versions below V proposed, as a
    campaign would have had it (AdaAfford, Training Strategy); later rounds, from all rows.
    """

    def __init__(self, store: Store) -> None:
        self._newest = newest_policy(store)
        self.at_least = self._newest + 1

    def data(self, job: StageJob, number: int) -> StageJob:
        """See `Rounds.data`."""
        return replace(job, newest_policy=number - 1) if 1 <= number <= self._newest else job

    def done(self, number: int, policy: Path) -> None:
        """See `Rounds.done`."""


@dataclass(frozen=True, slots=True)
class Best:
    """The best round's policy, and the folder that it lies in."""

    policy: Policy
    folder: Path


def alternate(
    job: StageJob, config: LearnerConfig, hardware: Hardware | None = None, rounds: Rounds | None = None
) -> Best:
    """Train rounds until they bring no more, or go on with them after a kill; returns what the best of them made.

    A round counts if it lowers the best validation loss of AAP by more than `config.alternation.improvement` of it. The
    rounds end when `patience` of them in a row did not count and every round of the store has been learnt from.

    Raises:
        UsageError: see `run_stage`.
        StoreError: see `run_stage`.
    """
    hardware, memory = hardware or Hardware(), Memory()
    rounds = rounds or Finished(Store.open(job.store))
    last = _run(rounds.data(job, 0), config, hardware, memory, "prior", "prior", job.init)
    trained: list[Round] = []
    policies: list[Policy] = []
    while not converged([found.score for found in trained], config.alternation, rounds.at_least):
        number = len(trained) + 1
        seen = rounds.data(job, number)
        aap = _run(seen, config, hardware, memory, "aap", f"aap-{number}", last[0])
        last = _run(seen, config, hardware, memory, "aip", f"aip-{number}", aap[0])
        policies.append(last[1])
        trained.append(Round(number, best_score(aap[0])))
        rounds.done(number, last[0])
    best = min(trained, key=lambda found: found.score)
    if sharing.rank() == 0:
        told = {"rounds": [{"round": r.number, "score": r.score} for r in trained], "best": best.number}
        told["converged"] = len(trained) < config.alternation.rounds
        write_atomically(job.out / ALTERNATION_FILE, json.dumps(told, indent=1).encode())
        why = "converged" if told["converged"] else "no more rounds allowed"
        print(f"{job.out}: {why} after {len(trained)}; the best policy is {job.out / f'aip-{best.number}'}", flush=True)
    return Best(policies[best.number - 1], job.out / f"aip-{best.number}")


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


def newest_policy(store: Store) -> int:
    """The newest version of a policy that proposed rows of a store; 0 where all are random."""
    # By the names of shards, which say it also where the file of a plan was lost.
    return max((parse_plan_key(job.plan_key)[1] for job in store.jobs()), default=0)


class AlternationRecord(BaseModel):
    """What is read again of an alternation's record."""

    best: int = Field(ge=1, le=1000)


@dataclass(frozen=True, slots=True)
class Trained:
    """Where a training left what it made.

    Attributes:
        policy: the folder of the stage whose policy is its best.
        oracle: the file of its oracle critic, where privileged training left one.
    """

    policy: Path
    oracle: Path | None


def trained_in(out: Path) -> Trained:
    """What the --out of an alternation, or of a single stage, holds.

    Raises:
        UsageError: no finished training.
        StoreError: its record is damaged.
    """
    record = out / ALTERNATION_FILE
    if record.is_file():
        told = read_document(
            AlternationRecord, record, MAX_DONE_BYTES, "damaged; the same training again writes it anew"
        )
        policy = out / f"aip-{told.best}"
    else:
        policy = out
    if not (policy / DONE_FILE).is_file():
        raise UsageError(f"{out}: holds no finished training; name the --out of `adaafford train alternate` or aap")
    oracle = policy / ORACLE_FILE
    return Trained(policy, oracle if oracle.is_file() else None)


def best_score(folder: Path) -> float:
    """The best validation score of a finished stage.

    Raises:
        StoreError: its done.json is damaged.
    """
    score = read_done(folder / DONE_FILE).metrics.get("score")
    if score is None:
        raise StoreError(f"{folder / DONE_FILE}: damaged; remove the folder to train this stage again")
    return score


def _run(
    job: StageJob,
    config: LearnerConfig,
    hardware: Hardware,
    memory: Memory,
    stage: StageName,
    folder: str,
    init: Path | None,
) -> tuple[Path, Policy]:
    out = job.out / folder
    return out, run_stage(replace(job, stage=stage, out=out, init=init), config, hardware, memory)
