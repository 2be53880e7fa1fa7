"""`adaafford status`: the live status of a run, a store or a learner."""

import json
import sys
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import Field

from cluster.config.flags import parse_flags

if TYPE_CHECKING:
    from rich.table import Table

    from cluster.runs.status_snapshot import StatusSnapshot, StoreSnapshot, TrainingSnapshot

MOST_WORKERS = 12
"""Workers that the table shows; --json has all."""
MOST_METRICS = 6


@dataclass(frozen=True, slots=True)
class StatusCommand:
    """Show the status: on a terminal until Ctrl-C, otherwise once; only reads files, and disturbs no process."""

    where: Annotated[str, tyro.conf.Positional]
    """Folder of a run, of a learner or of a store, or s3:// URL of a store."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object, once."""
    once: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the table once, also on a terminal."""
    every: Annotated[float, Field(gt=0)] = 2.0
    """Seconds between two updates."""


def main(args: list[str]) -> int:
    """Show."""
    command = parse_flags(StatusCommand, args, "status")
    from cluster.runs.status_snapshot import snapshot_of

    if command.json:
        print(json.dumps(as_json(snapshot_of(command.where)), indent=2))
    elif command.once or not sys.stdout.isatty():
        from rich.console import Console

        Console(highlight=False).print(table(snapshot_of(command.where), time.time()))
    else:
        _watch(command)
    return 0


def _watch(command: StatusCommand) -> None:
    from rich.live import Live

    from cluster.runs.status_snapshot import snapshot_of

    with Live(table(snapshot_of(command.where), time.time()), auto_refresh=False) as live:
        while True:
            time.sleep(command.every)
            live.update(table(snapshot_of(command.where), time.time()), refresh=True)


def as_json(snapshot: "StatusSnapshot") -> dict[str, Any]:
    """All that is known, and what follows from it."""
    told = asdict(snapshot)
    for entry, store in zip(told["stores"], snapshot.stores, strict=True):
        driver = store.driver
        if driver is not None:
            entry["driver"] = driver.model_dump() | {
                "left": driver.left,
                "left_s": driver.left_s,
                "success_rate": driver.success_rate,
                "per_s": driver.per_s,
            }
    return told


def table(snapshot: "StatusSnapshot", now: float) -> "Table":
    """The same for people.

    Args:
        snapshot: what is known.
        now: seconds since 1970.
    """
    from rich.table import Table
    from rich.text import Text

    from shared.io.text import plain

    shown = Table(show_header=False, box=None, padding=(0, 2, 0, 0))

    def row(name: str, value: str) -> None:
        # As plain text: names and files may hold what rich takes for markup, or a terminal for commands.
        shown.add_row(Text(name, style="dim"), Text(plain(value)))

    if snapshot.what != "store":
        row(snapshot.what, snapshot.where)
    if snapshot.what == "run":
        row("stages done", ", ".join(snapshot.stages_done) or "none")
        row("stage", f"{snapshot.stage}, {_duration(snapshot.stage_s)}" if snapshot.stage else "none under way")
    for store in snapshot.stores:
        for name, value in _store_rows(store, now):
            row(name, value)
    if snapshot.training is not None:
        row("training", _training_line(snapshot.training, now))
    return shown


def _store_rows(store: "StoreSnapshot", now: float) -> list[tuple[str, str]]:
    from cluster.collection.status_writer import SILENT_S

    held = ", ".join(f"{key} {count}" for key, count in store.rollouts.items()) or "none"
    policies = f"{len(store.policies)}, newest {store.policies[-1]}" if store.policies else "none"
    rows = [("store", store.where), ("rollouts", held), ("policies", policies)]
    driver = store.driver
    if driver is None:
        return [*rows, ("collection", "none has begun")]
    state = driver.state if store.driver_alive or driver.state in ("done", "stopped") else "its driver is gone"
    ago = f"{_duration(now - driver.written)} ago"
    if driver.written - now >= SILENT_S:
        ago = f"by a clock that is {_duration(driver.written - now)} ahead of this machine's"
    rows += [
        ("collection", f"{driver.title}: {state}, written {ago}"),
        ("done", f"{driver.done} of {driver.total} rollouts, {driver.left} left{_left(driver.left_s)}"),
        ("rate", f"{driver.recent_per_s:.1f} interactions/s of late, {driver.per_s:.1f} in all"),
        ("successful", f"{driver.success_rate:.1%} of {driver.interactions} interactions"),
        ("outcomes", ", ".join(f"{kind} {count}" for kind, count in sorted(driver.outcomes.items())) or "none"),
        ("workers", f"{driver.workers}, {driver.restarts} replaced; {driver.quarantined} rollouts quarantined"),
        ("policy", "waiting for the first" if driver.policy is None else f"version {driver.policy}"),
    ]
    if store.driver_alive:
        for worker in store.workers[:MOST_WORKERS]:
            doing = "between rollouts" if worker.rollout is None else f"rollout {worker.rollout}"
            _, number, _ = (*worker.process.split("~", 2), "", "")[:3]
            where = f"process {number} on {worker.host}" if worker.host else worker.process
            rows.append(("worker", f"{where}: {worker.shard_id}, {doing}"))
        if len(store.workers) > MOST_WORKERS:
            rows.append(("", f"and {len(store.workers) - MOST_WORKERS} more"))
    return rows


def _training_line(training: "TrainingSnapshot", now: float) -> str:
    figures = ", ".join(f"{name} {value:.4g}" for name, value in list(training.metrics.items())[:MOST_METRICS])
    return f"{training.stage}, step {training.step}, {_duration(now - training.written)} ago: {figures}"


def _left(seconds: float | None) -> str:
    return "" if seconds is None else f", {_duration(seconds)} to go"


def _duration(seconds: float) -> str:
    whole = max(round(seconds), 0)
    hours, rest = divmod(whole, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"
