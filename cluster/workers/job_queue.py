"""The job queue: which rollouts are made next, and under which plan.

    queue = RolloutQueue(lambda: plan, missing_ranges(100, done), per_shard=4)
    while (planned := queue.take()) is not None: ...

The rollouts of a proposer have one numbering over all versions of its policy. Each number is handed out once, under the
current plan: the plan of the given version, or, if the collection follows a learner, that of the newest version. Rounds
and continuous collection differ only in how many rollouts a version may have.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from shared.plan import Job, Plan
from shared.store import Store

NOTHING: Mapping[str, int] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class PlannedJob:
    """A job and its plan; a retry keeps the plan."""

    plan: Plan
    job: Job


class JobQueue(Protocol):
    """Jobs that are created on demand."""

    @property
    def ended(self) -> bool:
        """Whether no more jobs follow."""
        ...

    @property
    def any_done(self) -> bool:
        """Whether some of the rollouts were done before this attempt."""
        ...

    def take(self) -> PlannedJob | None:
        """The next job; None if there is none, or none yet (see `ended`)."""
        ...


class RolloutQueue:
    """The missing rollouts of one proposer.

    Args:
        plan_now: gives the current plan; None while there is none.
        missing: numbers of the missing rollouts, as half-open ranges.
        per_shard: the most rollouts of one job.
        per_plan: the most rollouts of one plan, after which the queue waits for the next plan; None: no limit.
        held: how many rollouts the store already has of each plan, by the plan's key.
    """

    def __init__(
        self,
        plan_now: Callable[[], Plan | None],
        missing: Sequence[tuple[int, int]],
        per_shard: int,
        per_plan: int | None = None,
        held: Mapping[str, int] = NOTHING,
    ) -> None:
        self._plan_now = plan_now
        self._missing = list(reversed(missing))
        self._per_shard = per_shard
        self._per_plan = per_plan
        self._handed_out = Counter(held)
        self.any_done = any(held.values())
        self.waiting = False
        """Whether the last call of `take` had to wait for another plan."""

    @property
    def ended(self) -> bool:
        """See `JobQueue.ended`."""
        return not self._missing

    def take(self) -> PlannedJob | None:
        """See `JobQueue.take`."""
        if self.ended:
            return None
        plan = self._plan_now()
        most = 0 if plan is None else self._most(plan)
        self.waiting = most < 1
        if plan is None or self.waiting:
            return None
        start, end = self._missing.pop()
        stop = min(start + most, end)
        if stop < end:
            self._missing.append((stop, end))
        self._handed_out[plan.key] += stop - start
        return PlannedJob(plan, Job(plan.key, start, stop))

    def _most(self, plan: Plan) -> int:
        """The most rollouts of the next job of a plan."""
        if self._per_plan is None:
            return self._per_shard
        return min(self._per_shard, self._per_plan - self._handed_out[plan.key])


LOOK_S = 2.0
"""How often the store is searched for newer policies, s."""


class PolicySource:
    """The current plan of one proposer; call the object to get it.

    A new policy takes effect within `LOOK_S` seconds of its publication. Jobs that were handed out before, at most two
    for each actor, and their retries are still executed with the old policy.

    Args:
        store: where policies are published.
        proposer: its name.
        version: of the policy; None: always the newest.
        announce: called with each new plan before it is used; gives its policy to the workers.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        store: Store,
        proposer: str,
        version: int | None,
        announce: Callable[[Plan], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._proposer = proposer
        self._version = version
        self._announce = announce
        self._clock = clock
        self._looked = -LOOK_S
        self.plan: Plan | None = None

    def __call__(self) -> Plan | None:
        """The current plan; None while no policy is published.

        Raises:
            StoreError: the policy is not in the store, or damaged.
        """
        if self._version is None:
            self._look()
        elif self.plan is None:
            self._use(self._version)
        return self.plan

    def _look(self) -> None:
        if self._clock() - self._looked < LOOK_S:
            return
        self._looked = self._clock()
        newest = max(self._store.policy_versions(), default=0)
        if newest > (0 if self.plan is None else self.plan.policy_version):
            self._use(newest)

    def _use(self, version: int) -> None:
        plan = Plan(setting=self._store.setting, proposer=self._proposer, policy_version=version)
        self._announce(plan)
        self.plan = plan
