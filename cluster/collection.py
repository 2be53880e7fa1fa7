"""Drives one plan over a fleet: what is committed stays, what is missing is done, and nothing is done twice."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cluster.fleet import Fleet, JobError
from cluster.progress import CollectionProgress, Tally
from shared.errors import WorkerError
from shared.plan import Job, Plan, missing_jobs
from shared.store import Store

OpenFleet = Callable[[], Fleet]


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
    store.add_plan(plan)
    done = [(shard.start, shard.stop) for shard in store.committed(plan.key)]
    jobs = missing_jobs(plan.key, rollouts, done, per_shard)
    already = sum(stop - start for start, stop in done)
    progress = CollectionProgress(f"collecting {plan.key}", already, rollouts, str(store.path))
    with progress:
        if not jobs:
            return Collected(progress.tally, 0.0, 0)
        fleet = open_fleet()
        if plan.policy_version:
            fleet.load_policy(plan.policy_version, store.read_policy(plan.policy_version))
        try:
            fleet.run(plan, jobs, progress)
        except JobError as error:
            command = reproduction(store.path, error.job, objects)
            raise WorkerError(f"{error}; reproduce it with: {command}") from None
    return Collected(progress.tally, progress.elapsed_s, fleet.workers)


def reproduction(store: Path, job: Job, objects: Path) -> str:
    """The command that runs one job alone, in the foreground, without Ray."""
    return f"adaafford store replay {store} {job.shard_id} --objects {objects}"
