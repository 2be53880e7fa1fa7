"""Progress of long work: a live bar on a terminal, elsewhere a plain line every few seconds.

with Progress("merging, shards", leaves="STORE") as progress:
    merge(..., progress.show)            # called with the number of done items and the total
"""

import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, TextColumn
from rich.progress import Progress as Bar
from rich.text import Text

from shared.io.text import plain

if TYPE_CHECKING:
    from rich.progress import Task

LINE_EVERY_S = 5.0
BAR_WIDTH = 20
Advance = Callable[[], None]
"""Says that one more is done."""


class Progress:
    """Shows the progress of some work on standard error; use it as a context manager.

    Args:
        title: name of the work.
        total: number of items; 0 if `show` gives it later.
        unit: name of the items, if the title does not contain it.
        done: number of items that are already done; the speed is that of the others.
        leaves: the result, such as the path of a store, for a first line.
        details: further text of a line, such as a rate; called when the line is shown.
        live: whether to draw a bar; None: if standard error is a terminal.
        say: prints a line; None: on standard error.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        title: str,
        total: int = 0,
        *,
        unit: str = "",
        done: int = 0,
        leaves: str = "",
        details: Callable[[], str] | None = None,
        live: bool | None = None,
        say: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.title, self.total, self.done = title, total, done
        self._unit, self._leaves, self._details, self._clock = f" {unit}" if unit else "", leaves, details, clock
        self._console = Console(file=sys.stderr, highlight=False)
        self._live = self._console.is_terminal if live is None else live
        self._say = say or self._print
        self._bar: Bar | None = None
        self._most_left_s = math.inf
        self._begun: float
        self._last_line: float
        self._begun_at: int
        self._begin(done)

    def __enter__(self) -> "Progress":
        self._begin(self.done)
        if self._leaves:
            left = self.total - self.done
            self.say(
                f"{self.title}: {self.done} of {self.total}{self._unit} are there, {left} left; into {self._leaves}"
            )
        if self._live and (self.done < self.total or not self.total):
            columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(BAR_WIDTH), _Described(self)
            self._bar = Bar(*columns, console=self._console, transient=True)
            self._bar.add_task(plain(self.title), total=self.total or None, completed=self.done)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self) -> None:
        """Count one more item."""
        self.show(self.done + 1)

    def show(self, done: int, total: int | None = None, most_left_s: float = math.inf) -> None:
        """Set the number of done items.

        Args:
            done: of all.
            total: how many there are; another number, or fewer done than before, begins another piece of work.
            most_left_s: seconds after which the work ends in any case.
        """
        if total is not None and (total != self.total or done < self.done):
            if self.total:
                self._begin(done)
            self.total = total
        self.done, self._most_left_s = done, most_left_s
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=done, total=self.total)
        elif done < self.total and self._clock() - self._last_line >= LINE_EVERY_S:
            self._last_line = self._clock()
            self.say(f"{self.title}: {self.describe()}")

    @property
    def elapsed_s(self) -> float:
        """Since the work began."""
        return max(self._clock() - self._begun, 1e-9)

    def describe(self) -> str:
        """Done and remaining items, details, and the remaining time at the present speed, in one line."""
        parts = [f"{self.done}/{self.total}{self._unit}"] if self.total else []
        if self._details is not None:
            parts.append(self._details())
        if self._begun_at < self.done < self.total:
            left_s = (self.total - self.done) * self.elapsed_s / (self.done - self._begun_at)
            parts.append(f"{minutes(min(left_s, self._most_left_s))} left")
        return ", ".join(parts)

    def say(self, line: str) -> None:
        """Print a line."""
        self._say(plain(line))

    def _begin(self, done: int) -> None:
        self._begun = self._last_line = self._clock()
        self._begun_at = done

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, markup=False)


class _Described(ProgressColumn):
    """The changing text of the live bar."""

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self._progress = progress

    def render(self, task: "Task") -> Text:
        """See `rich.progress.ProgressColumn`."""
        return Text(plain(self._progress.describe()))


def minutes(seconds: float) -> str:
    """Seconds as minutes, such as "1:05 min"."""
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d} min"
