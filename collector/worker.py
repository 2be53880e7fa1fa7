"""A worker: executes jobs and commits their shards. The Ray actor and the serial mode are thin wrappers around it."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import psutil

from collector.job_result import JobResult
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import ObjectCache
from collector.random_proposer import RandomProposer
from collector.rollout import object_of, quarantined_rollout, run_rollout
from collector.setting import check_packages
from collector.sim.simulator import StageClock
from collector.watchdog import UnderWay
from shared.io.text import without_places
from shared.plan import Job, Plan, RolloutRecord, RolloutStatus
from shared.policies.methods import PROPOSERS, needs_policy
from shared.store import Quarantined, Store
from shared.store.layout import MAX_REASON, OBJECTS, STORE, reproduction
from shared.store.provenance import note_machine
from shared.types import Proposer

if TYPE_CHECKING:
    from shared.policies.adaptation import Adapter

NOTHING: Mapping[int, str] = MappingProxyType({})
CACHED_POLICIES = 2
"""An evaluation may alternate between the last policy and the first."""


class Worker:
    """Executes jobs of any plan of one store.

    Args:
        store: folder or URL of the store.
        objects: folder of the objects.
    """

    def __init__(self, store: str | Path, objects: Path) -> None:
        self._store = Store.open(store)
        note_machine(self._store.backend)
        self._folder = objects
        self._objects = ObjectCache(objects)
        self._adapters: dict[int, Adapter] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Build the networks of a policy version from its files.

        Raises:
            UsageError: the policy needs depth images, and the store keeps none.
        """
        # Networks are imported with the first policy: PyTorch is half of a worker's start, and random rounds need none.
        from shared.policies.adaptation import Adapter
        from shared.policies.policy import Policy

        policy = Policy.from_files(files)
        policy.check_camera(self._store.setting.collection.camera)
        while len(self._adapters) >= CACHED_POLICIES:
            self._adapters.pop(next(iter(self._adapters)))
        self._adapters[version] = Adapter(policy)

    def run(
        self,
        plan: Plan,
        job: Job,
        quarantined: Mapping[int, str] = NOTHING,
        under_way: UnderWay = lambda rollout: None,
    ) -> JobResult:
        """Execute a job's rollouts and commit its shard; do nothing if the shard is already committed.

        Args:
            plan: the plan that the job belongs to.
            job: the job.
            quarantined: rollouts that are not executed, with the reasons; they are recorded as quarantined.
            under_way: called with each rollout's number before it is executed, then with None.
        """
        begun = time.perf_counter()
        clock = StageClock()
        if self._store.holds(job):
            return _job_result(job, self._store.read_rollouts(job.shard_id), {"total": time.perf_counter() - begun})
        records = []
        for index in range(job.start, job.stop):
            if index in quarantined:
                records.append(quarantined_rollout(plan, index))
            else:
                under_way(index)
                records.append(self.execute(plan, index, clock))
        under_way(None)
        provenance = {}
        if plan.proposer in PROPOSERS.names() and (package := PROPOSERS.package_of(plan.proposer)) is not None:
            provenance["proposer"] = package
        if plan.policy_version:
            # With the version in each row, this shows how old its policy was if the collection follows a learner.
            provenance["newest_policy"] = str(max(self._store.policy_versions(), default=0))
        # A store on a disk has one driver, which knows what is missing; a bucket may have several drivers.
        vetted = not self._store.backend.writes_in_place
        with clock.stage("write"):
            self._store.commit(plan, job, records, provenance, self._explain(job, quarantined), vetted=vetted)
        clock.seconds["total"] = time.perf_counter() - begun
        return _job_result(job, records, dict(clock.seconds))

    def execute(self, plan: Plan, index: int, clock: StageClock) -> RolloutRecord:
        """Execute one rollout without a commit.

        Raises:
            UsageError: the setting needs packages that are not installed.
        """
        check_packages(plan.setting)
        with _one_thread() if plan.policy_version else nullcontext():
            return run_rollout(plan, index, self._load(plan, index, clock), partial(self._proposer, plan), clock)

    def _explain(self, job: Job, quarantined: Mapping[int, str]) -> list[Quarantined]:
        """The manifest's entries of quarantined rollouts."""
        return [
            Quarantined(
                rollout=index,
                reason=without_places(reason, self._folder)[:MAX_REASON],
                command=reproduction(STORE, job.shard_id, OBJECTS, index),
            )
            for index, reason in sorted(quarantined.items())
        ]

    def _load(self, plan: Plan, index: int, clock: StageClock) -> ArticulatedObject:
        """The object of a rollout."""
        with clock.stage("load"):
            return self._objects.load(object_of(plan, index), plan.setting.collection.collision)

    def _proposer(
        self, plan: Plan, name: str, rng: np.random.Generator, version: int, share: float | None = None
    ) -> Proposer:
        """The proposer called `name`, of a policy version; `share` as `proposer_named` takes it."""
        if name == RandomProposer.name:
            return RandomProposer(rng, plan.setting.terms.edge_share)
        from shared.policies.proposers import proposer_named

        if name in PROPOSERS.names() and not needs_policy(name):
            return proposer_named(name, None, rng, plan.most_tries)
        if version not in self._adapters:
            self.load_policy(version, self._store.read_policy(version))
        return proposer_named(name, self._adapters[version], rng, plan.most_tries, share)


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch with one thread, as in the process of an actor: several wait for each other longer than they compute."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _empty(records: Sequence[RolloutRecord]) -> dict[str, dict[str, int]]:
    """How many rollouts were executed without an interaction, by status and object."""
    counts: dict[str, dict[str, int]] = {}
    for record in records:
        if not record.interactions and record.status is not RolloutStatus.QUARANTINED:
            of_status = counts.setdefault(record.status.value, {})
            of_status[record.object.id] = of_status.get(record.object.id, 0) + 1
    return counts


def _job_result(job: Job, records: Sequence[RolloutRecord], seconds: dict[str, float]) -> JobResult:
    outcomes = [row.outcome for record in records for row in record.interactions]
    return JobResult(
        shard_id=job.shard_id,
        rollouts=len(records),
        interactions=len(outcomes),
        successes=sum(outcome.success for outcome in outcomes),
        outcomes=dict(Counter(outcome.kind.value for outcome in outcomes)),
        seconds=seconds,
        quarantined=sum(record.status is RolloutStatus.QUARANTINED for record in records),
        empty=_empty(records),
        memory_mb=psutil.Process().memory_info().rss / 2**20,
    )
