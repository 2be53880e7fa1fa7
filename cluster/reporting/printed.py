"""Prints what summary.json says of a run: its tables and where its files are. It needs no library that draws."""

import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cluster.runs.run_folder import RunFolder, read_json
from shared.errors import UsageError
from shared.formatting import terminal_table
from shared.io.text import plain


def print_report(run: RunFolder) -> None:
    """Print the table of a run that was reported, and where its files are.

    Raises:
        UsageError: the run has no report yet.
    """
    if not run.summary.is_file():
        raise UsageError(f"{run.path}: has no report yet; finish the run with `adaafford resume {run.path}`")
    summary = read_json(run.summary)
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
    console.print(_results_table(summary))
    console.print(_rates_table(summary))
    for line in _lines(summary, run):
        console.print(plain(line), markup=False, soft_wrap=True)


def _results_table(summary: dict[str, Any]) -> Table:
    figures = ("f_score", "sample_success", "start_success", "trials", "best_f", "bce", "auc", "base_rate")
    names = ("method", "budget", *figures)
    rows = ([row.get(name) for name in names] for row in summary["rows"])
    title = f"{summary['task']}: objects not seen in training"
    return terminal_table(title, [name.replace("_", " ") for name in names], rows)


def _rates_table(summary: dict[str, Any]) -> Table:
    names = ("interactions", "successes", "success_rate")
    rates = summary["random_success_by_category"].items()
    rows = ([category, *(rate[name] for name in names)] for category, rate in rates)
    head = ["category", *(name.replace("_", " ") for name in names)]
    return terminal_table("random interactions, by category", head, rows)


def _lines(summary: dict[str, Any], run: RunFolder) -> list[str]:
    objects = summary["objects"]
    stages = ", ".join(f"{name} {seconds:g}" for name, seconds in summary["stage_seconds"].items())
    motions = ", ".join(
        f"{bin_['low']:g}+ {bin_['count']}" for bin_ in summary["random_motion_histogram"] if bin_["count"]
    )
    outcomes = ", ".join(f"{name} {each['share']:.1%}" for name, each in summary["outcomes"].items())
    speed = summary["interactions_per_core_second"]
    return [
        f"objects       {len(objects['train'])} train, {len(objects['validation'])} validation, "
        f"{len(objects['test'])} test, {len(objects['refused'])} refused (reasons in {run.objects_file.name})",
        f"interactions  {summary['interactions']}, {'unknown' if speed is None else speed} a core-second; "
        f"policy versions {', '.join(map(str, summary['policy_versions']))}",
        f"outcomes      {outcomes}",
        f"motions       {motions}",
        f"seconds       {stages}; in all {summary['wall_seconds']:g}",
        f"files         {_shown(run.summary)}  {_shown(run.picture)}  {_shown(run.page)}  {_shown(run.store)}",
    ]


def _shown(path: Path) -> str:
    return str(path) if path.exists() else f"(no {path.name})"
