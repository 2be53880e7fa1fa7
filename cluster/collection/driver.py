"""The driver of a collection: it lets a worker group make the rollouts that a store does not have yet."""

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cluster.collection.status_writer import CollectionProgress, DriverStatus, State, Tally, describe_empty, status_kept
from cluster.workers.job_queue import PolicySource, RolloutQueue
from cluster.workers.retries import JobError
from cluster.workers.worker_group import WorkerGroup
from shared.errors import WorkerError
from shared.io.files import process_name
from shared.plan import Plan, covered, missing_ranges, parse_plan_key
from shared.store import Store, reopen_quarantined
from shared.store.layout import reproduction
from shared.store.maintenance.info import quarantined_in

OpenWorkerGroup = Callable[[], WorkerGroup]

MOST_REPORTED = 10
"""How many quarantined rollouts are printed; in a bad case there are thousands."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Collected:
    """What one attempt added to a store."""

    tally: Tally
    seconds: float
    """Wall time."""
    workers: int


@dataclass(frozen=True, slots=True)
class LatestPolicy:
    """Used instead of a plan: a proposer that always uses the newest published policy.

    Attributes:
        proposer: its name.
        per_version: the most rollouts of one version, after which the collection waits for the next version (rounds);
            None: a version is used until there is a newer one (continuous collection).
    """

    proposer: str = "aip"
    per_version: int | None = None

    @property
    def key(self) -> str:
        """Its name in messages."""
        return f"{self.proposer}-latest"


def collect(
    store: Store,
    plan: Plan | LatestPolicy,
    rollouts: int,
    per_shard: int,
    open_worker_group: OpenWorkerGroup,
    objects: Path,
    *,
    retry_quarantined: bool = False,
) -> Collected:
    """Bring `plan` to `rollouts` committed rollouts.

    Args:
        store: has the plan's setting.
        plan: the proposer and its policy.
        rollouts: how many rollouts of this plan, or of this proposer with any policy, the store has in the end,
            including those of earlier attempts.
        per_shard: rollouts of a shard.
        open_worker_group: gives the worker group; not called if no rollout is missing.
        objects: folder of the objects, for the command that reproduces a failed job.
        retry_quarantined: whether quarantined rollouts are executed again.

    Raises:
        WorkerError: a job failed repeatedly; the message ends with the command that reproduces it. Or none of the
            plan's rollouts in the store has an interaction.
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
        policy_source = PolicySource(store, plan.proposer, version, _Announcing(store, worker_group))
        counts = {key: covered(ranges) for key, ranges in held.items()}
        queue = RolloutQueue(policy_source, missing, per_shard, per_version, counts)
        snapshot = _Snapshot(plan.key, already, rollouts, progress, worker_group, policy_source)
        try:
            with status_kept(store.backend, snapshot, lambda: queue.waiting, progress.say):
                worker_group.run(queue, progress)
        except JobError as error:
            command = reproduction(store.where, error.job.shard_id, objects)
            raise WorkerError(f"{error}; reproduce it with: {command}") from None
    if progress.tally.quarantined:
        _report_quarantined(store, plan, objects)
    if not progress.tally.interactions:
        _require_interactions(store, plan)
    return Collected(progress.tally, progress.elapsed_s, worker_group.workers)


def _plan_keys(store: Store, plan: Plan | LatestPolicy) -> list[str]:
    """The key of the plan, or the keys of all plans of the proposer."""
    if isinstance(plan, Plan):
        return [plan.key]
    # The names of shards are used, because the file of a plan may be lost while its rollouts are there.
    return sorted({job.plan_key for job in store.jobs() if parse_plan_key(job.plan_key)[0] == plan.proposer})


@dataclass(frozen=True, slots=True)
class _Announcing:
    """Gives the policy of a new plan to the workers, and adds the plan to the store."""

    store: Store
    worker_group: WorkerGroup

    def __call__(self, plan: Plan) -> None:
        if plan.policy_version:
            self.worker_group.load_policy(plan.policy_version, self.store.read_policy(plan.policy_version))
        self.store.add_plan(plan)
        logger.info("plan %s is used from now on", plan.key, extra={"plan": plan.key})


@dataclass(frozen=True, slots=True)
class _Snapshot:
    """Makes the status of a collection."""

    title: str
    already: int
    total: int
    progress: CollectionProgress
    worker_group: WorkerGroup
    policy_source: PolicySource

    def __call__(self, state: State) -> DriverStatus:
        tally, plan = self.progress.tally, self.policy_source.plan
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


def _require_interactions(store: Store, plan: Plan | LatestPolicy) -> None:
    """Check that the plan has an interaction in the store; manifests are read up to the first that has one."""
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


def _report_quarantined(store: Store, plan: Plan | LatestPolicy, objects: Path) -> None:
    """Log which rollouts are quarantined, why, and the command that executes each alone."""
    shards = (shard for key in _plan_keys(store, plan) for shard in store.manifests(key))
    given_up = quarantined_in(shards, store.where, objects)
    logger.warning("%d rollouts of %s are quarantined; `adaafford store info` lists them", len(given_up), plan.key)
    for each in given_up[:MOST_REPORTED]:
        logger.warning("rollout %d: %s; alone: %s", each.rollout, each.reason, each.command)
