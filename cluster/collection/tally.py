"""Progress of a collection: what its job results add up to, and how that is shown."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from shared.progress import Progress

if TYPE_CHECKING:
    from collector.job_result import JobResult

RECENT_S = 30.0
"""What a rate counts as recent."""
MAX_RECENT = 1024
"""Receipts that are remembered for it."""
MOST_OBJECTS = 5
"""Objects that the last line names for each reason why rollouts gave nothing."""
EMPTY = {
    "never-at-rest": "never at rest",
    "nothing-to-act-on": "with no part in sight that the task may act on",
    "ok": "cut short before the first",
}
"""What a status of rollouts without interactions means."""


@dataclass(slots=True)
class Tally:
    """What job results add up to, of this attempt alone."""

    rollouts: int = 0
    interactions: int = 0
    successes: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    """Of all workers together, by stage."""
    quarantined: int = 0
    """Rollouts that were given up."""
    empty: dict[str, dict[str, int]] = field(default_factory=dict)
    """Rollouts without interactions, by status and by object."""
    memory_mb: float = 0.0
    """Of the largest worker."""

    def add(self, job_result: "JobResult") -> None:
        """Count one job result."""
        self.rollouts += job_result.rollouts
        self.interactions += job_result.interactions
        self.successes += job_result.successes
        for name, count in job_result.outcomes.items():
            self.outcomes[name] = self.outcomes.get(name, 0) + count
        for name, seconds in job_result.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.quarantined += job_result.quarantined
        for status, objects in job_result.empty.items():
            of_status = self.empty.setdefault(status, {})
            for name, count in objects.items():
                of_status[name] = of_status.get(name, 0) + count
        self.memory_mb = max(self.memory_mb, job_result.memory_mb)

    @property
    def success_rate(self) -> float:
        """Of the interactions so far; 0 before the first."""
        return self.successes / self.interactions if self.interactions else 0.0


class CollectionProgress(Progress):
    """Shows how far a collection is; use as a context and call with each job result.

    Args:
        title: of the plan.
        done: rollouts that are committed already.
        total: rollouts wanted in all.
        leaves: what will be there in the end, such as the store's path.
        clock: monotonic seconds.
    """

    def __init__(
        self, title: str, done: int, total: int, leaves: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(title, total, unit="rollouts", done=done, leaves=leaves, details=self._rates, clock=clock)
        self.tally = Tally()
        self._already = done
        self._recent: deque[tuple[float, int]] = deque(maxlen=MAX_RECENT)
        """When job results came, and of how many interactions."""

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.tally.rollouts:
            empty = describe_empty(self.tally.empty)
            self.say("; ".join([f"{self.title}: {self.describe()}", *([empty] if empty else [])]))

    def __call__(self, job_result: "JobResult") -> None:
        """Take in one job result."""
        self.tally.add(job_result)
        self._recent.append((self._clock(), job_result.interactions))
        self.show(self._already + self.tally.rollouts)

    @property
    def recent_per_s(self) -> float:
        """Interactions a second of late."""
        now = self._clock()
        # A copy, since another thread may ask while job results come in.
        recent = [(moment, count) for moment, count in self._recent.copy() if now - moment < RECENT_S]
        since = self._recent[0][0] if len(self._recent) == MAX_RECENT else now - RECENT_S
        return sum(count for _, count in recent) / max(now - max(self._begun, since), 1e-9)

    def _rates(self) -> str:
        rate = self.tally.interactions / self.elapsed_s
        text = f"{rate:.0f} interactions/s, {self.tally.success_rate:.1%} successful"
        return text + (f", {self.tally.quarantined} quarantined" if self.tally.quarantined else "")


def describe_empty(empty: Mapping[str, Mapping[str, int]]) -> str:
    """How many rollouts gave no interaction, why, and of which objects; "" if there are none.

    Args:
        empty: how many, by status and by object.
    """
    if not empty:
        return ""
    count = sum(sum(objects.values()) for objects in empty.values())
    reasons = []
    for status, objects in sorted(empty.items()):
        most = sorted(objects.items(), key=lambda item: (-item[1], item[0]))
        named = ", ".join(f"{name} {number}" for name, number in most[:MOST_OBJECTS])
        more = f", {len(most) - MOST_OBJECTS} objects more" if len(most) > MOST_OBJECTS else ""
        reasons.append(f"{sum(objects.values())} {EMPTY.get(status, status)} ({named}{more})")
    return f"{count} rollouts gave no interaction: {'; '.join(reasons)}"
