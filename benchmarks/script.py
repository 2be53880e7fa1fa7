"""What the scripts here share: flags, one line for an error, a printed result, a dated file."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from cluster.cli.commands.bench import BenchSettings, flags_of, run_benchmark
from cluster.cli.main import begin_process, guarded, only_prints
from cluster.config.flags import parse_flags
from shared.errors import UsageError

Settings = TypeVar("Settings", bound=BenchSettings)
Measure = Callable[[Settings], dict[str, Any]]


def run_script(name: str, settings: type[Settings], measure: Measure[Settings], args: list[str]) -> int:
    """Run a benchmark as `adaafford bench` runs its own; returns the exit code."""

    def run() -> int:
        return run_benchmark(
            name, measure, parse_flags(flags_of(settings), args, name, program="python -m benchmarks.")
        )

    return guarded(run, [name, *args])


def main(name: str, settings: type[Settings], measure: Measure[Settings]) -> NoReturn:
    """Run the benchmark of this process and exit."""
    args = sys.argv[1:]
    streams = begin_process(stop_at_pipe=only_prints(args))
    sys.exit(streams.settle(run_script(name, settings, measure, args)))


def check_picture(flag: str, path: Path | None) -> None:
    """Refuse a picture that could not be kept, before the work that it shows.

    Raises:
        UsageError: it is no PNG, its folder is not there, or a folder has its name.
    """
    if path is None:
        return
    if path.suffix.lower() != ".png" or path.is_dir():
        raise UsageError(f"{flag} {path}: give the name of a PNG file")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{flag} {path}: its folder is not there; make it, or name another")
