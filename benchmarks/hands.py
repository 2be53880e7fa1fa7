"""Which hand is better where: success of random interactions with each hand, in the same states, with the same draws.

Object, state, camera, hidden dynamics and action of a rollout's interactions do not depend on the hand.
"""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import Field

from benchmarks.script import main
from cluster.cli.benchmarks.collecting import collect, jobs_of
from cluster.cli.commands.bench import BenchSettings, planned
from learner.metrics import ratio_interval
from shared.formatting import percent
from shared.plan import Plan
from shared.progress import Progress
from shared.store import Store

ALL = "all"


class HandSettings(BenchSettings):
    """Compare hands on the same random interactions, by category and kind of part."""

    task: str = "pull"
    """Which manipulation task, as for `adaafford collect`."""
    rollouts: int = Field(200, ge=1, le=1_000_000)
    """With each hand."""
    hands: tuple[str, ...] = ("panda", "suction")
    """The hands."""


def measure(command: HandSettings) -> dict[str, Any]:
    """Collect with each hand, and print a table."""
    found: dict[str, list[dict[str, Any]]] = {}
    with planned(command) as (plan, folder):
        turns = len(command.hands) * jobs_of(command.rollouts)
        with Progress(f"jobs of collection, {command.task}", turns) as progress:
            for hand in command.hands:
                setting = plan.setting.model_copy(
                    update={"collection": plan.setting.collection.model_copy(update={"gripper": hand})}
                )
                with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
                    store = Store.create(Path(scratch) / "store", setting)
                    collect(Plan(setting=setting), folder, command.rollouts, store, progress.advance)
                    columns = ["object_id", "object_category", "joint_twist", "outcome", "success"]
                    found[hand] = store.interactions(columns).to_pylist()
    groups = {hand: _grouped(rows) for hand, rows in found.items()}
    names = sorted({name for of_hand in groups.values() for name in of_hand}, key=lambda name: (name[0] != ALL, name))
    print(f"| category | part | objects | {' | '.join(f'{hand}: success | {hand}: held' for hand in command.hands)} |")
    print(f"| --- | --- | --- | {' | '.join(['---'] * 2 * len(command.hands))} |")
    figures = []
    for name in names:
        of_hands = {hand: _figures(groups[hand].get(name, [])) for hand in command.hands}
        objects = max(each["objects"] for each in of_hands.values())
        cells = [
            cell
            for each in of_hands.values()
            for cell in (percent(each["success"], each["success_interval"]), percent(each["held"]))
        ]
        print(f"| {' | '.join([*name, str(objects), *cells])} |")
        figures.append({"category": name[0], "part": name[1], "hands": of_hands})
    return {"rollouts": command.rollouts, "groups": figures}


def _grouped(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Rows by category and kind of part, and of all categories together."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        part = "turns" if np.any(row["joint_twist"][:3]) else "slides"
        for name in ((row["object_category"], part), (ALL, part), (ALL, ALL)):
            groups.setdefault(name, []).append(row)
    return groups


def _figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of a group; held is the share in which the hand held something when it had closed."""
    success = np.array([row["success"] for row in rows], dtype=bool)
    held = np.array([row["outcome"] == "ok" for row in rows], dtype=bool)
    objects = np.unique([row["object_id"] for row in rows], return_inverse=True)[1]
    return {
        "trials": len(rows),
        "objects": len(set(objects.tolist())),
        "success": float(success.mean()) if rows else float("nan"),
        "success_interval": ratio_interval(success, np.ones(len(rows)), objects),
        "held": float(held.mean()) if rows else float("nan"),
    }


if __name__ == "__main__":
    main("hands", HandSettings, measure)
