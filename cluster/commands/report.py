"""`adaafford report`: print a run's results again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.settings import parse_flags


@dataclass(frozen=True, slots=True)
class ReportCommand:
    """Print the table of a finished run; summary.json and affordance.png are made anew."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""


def main(args: list[str]) -> int:
    """Report."""
    command = parse_flags(ReportCommand, args, "report")
    from cluster.ledger import Ledger
    from cluster.report import print_report, write_report
    from cluster.run_folder import find

    run, config = find(command.run)
    if "evaluate" in Ledger(run.log).finished:
        write_report(run, config)
    print_report(run)
    return 0
