"""The job queue: which rollouts are made next, and under which plan.

    queue = RolloutQueue(lambda: plan, missing_ranges(100, done), per_shard=4)
    while (order := queue.take()) is not None: ...

A proposer makes a *series* of numbered rollouts, whichever versions of a policy it uses. Each number is handed out
once, under the plan that is in force at that moment: always the same where a version was named, that of the newest
version where the series follows a learner. All that tells rounds from continuous collection
is how many rollouts a version may have.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from shared.plan import Job, Plan

NOTHING: Mapping[str, int] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class PlannedJob:
    """A job and its plan. A job that failed is tried again under the plan that it was handed out with."""

    plan: Plan
    job: Job


class JobQueue(Protocol):
    """Jobs that are made up as they are asked for."""

    @property
    def ended(self) -> bool:
        """Whether there will be no more."""
        ...

    @property
    def any_done(self) -> bool:
        """Whether some of what they are part of was done before."""
        ...

    def take(self) -> PlannedJob | None:
        """The next one; None where there is none, or none yet: `ended` tells which."""
        ...


class RolloutQueue:
    """The rollouts of one proposer that are left to do.

    Args:
        plan_now: the plan in force; None while there is none, and all have to wait.
        missing: numbers that are left to do, as half-open ranges.
        per_shard: the most rollouts of one job.
        per_plan: the most rollouts of one plan, after which the series waits for the next one; None: no bound.
        held: how many rollouts of each plan, by its key, are there already.
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
        """Whether the last one that asked had to wait for another plan."""

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
        """Rollouts that the next job of a plan may have."""
        if self._per_plan is None:
            return self._per_shard
        return min(self._per_shard, self._per_plan - self._handed_out[plan.key])
