"""`adaafford report`: the results of a run as a page and on the terminal."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import parse_flags


@dataclass(frozen=True, slots=True)
class ReportCommand:
    """Write RUN/report.html, summary.json and affordance.png of a finished run again, and print its table."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    experiments: bool = True
    """Simulate a test object with other hidden facts, and show the affordance for each of them."""


def main(args: list[str]) -> int:
    """Report."""
    command = parse_flags(ReportCommand, args, "report")
    from cluster.reporting.printed import print_report
    from cluster.runs.run_folder import find
    from cluster.runs.run_log import RunLog

    run, config = find(command.run)
    if "evaluate" in RunLog(run.log).finished:
        from cluster.reporting.report import write_report

        write_report(run, config, experiments=command.experiments, say=_say)
    print_report(run)
    return 0


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
