"""A worker: executes jobs and commits their shards. The Ray actor and the serial mode are thin wrappers around it."""

import os
import platform
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from collector.articulation import ArticulatedObject
from collector.catalogue import load_ref
from collector.clock import StageClock
from collector.draws import object_of
from collector.proposers import RandomProposer
from collector.rollout import run_rollout
from shared.adaptation import Adapter
from shared.plan import Job, Plan
from shared.policy import Policy
from shared.proposers import proposer_named
from shared.records import RolloutRecord
from shared.store import Store
from shared.vocabulary import Proposer

CACHED_OBJECTS = 16
CACHED_POLICIES = 2
"""An evaluation may go back and forth between the last policy and the first."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """What came of a job: counts and times, never data.

    Attributes:
        shard_id: the committed shard.
        rollouts: how many it holds.
        interactions: likewise.
        successes: likewise.
        outcomes: interactions by outcome kind.
        seconds: wall time by stage, and "total".
    """

    shard_id: str
    rollouts: int
    interactions: int
    successes: int
    outcomes: dict[str, int]
    seconds: dict[str, float]


class Worker:
    """Executes jobs of any plan of one store.

    Args:
        store: the store's place.
        objects: folder of the objects.
    """

    def __init__(self, store: str | Path, objects: Path) -> None:
        self._store = Store.open(Path(store))
        self._folder = objects
        self._objects: dict[str, ArticulatedObject] = {}
        self._adapters: dict[int, Adapter] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Take up the weights of a policy version."""
        while len(self._adapters) >= CACHED_POLICIES:
            self._adapters.pop(next(iter(self._adapters)))
        self._adapters[version] = Adapter(Policy.from_files(files))

    def run(self, plan: Plan, job: Job) -> Receipt:
        """Execute a job's rollouts and commit its shard; the same job again gives the same shard."""
        begun = time.perf_counter()
        clock = StageClock()
        records = []
        for index in range(job.start, job.stop):
            target = self._load(plan, index, clock)
            records.append(run_rollout(plan, index, target, partial(self._proposer, plan), clock))
        provenance = {"host": platform.node(), "pid": str(os.getpid())}
        with clock.stage("write"):
            manifest = self._store.commit(plan, job, records, provenance)
        clock.seconds["total"] = time.perf_counter() - begun
        return _receipt(manifest.shard_id, records, dict(clock.seconds))

    def _load(self, plan: Plan, index: int, clock: StageClock) -> ArticulatedObject:
        """The object of a rollout, as the plan knows it."""
        ref = object_of(plan, index)
        if ref.id not in self._objects:
            if len(self._objects) >= CACHED_OBJECTS:
                self._objects.pop(next(iter(self._objects)))
            with clock.stage("load"):
                self._objects[ref.id] = load_ref(self._folder, ref, plan.setting.collection.collision)
        return self._objects[ref.id]

    def _proposer(self, plan: Plan, name: str, rng: np.random.Generator, version: int) -> Proposer:
        """The proposer called `name`, of a policy version."""
        if name == RandomProposer.name:
            return RandomProposer(rng)
        if version not in self._adapters:
            self.load_policy(version, self._store.read_policy(version))
        return proposer_named(name, self._adapters[version], rng, plan.most_tries)


def _receipt(shard_id: str, records: list[RolloutRecord], seconds: dict[str, float]) -> Receipt:
    outcomes = [row.outcome for record in records for row in record.interactions]
    return Receipt(
        shard_id=shard_id,
        rollouts=len(records),
        interactions=len(outcomes),
        successes=sum(outcome.success for outcome in outcomes),
        outcomes=dict(Counter(outcome.kind.value for outcome in outcomes)),
        seconds=seconds,
    )
