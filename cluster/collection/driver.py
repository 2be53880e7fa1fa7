"""Drives a collection by a worker group: committed rollouts stay, missing ones are made, and none is made twice."""

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cluster.collection.status_writer import DriverStatus, State, status_kept
from cluster.collection.tally import CollectionProgress, Tally, describe_empty
from cluster.workers.job_queue import RolloutQueue
from cluster.workers.policy_source import PolicySource
from cluster.workers.retries import JobError
from cluster.workers.worker_group import WorkerGroup
from shared.errors import WorkerError
from shared.io.files import process_name
from shared.plan import Plan, covered, missing_ranges, parse_plan_key
from shared.reproduction import reproduction
from shared.store import Store, reopen_quarantined
from shared.store.maintenance.info import quarantined_in

OpenFleet = Callable[[], WorkerGroup]

MOST_REPORTED = 10
"""Quarantined rollouts that a collection prints; a store that is all wrong would print thousands."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Collected:
    """What one attempt added."""

    tally: Tally
    seconds: float
    """Wall time."""
    workers: int


@dataclass(frozen=True, slots=True)
class Newest:
    """In the place of a plan: a proposer with the newest policy that is published, whichever that is at the moment.

    Attributes:
        proposer: who proposes.
        per_version: the most rollouts of one version, after which the next one is waited for (rounds); None: it
            proposes until there is a newer one (continuous collection).
    """

    proposer: str = "aip"
    per_version: int | None = None

    @property
    def key(self) -> str:
        """What people call it."""
        return f"{self.proposer}-latest"


def collect(
    store: Store,
    plan: Plan | Newest,
    rollouts: int,
    per_shard: int,
    open_worker_group: OpenFleet,
    objects: Path,
    *,
    retry_quarantined: bool = False,
) -> Collected:
    """Bring `plan` to `rollouts` committed rollouts.

    Args:
        store: of the plan's setting.
        plan: who proposes, with which policy.
        rollouts: how many the store shall hold of this plan, or of this proposer with any policy, those of earlier
            attempts included.
        per_shard: rollouts a shard.
        open_worker_group: gives the worker group; not called if nothing is left to do.
        objects: folder of the objects, for the command that reproduces a failed job.
        retry_quarantined: whether rollouts that were quarantined are executed again.

    Raises:
        WorkerError: a job failed again and again; the message ends with the command that reproduces it. Or all
            rollouts that the store holds of the plan gave no interaction.
        StoreError: the plan's policy is not in the store.
    """
    # Only one driver works on a store, so leftovers of crashed workers can be removed.
    store.sweep()
    if isinstance(plan, Plan):
        store.add_plan(plan)
    if retry_quarantined:
        reopened = reopen_quarantined(store, _plan_keys(store, plan))
        logger.warning("%d quarantined rollouts of %s are executed again", reopened, plan.key)
    held = {key: [(job.start, job.stop) for job in store.jobs(key)] for key in _plan_keys(store, plan)}
    missing = missing_ranges(rollouts, [each for ranges in held.values() for each in ranges])
    already = rollouts - sum(stop - start for start, stop in missing)
    progress = CollectionProgress(f"collecting {plan.key}", already, rollouts, store.where)
    with progress:
        if not missing:
            _require_interactions(store, plan)
            return Collected(progress.tally, 0.0, 0)
        worker_group = open_worker_group()
        version, per_version = (plan.policy_version, None) if isinstance(plan, Plan) else (None, plan.per_version)
        in_force = PolicySource(store, plan.proposer, version, _Adopting(store, worker_group))
        counts = {key: covered(ranges) for key, ranges in held.items()}
        series = RolloutQueue(in_force, missing, per_shard, per_version, counts)
        snapshot = _Snapshot(plan.key, already, rollouts, progress, worker_group, in_force)
        try:
            with status_kept(store.backend, snapshot, lambda: series.waiting, progress.say):
                worker_group.run(series, progress)
        except JobError as error:
            command = reproduction(store.where, error.job.shard_id, objects)
            raise WorkerError(f"{error}; reproduce it with: {command}") from None
    if progress.tally.quarantined:
        _report_quarantined(store, plan, objects)
    if not progress.tally.interactions:
        _require_interactions(store, plan)
    return Collected(progress.tally, progress.elapsed_s, worker_group.workers)


def _plan_keys(store: Store, plan: Plan | Newest) -> list[str]:
    """The plan, or all of a proposer with any policy."""
    if isinstance(plan, Plan):
        return [plan.key]
    # By the names of shards: a plan whose file was lost has made its rollouts all the same.
    return sorted({job.plan_key for job in store.jobs() if parse_plan_key(job.plan_key)[0] == plan.proposer})


@dataclass(frozen=True, slots=True)
class _Adopting:
    """Makes a plan known to the store, and its policy to the workers."""

    store: Store
    worker_group: WorkerGroup

    def __call__(self, plan: Plan) -> None:
        if plan.policy_version:
            self.worker_group.load_policy(plan.policy_version, self.store.read_policy(plan.policy_version))
        self.store.add_plan(plan)
        logger.info("plan %s is in force", plan.key, extra={"plan": plan.key})


@dataclass(frozen=True, slots=True)
class _Snapshot:
    """Tells how a collection stands."""

    title: str
    already: int
    total: int
    progress: CollectionProgress
    worker_group: WorkerGroup
    in_force: PolicySource

    def __call__(self, state: State) -> DriverStatus:
        tally, plan = self.progress.tally, self.in_force.plan
        return DriverStatus(
            process=process_name(),
            written=time.time(),
            state=state,
            title=self.title,
            policy=None if plan is None else plan.policy_version,
            done=self.already + tally.rollouts,
            total=self.total,
            elapsed_s=self.progress.elapsed_s,
            rollouts=tally.rollouts,
            interactions=tally.interactions,
            successes=tally.successes,
            outcomes=dict(tally.outcomes),
            quarantined=tally.quarantined,
            recent_per_s=self.progress.recent_per_s,
            workers=self.worker_group.workers,
            restarts=self.worker_group.restarts,
        )


def _require_interactions(store: Store, plan: Plan | Newest) -> None:
    """See that the store holds an interaction of the plan; manifests are read up to the first that has one."""
    keys = _plan_keys(store, plan)
    if any(store.manifest(job).interactions for key in keys for job in store.jobs(key)):
        return
    empty: dict[str, Counter[str]] = {}
    for row in store.rollouts().select(["plan_key", "status", "object_id"]).to_pylist():
        if row["plan_key"] in keys:
            empty.setdefault(row["status"], Counter())[row["object_id"]] += 1
    raise WorkerError(
        f"{store.where}: holds no interaction of {plan.key}: {describe_empty(empty)}; `adaafford objects check "
        "--settle` says which objects come to rest, and `--task TASK` which have a part to act on"
    )


def _report_quarantined(store: Store, plan: Plan | Newest, objects: Path) -> None:
    """Say which rollouts were given up, why, and how to see it happen."""
    shards = (shard for key in _plan_keys(store, plan) for shard in store.manifests(key))
    given_up = quarantined_in(shards, store.where, objects)
    logger.warning("%d rollouts of %s are quarantined; `adaafford store info` lists them", len(given_up), plan.key)
    for each in given_up[:MOST_REPORTED]:
        logger.warning("rollout %d: %s; alone: %s", each.rollout, each.reason, each.command)
