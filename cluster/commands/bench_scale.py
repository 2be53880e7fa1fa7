"""`adaafford bench scale`: what actors and shards cost the driver, and what many more would."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import tyro
from pydantic import Field

from cluster.commands.bench import check_picture, finish
from cluster.commands.bench_learner import StoredSettings, source_of, stored
from cluster.settings import parse_flags
from shared.errors import UsageError
from shared.progress import Progress


class ScaleSettings(StoredSettings):
    """Of `adaafford bench scale`."""

    rollouts: int = Field(4, ge=1, le=4096)
    """Of the store that is made where none is given, whose first shard is the pattern of a large store."""
    actors: tuple[Annotated[int, Field(ge=1, le=100_000)], ...] = (10, 100, 300, 1000, 2000)
    """Numbers of sleeping actors; a hundred share a process."""
    processes: tuple[Annotated[int, Field(ge=1, le=1000)], ...] = (10, 30)
    """Numbers of sleeping actors with a process each, as collectors have: about 100 MB."""
    shards_per_s: float = Field(50.0, gt=0, le=10_000)
    """That each fleet makes: jobs sleep the longer, the more actors there are."""
    seconds: float = Field(30.0, gt=0, le=3600)
    """Of each fleet."""
    shards: tuple[Annotated[int, Field(ge=1, le=10_000_000)], ...] = (1000, 10_000, 100_000)
    """Numbers of shards of a store on a disk that is made up, listed and added to; in order."""
    predict_actors: int = Field(10_000, ge=1)
    """Predicted by what was measured."""
    predict_interactions: int = Field(10**9, ge=1)
    """Likewise."""
    interactions_per_s: float = Field(100.0, gt=0)
    """Of an actor that does not sleep; `adaafford bench collect` tells."""
    figure: Path | None = None
    """A PNG file to draw."""
    before: Path | None = None
    """An earlier result (a file of --out), drawn beside."""


@dataclass(frozen=True, slots=True)
class ScaleCommand:
    """Serve fleets of actors that sleep, and made-up stores; predict what many more of both would take."""

    settings: Annotated[ScaleSettings, tyro.conf.arg(name="")] = ScaleSettings()


def scale(args: list[str]) -> int:
    """`adaafford bench scale`."""
    command = parse_flags(ScaleCommand, args, "bench scale").settings
    if list(command.shards) != sorted(set(command.shards)):
        raise UsageError(f"--shards {' '.join(map(str, command.shards))}: give them in order, each once")
    check_picture("--figure", command.figure)
    from cluster.benchmarks import scaling
    from cluster.benchmarks.listing import ListingBenchmark

    before = _read(command.before)
    with stored(command) as source, TemporaryDirectory(prefix="adaafford-bench-") as scratch:
        result: dict[str, Any] = source_of(command, source)
        fleets = scaling.FleetBenchmark(
            source.plans()[0], command.actors, command.processes, command.shards_per_s, command.seconds
        )
        with Progress("fleets of sleeping actors", fleets.turns) as progress:
            fleets.run(progress.advance)
        listing = ListingBenchmark(source, Path(scratch) / "large", command.shards)
        with Progress("stores of made-up shards", listing.turns) as progress:
            listing.run(progress.advance)
        rollout = source.setting.collection.rollout.interactions
    result |= {"fleets": [asdict(point) for point in fleets.points]}
    result |= {"stores": [asdict(point) for point in listing.points]}
    result |= scaling.predictions(
        fleets.points,
        listing.points,
        scaling.Wish(command.predict_actors, command.predict_interactions, rollout, command.interactions_per_s),
    )
    _print(result)
    code = finish(command, "scale", result)
    if command.figure is not None:
        from cluster.benchmarks.scaling_figure import draw

        draw(result, before, command.figure)
        print(f"drawn in {command.figure}", file=sys.stderr)
    return code


def _read(path: Path | None) -> dict[str, Any] | None:
    """An earlier result.

    Raises:
        UsageError: the file is missing, or no result.
    """
    if path is None:
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["result"]
        _ = [point["driver_ms"] for point in found["fleets"]]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{path}: no result of `adaafford bench scale`; name a file that its --out left") from None
    return found


def _print(result: dict[str, Any]) -> None:
    print(f"  {'actors':<16}{'driver, ms a shard':>19}{'of the ideal':>14}{'driver, MB':>12}{'growth, B a shard':>19}")
    for each in result["fleets"]:
        name = f"{each['actors']} {'processes' if each['kind'] == 'process' else ''}"
        share, memory, growth = each["ideal_share"], each["memory_mb"], each["growth_bytes"]
        print(f"  {name:<16}{each['driver_ms']:>19.2f}{share:>14.1%}{memory:>12.0f}{growth:>19.0f}")
    print(f"  {'shards':<16}{'start, s':>10}{'start, MB':>11}{'commit, ms':>12}{'manifest, ms':>14}")
    for each in result["stores"]:
        manifest = "" if each["manifest_ms"] is None else f"{each['manifest_ms']:.2f}"
        print(f"  {each['shards']:<16}{each['start_s']:>10.2f}{each['start_mb']:>11.0f}", end="")
        print(f"{each['commit_ms']:>12.1f}{manifest:>14}")
    print("predicted: ", end="")
    wish = result["predicted_for"]
    print(f"{wish['actors']:,} actors of {wish['interactions_per_s']:g}/s, {wish['interactions']:,} interactions")
    print(f"  {'rollouts a shard':<18}{'job, s':>8}{'shards':>13}{'shards/s':>10}{'driver load':>13}{'start, s':>10}")
    for each in result["predictions"]:
        print(
            f"  {each['per_shard']:<18}{each['job_s']:>8.1f}{each['shards']:>13,}{each['shards_per_s']:>10,.0f}", end=""
        )
        print(f"{each['driver_load']:>13.2f}{each['start_s']:>10.1f}")
