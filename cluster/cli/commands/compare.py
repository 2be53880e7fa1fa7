"""`adaafford compare`: the runs of several seeds as one table, beside the paper's figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import OutFolder, parse_flags


@dataclass(frozen=True, slots=True)
class CompareCommand:
    """Pool the results of several runs of one task: all methods, beside the paper's figures, and run by run."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, such as seeds of one campaign."""
    evaluation: str | None = None
    """Prefix of a folder in each RUN/evaluations, which `adaafford evaluate` made; default: the final evaluation of
    each run."""
    out: OutFolder | None = None
    """A folder for comparison.md, comparison.png, comparison.csv and comparison.json."""


def main(args: list[str]) -> int:
    """Pool."""
    command = parse_flags(CompareCommand, args, "compare", CompareCommand(tyro.MISSING))
    from cluster.reporting.aggregation import (
        CSV_FILE,
        FIGURE_FILE,
        JSON_FILE,
        MARKDOWN_FILE,
        as_markdown,
        pool,
        write_comparison,
    )

    comparison = pool(command.runs, command.evaluation)
    print(as_markdown(comparison), end="")
    if command.out is not None:
        write_comparison(command.out, comparison)
        print(f"\n{command.out}: {MARKDOWN_FILE}, {FIGURE_FILE}, {CSV_FILE}, {JSON_FILE}")
    return 0
