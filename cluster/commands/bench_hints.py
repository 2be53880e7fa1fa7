"""`adaafford bench hints`: what one try does to the heatmap of a hinged door."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import Field

from cluster.commands.bench import check_picture, finish
from cluster.commands.bench_learner import StoredSettings, source_of, stored
from cluster.settings import parse_flags
from shared.formatting import percent
from shared.progress import Progress


class HintsSettings(StoredSettings):
    """Of `adaafford bench hints`."""

    task: str = "pull-closed-door"
    """Of the store that is made where none is given; its parts must turn."""
    seed: int = Field(1_000, ge=0, lt=2**63)
    """Of the store that is made: not the training's, whose built-in objects would be the same."""
    procedural_per_category: int = Field(40, ge=1, le=10_000)
    """Its built-in objects: how many of each category that the task applies to."""
    rollouts: int = Field(120, ge=2, le=1_000_000)
    """Of the store that is made."""
    policy: str = "pull-closed-door"
    """Whose heatmaps: a name of those that the package brings, a folder, or a run."""
    picture: Path | None = None
    """A PNG of the first four objects before and after a success on the free side."""


@dataclass(frozen=True, slots=True)
class HintsCommand:
    """Say what a single try does to the affordance near a door's hinge, and far from it."""

    settings: Annotated[HintsSettings, tyro.conf.arg(name="")] = HintsSettings()


def hints(args: list[str]) -> int:
    """`adaafford bench hints`."""
    command = parse_flags(HintsCommand, args, "bench hints").settings
    from adaafford.pretrained import load_policy
    from cluster.adoption import seen_by, unknown
    from cluster.benchmarks.hinting import HintBenchmark, draw_hints, fit_for_hints

    policy = load_policy(command.policy)
    check_picture("--picture", command.picture)
    if command.store is None:
        fit_for_hints(policy, command.task)
    if not (seen := seen_by(command.policy)):
        print(f"--policy {unknown(command.policy)}", file=sys.stderr)
    with stored(command) as store:
        benchmark = HintBenchmark(store, policy, seen)
        with Progress("shards of hints", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store) | {"policy": command.policy}
    _print(result)
    code = finish(command, "hints", result)
    if command.picture is not None and draw_hints(benchmark.hints, policy.task, command.picture):
        print(f"drawn in {command.picture}", file=sys.stderr)
    return code


def _print(result: dict[str, Any]) -> None:
    print("affordance of a door's free and hinge side before and after one random try, and in how many it rose")
    for case, figures in result["cases"].items():
        told, side = case.split("-")
        print(f"  {told} on the {side} side: {figures['tries']} tries of {figures['objects']} objects")
        for name in ("free", "hinge"):
            of = figures[name]
            rose = percent(of["brighter"], of["brighter_interval"], decimals=0)
            print(f"    {name:<6}{of['before']:.3f} -> {of['after']:.3f}, rose in {rose}%")
