"""Progress of a benchmark: a live bar with the time left on a terminal, plain lines every few seconds elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_EVERY_S = 5.0

Advance = Callable[[], None]
"""Says that one more is done."""


@contextmanager
def progress(title: str, total: int) -> Iterator[Advance]:
    """Show how far a benchmark is, on standard error.

    Args:
        title: what is counted.
        total: how many there will be.
    """
    console = Console(file=sys.stderr, highlight=False)
    if not console.is_terminal:
        yield _Lines(console, title, total)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.update(task, advance=1)


@contextmanager
def advancing(title: str) -> Iterator[Callable[[int, int], None]]:
    """The same for work that says itself how much is done, and how much there is, each time."""
    with ExitStack() as stack:
        shown: dict[int, Advance] = {}

        def show(done: int, total: int) -> None:
            if done == 1 or total not in shown:
                stack.pop_all().close()
                shown.clear()
                shown[total] = stack.enter_context(progress(title, total))
            shown[total]()

        yield show


class _Lines:
    """A line every few seconds."""

    def __init__(self, console: Console, title: str, total: int) -> None:
        self._console, self._title, self._total, self._done = console, title, total, 0
        self._begun = self._last = time.monotonic()

    def __call__(self) -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._last >= LINE_EVERY_S and self._done < self._total:
            self._last = now
            left_s = (now - self._begun) / self._done * (self._total - self._done)
            line = f"{self._title}: {self._done}/{self._total}, about {left_s:.0f} s left"
            self._console.print(line, soft_wrap=True, markup=False)
