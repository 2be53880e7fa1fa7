"""How training goes, for whoever waits: a live bar on a terminal, a plain line every few seconds elsewhere."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

LINE_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class Standing:
    """Where a run stands.

    Attributes:
        step: steps done, over all sittings.
        loss: sum of the losses of the last step.
        interactions: seen, over all sittings.
        seconds: spent on steps, over all sittings.
        best_score: of the validations; None before the first.
    """

    step: int
    loss: float
    interactions: int
    seconds: float
    best_score: float | None


class ProgressReport:
    """Tells how a run stands.

    A pipe gets plain lines, since a bar needs a terminal; a campaign reads them from its learners and passes them on.

    Args:
        title: what is trained.
        steps: the most that there will be.
        limit: the most seconds of steps, if there is a limit.
        done: steps done in earlier sittings.
        live: whether to draw a bar; None: where both standard streams are terminals.
        silent: say nothing at all, since another process speaks for this one.
        say: gets the plain lines.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        title: str,
        steps: int,
        limit: float | None = None,
        done: int = 0,
        *,
        live: bool | None = None,
        silent: bool = False,
        say: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._steps, self._limit, self._done = title, steps, limit, done
        self._say = _say_nothing if silent else say or _print_line
        self._clock = clock
        self._began = self._said = clock()
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if not silent and (live or (live is None and sys.stdout.isatty() and sys.stderr.isatty())):
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._task = self._bar.add_task(title, total=steps, completed=done, state="")

    def __enter__(self) -> "ProgressReport":
        """Begin to draw, where a bar is drawn."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the terminal as it was."""
        if self._bar is not None:
            self._bar.stop()

    def update(self, standing: Standing) -> None:
        """A step was done; says so if the last line is some seconds old."""
        if self._bar is not None:
            self._bar.update(self._task, completed=standing.step, state=_state(standing))
        elif self._clock() - self._said >= LINE_SECONDS:
            self._said = self._clock()
            left = self._left(standing)
            self._say(
                f"{self._title}: step {standing.step}/{self._steps}, {_state(standing)}, {_minutes(left)} min left"
            )

    def finish(self, standing: Standing, best_step: int) -> None:
        """The run has ended."""
        rate = standing.interactions / max(standing.seconds, 1e-9)
        best = "" if standing.best_score is None else f", best score {standing.best_score:.4f} at step {best_step}"
        self._say(
            f"{self._title}: {standing.step} steps in {_minutes(standing.seconds)} min, "
            f"{rate:,.0f} interactions/s{best}"
        )

    def _left(self, standing: Standing) -> float:
        """Seconds left if all steps are done at this sitting's pace, validation included, within the limit."""
        pace = (self._clock() - self._began) / max(standing.step - self._done, 1)
        left = pace * (self._steps - standing.step)
        return left if self._limit is None else min(left, max(self._limit - standing.seconds, 0.0))


def _state(standing: Standing) -> str:
    rate = standing.interactions / max(standing.seconds, 1e-9)
    best = "" if standing.best_score is None else f", best score {standing.best_score:.4f}"
    return f"loss {standing.loss:.4f}, {rate:,.0f} interactions/s{best}"


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"


def _print_line(line: str) -> None:
    print(line, flush=True)


def _say_nothing(_: str) -> None:
    pass
