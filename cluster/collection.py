"""Drives one plan over a fleet: what is committed stays, what is missing is done, and nothing is done twice."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cluster.blame import JobError
from cluster.fleet import Fleet
from cluster.progress import CollectionProgress, Tally
from shared.errors import WorkerError
from shared.plan import Plan, missing_jobs
from shared.reproduction import reproduction
from shared.store import Store

OpenFleet = Callable[[], Fleet]

MOST_REPORTED = 10
"""Quarantined rollouts that a collection prints; a store that is all wrong would print thousands."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Collected:
    """What one attempt at a plan added."""

    tally: Tally
    seconds: float
    """Wall time."""
    workers: int


def collect(store: Store, plan: Plan, rollouts: int, per_shard: int, open_fleet: OpenFleet, objects: Path) -> Collected:
    """Bring `plan` to `rollouts` committed rollouts.

    Args:
        store: of the plan's setting.
        plan: who proposes.
        rollouts: how many the store shall hold of this plan, those of earlier attempts included.
        per_shard: rollouts a shard.
        open_fleet: gives the fleet; not called if nothing is left to do.
        objects: folder of the objects, for the command that reproduces a failed job.

    Raises:
        WorkerError: a job failed again and again; the message ends with the command that reproduces it.
        StoreError: the plan's policy is not in the store.
    """
    # Only one driver works on a store, so whatever the dead left is of no use to anybody.
    store.sweep()
    store.add_plan(plan)
    done = [(shard.start, shard.stop) for shard in store.committed(plan.key)]
    jobs = missing_jobs(plan.key, rollouts, done, per_shard)
    already = sum(stop - start for start, stop in done)
    progress = CollectionProgress(f"collecting {plan.key}", already, rollouts, store.where)
    with progress:
        if not jobs:
            return Collected(progress.tally, 0.0, 0)
        fleet = open_fleet()
        if plan.policy_version:
            fleet.load_policy(plan.policy_version, store.read_policy(plan.policy_version))
        try:
            fleet.run(plan, jobs, progress)
        except JobError as error:
            command = reproduction(store.where, error.job.shard_id, objects)
            raise WorkerError(f"{error}; reproduce it with: {command}") from None
    if progress.tally.quarantined:
        _report_quarantined(store, plan)
    return Collected(progress.tally, progress.elapsed_s, fleet.workers)


def _report_quarantined(store: Store, plan: Plan) -> None:
    """Say which rollouts were given up, why, and how to see it happen."""
    given_up = [each for shard in store.committed(plan.key) for each in shard.quarantined]
    logger.warning("%d rollouts of %s are quarantined; `adaafford store info` lists them", len(given_up), plan.key)
    for each in given_up[:MOST_REPORTED]:
        logger.warning("rollout %d: %s; alone: %s", each.rollout, each.reason, each.command)
