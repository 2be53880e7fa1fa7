"""The alternation offline: prior, AAP, AIP, then AAP fine-tuned and AIP again, from a finished store until convergence.

RUN/ of an alternation
    prior/, aap-1/, aip-1/, aap-2/, ...   one folder a stage (see `learner.stages`), each resumable by itself
    alternation.json                      the rounds, which of them is the best, and why they ended; written last

Where the store holds rounds that policies proposed, round V of training learns from what versions below V proposed, as
a campaign would have had it (AdaAfford, Training Strategy); later rounds, from all rows.
"""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

from learner import sharing
from learner.configuration import AlternationConfig, LearnerConfig
from learner.hardware import Hardware
from learner.stages import DONE_FILE, StageJob, StageName, run_stage
from shared.errors import StoreError
from shared.files import read_bounded, write_atomically
from shared.policy import MAX_POLICY_JSON_BYTES, Policy
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


def alternate(job: StageJob, config: LearnerConfig, hardware: Hardware | None = None) -> Policy:
    """Train rounds until they bring no more, or go on with them after a kill; returns the policy of the best round.

    A round counts if it lowers the best validation loss of AAP by more than `config.alternation.improvement` of it. The
    rounds end when `patience` of them in a row did not count and every round of the store has been learnt from.

    Raises:
        UsageError: see `run_stage`.
        StoreError: see `run_stage`.
    """
    hardware = hardware or Hardware()
    newest = newest_policy(Store.open(job.store))
    last = _run(job, config, hardware, "prior", "prior", job.init)
    rounds: list[Round] = []
    policies: list[Policy] = []
    while not converged([found.score for found in rounds], config.alternation, newest + 1):
        number = len(rounds) + 1
        seen = replace(job, newest_policy=number - 1) if number <= newest else job
        aap = _run(seen, config, hardware, "aap", f"aap-{number}", last[0])
        last = _run(seen, config, hardware, "aip", f"aip-{number}", aap[0])
        policies.append(last[1])
        rounds.append(Round(number, best_score(aap[0])))
    best = min(rounds, key=lambda found: found.score)
    if sharing.rank() == 0:
        told = {"rounds": [{"round": r.number, "score": r.score} for r in rounds], "best": best.number}
        told["converged"] = len(rounds) < config.alternation.rounds
        write_atomically(job.out / ALTERNATION_FILE, json.dumps(told, indent=1).encode())
        why = "converged" if told["converged"] else "no more rounds allowed"
        print(f"{job.out}: {why} after {len(rounds)}; the best policy is {job.out / f'aip-{best.number}'}", flush=True)
    return policies[best.number - 1]


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
    return max((plan.policy_version for plan in store.plans()), default=0)


def best_score(folder: Path) -> float:
    """The best validation score of a finished stage.

    Raises:
        StoreError: its done.json is damaged.
    """
    path = folder / DONE_FILE
    try:
        return float(json.loads(read_bounded(path, MAX_POLICY_JSON_BYTES))["metrics"]["score"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise StoreError(f"{path}: damaged; remove the folder to train this stage again") from None


def _run(
    job: StageJob, config: LearnerConfig, hardware: Hardware, stage: StageName, folder: str, init: Path | None
) -> tuple[Path, Policy]:
    out = job.out / folder
    return out, run_stage(replace(job, stage=stage, out=out, init=init), config, hardware)
