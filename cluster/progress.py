"""Progress of a collection: a live bar on a terminal, plain lines every few seconds elsewhere."""

import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn
from rich.text import Text

from shared.plain import plain

if TYPE_CHECKING:
    from rich.progress import Task

    from collector.receipt import Receipt

LINE_EVERY_S = 5.0
RECENT_S = 30.0
"""What a rate counts as recent."""
MOST_OBJECTS = 5
"""Objects that the last line names for each reason why rollouts gave nothing."""
EMPTY = {
    "never-at-rest": "never at rest",
    "nothing-to-act-on": "with no part in sight that the task may act on",
    "ok": "cut short before the first",
}
"""What a status of rollouts without interactions means."""
MAX_RECENT = 1024
"""Receipts that are remembered for it."""


@dataclass(slots=True)
class Tally:
    """What receipts add up to, of this attempt alone."""

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

    def add(self, receipt: "Receipt") -> None:
        """Count one receipt."""
        self.rollouts += receipt.rollouts
        self.interactions += receipt.interactions
        self.successes += receipt.successes
        for name, count in receipt.outcomes.items():
            self.outcomes[name] = self.outcomes.get(name, 0) + count
        for name, seconds in receipt.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.quarantined += receipt.quarantined
        for status, objects in receipt.empty.items():
            of_status = self.empty.setdefault(status, {})
            for name, count in objects.items():
                of_status[name] = of_status.get(name, 0) + count
        self.memory_mb = max(self.memory_mb, receipt.memory_mb)

    @property
    def success_rate(self) -> float:
        """Of the interactions so far; 0 before the first."""
        return self.successes / self.interactions if self.interactions else 0.0


class CollectionProgress:
    """Shows how far a collection is; use as a context and call with each receipt."""

    def __init__(self, title: str, done: int, total: int, leaves: str, clock: Callable[[], float] = time.monotonic):
        """Say what is there and what is left.

        Args:
            title: of the plan.
            done: rollouts that are committed already.
            total: rollouts wanted in all.
            leaves: what will be there in the end, such as the store's path.
            clock: monotonic seconds.
        """
        self.tally = Tally()
        self._console = Console(file=sys.stderr, highlight=False)
        self._title, self._done, self._total, self._leaves, self._clock = title, done, total, leaves, clock
        self._begun = self._last_line = clock()
        self._bar: Progress | None = None
        self._recent: deque[tuple[float, int]] = deque(maxlen=MAX_RECENT)
        """When receipts came, and of how many interactions."""

    def __enter__(self) -> "CollectionProgress":
        left = self._total - self._done
        self.say(f"{self._title}: {self._done} of {self._total} rollouts are there, {left} left; into {self._leaves}")
        self._begun = self._last_line = self._clock()
        if self._console.is_terminal and left > 0:
            columns: list[ProgressColumn] = [SpinnerColumn(), TextColumn("{task.description}"), BarColumn()]
            self._bar = Progress(*columns, _Rates(self), console=self._console, transient=True)
            self._bar.add_task(self._title, total=self._total, completed=self._done)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        if self.tally.rollouts:
            empty = describe_empty(self.tally.empty)
            self.say("; ".join([f"{self._title}: {self.describe()}", *([empty] if empty else [])]))

    def __call__(self, receipt: "Receipt") -> None:
        """Take in one receipt."""
        self.tally.add(receipt)
        self._recent.append((self._clock(), receipt.interactions))
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self._done + self.tally.rollouts)
        elif self._done + self.tally.rollouts < self._total and self._clock() - self._last_line >= LINE_EVERY_S:
            self._last_line = self._clock()
            self.say(f"{self._title}: {self.describe()}")

    @property
    def elapsed_s(self) -> float:
        """Since work began in this attempt."""
        return max(self._clock() - self._begun, 1e-9)

    @property
    def recent_per_s(self) -> float:
        """Interactions a second of late."""
        now = self._clock()
        # A copy, since another thread may ask while receipts come in.
        recent = [(moment, count) for moment, count in self._recent.copy() if now - moment < RECENT_S]
        since = self._recent[0][0] if len(self._recent) == MAX_RECENT else now - RECENT_S
        return sum(count for _, count in recent) / max(now - max(self._begun, since), 1e-9)

    def describe(self) -> str:
        """Done and left, speed, success rate and time left, in one line."""
        done = self._done + self.tally.rollouts
        rate = self.tally.interactions / self.elapsed_s
        text = f"{done}/{self._total} rollouts, {rate:.0f} interactions/s, {self.tally.success_rate:.1%} successful"
        if self.tally.quarantined:
            text += f", {self.tally.quarantined} quarantined"
        if self.tally.rollouts > 0 and done < self._total:
            left_s = (self._total - done) * self.elapsed_s / self.tally.rollouts
            text += f", {_minutes(left_s)} left"
        return text

    def say(self, line: str) -> None:
        """Print a line."""
        self._console.print(plain(line), soft_wrap=True, markup=False)


class _Rates(ProgressColumn):
    """The changing part of the live bar."""

    def __init__(self, progress: CollectionProgress) -> None:
        super().__init__()
        self._progress = progress

    def render(self, task: "Task") -> Text:
        """See `rich.progress.ProgressColumn`."""
        return Text(self._progress.describe())


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


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02d} min"
