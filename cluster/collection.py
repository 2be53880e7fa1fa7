"""Drives collection over a fleet: what is committed stays, what is missing is done, and nothing is done twice."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cluster.blame import JobError
from cluster.fleet import Fleet
from cluster.in_force import PlanInForce
from cluster.orders import Series
from cluster.progress import CollectionProgress, Tally
from cluster.status import DriverStatus, State, StatusKeeper
from shared.errors import WorkerError
from shared.files import process_name
from shared.plan import Plan, covered, missing_ranges, parse_plan_key
from shared.reproduction import reproduction
from shared.store import Store
from shared.store.provenance import difference_of_software

OpenFleet = Callable[[], Fleet]

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
    store: Store, plan: Plan | Newest, rollouts: int, per_shard: int, open_fleet: OpenFleet, objects: Path
) -> Collected:
    """Bring `plan` to `rollouts` committed rollouts.

    Args:
        store: of the plan's setting.
        plan: who proposes, with which policy.
        rollouts: how many the store shall hold of this plan, or of this proposer with any policy, those of earlier
            attempts included.
        per_shard: rollouts a shard.
        open_fleet: gives the fleet; not called if nothing is left to do.
        objects: folder of the objects, for the command that reproduces a failed job.

    Raises:
        WorkerError: a job failed again and again; the message ends with the command that reproduces it.
        StoreError: the plan's policy is not in the store.
    """
    # Only one driver works on a store, so whatever the dead left is of no use to anybody.
    store.sweep()
    if differing := difference_of_software(store.document.software):
        logger.warning("%s was begun with other software: %s; results may differ a little", store.where, differing)
    if isinstance(plan, Plan):
        store.add_plan(plan)
    held = {key: [(job.start, job.stop) for job in store.jobs(key)] for key in _plan_keys(store, plan)}
    missing = missing_ranges(rollouts, [each for ranges in held.values() for each in ranges])
    already = rollouts - sum(stop - start for start, stop in missing)
    progress = CollectionProgress(f"collecting {plan.key}", already, rollouts, store.where)
    with progress:
        if not missing:
            return Collected(progress.tally, 0.0, 0)
        fleet = open_fleet()
        version, per_version = (plan.policy_version, None) if isinstance(plan, Plan) else (None, plan.per_version)
        in_force = PlanInForce(store, plan.proposer, version, _Adopting(store, fleet))
        counts = {key: covered(ranges) for key, ranges in held.items()}
        series = Series(in_force, missing, per_shard, per_version, counts)
        standing = _Standing(plan.key, already, rollouts, progress, fleet, in_force)
        try:
            with StatusKeeper(store.place, standing, lambda: series.waiting, progress.say):
                fleet.run(series, progress)
        except JobError as error:
            command = reproduction(store.where, error.job.shard_id, objects)
            raise WorkerError(f"{error}; reproduce it with: {command}") from None
    if progress.tally.quarantined:
        _report_quarantined(store, plan)
    return Collected(progress.tally, progress.elapsed_s, fleet.workers)


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
    fleet: Fleet

    def __call__(self, plan: Plan) -> None:
        if plan.policy_version:
            self.fleet.load_policy(plan.policy_version, self.store.read_policy(plan.policy_version))
        self.store.add_plan(plan)
        logger.info("plan %s is in force", plan.key, extra={"plan": plan.key})


@dataclass(frozen=True, slots=True)
class _Standing:
    """Tells how a collection stands."""

    title: str
    already: int
    total: int
    progress: CollectionProgress
    fleet: Fleet
    in_force: PlanInForce

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
            workers=self.fleet.workers,
            restarts=self.fleet.restarts,
        )


def _report_quarantined(store: Store, plan: Plan | Newest) -> None:
    """Say which rollouts were given up, why, and how to see it happen."""
    shards = (shard for key in _plan_keys(store, plan) for shard in store.manifests(key))
    given_up = [each for shard in shards for each in shard.quarantined]
    logger.warning("%d rollouts of %s are quarantined; `adaafford store info` lists them", len(given_up), plan.key)
    for each in given_up[:MOST_REPORTED]:
        logger.warning("rollout %d: %s; alone: %s", each.rollout, each.reason, each.command)
