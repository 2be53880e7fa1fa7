"""An estimate as people read it."""

import sys

from rich.console import Console

from cluster.children import THREADS
from cluster.estimate import Estimate, Rates
from shared.formatting import terminal_table


def print_estimate(estimate: Estimate, workers: int, rates: Rates) -> None:
    """Print the cost of each stage, and of all."""
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
    train, validation, test = estimate.objects
    rows, wall_s = [], 0.0
    for stage in estimate.stages:
        # Trials are shared by the workers; a network is trained by one process.
        stage_s = stage.core_s / (max(workers, 1) if stage.interactions else THREADS)
        wall_s += stage_s
        shown = f"{stage.interactions:,}" if stage.interactions else "-"
        rows.append((stage.stage, shown, _hours(stage.core_s), _hours(stage_s), _size(stage.size_bytes)))
    interactions = sum(stage.interactions for stage in estimate.stages)
    core_s = sum(stage.core_s for stage in estimate.stages)
    total = sum(stage.size_bytes for stage in estimate.stages)
    rows.append(("in all", f"{interactions:,}", _hours(core_s), _hours(wall_s), _size(total)))
    title = f"{estimate.task}: {train} objects to train on, {validation} to validate, {test} to test"
    table = terminal_table(title, ("stage", "interactions", "core-hours", "wall hours", "disk"), rows)
    table.rows[-1].style = "bold"
    console.print(table)
    console.print(
        f"wall hours    with {max(workers, 1)} workers for trials and {THREADS} threads for training\n"
        f"rates         measured {rates.measured}; expect a factor of two either way\n"
        "nothing was written",
        markup=False,
        soft_wrap=True,
    )


def _hours(seconds: float) -> str:
    hours = seconds / 3600
    return f"{hours:.2g}" if hours < 1 else f"{hours:,.1f}"


def _size(size_bytes: float) -> str:
    for unit, name in ((1e9, "GB"), (1e6, "MB")):
        if size_bytes >= unit:
            return f"{size_bytes / unit:,.1f} {name}"
    return f"{size_bytes / 1e3:,.0f} KB"
