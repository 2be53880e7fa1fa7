"""`adaafford bench store`: what storing costs, and how fast a store is read."""

from dataclasses import dataclass
from typing import Annotated

import tyro
from pydantic import Field

from cluster.commands.bench import finish
from cluster.commands.bench_learner import StoredSettings, source_of, stored
from cluster.settings import parse_flags
from shared.progress import Progress


class StoreSettings(StoredSettings):
    """Of `adaafford bench store`."""

    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""
    bucket: bool = True
    """Whether a bucket is measured as well, on an S3 server that is started on loopback for it."""


@dataclass(frozen=True, slots=True)
class StoreCommand:
    """Time commits, and reading everything again from a cold and a warm disk and from a bucket, beside raw reading."""

    settings: Annotated[StoreSettings, tyro.conf.arg(name="")] = StoreSettings()


def store(args: list[str]) -> int:
    """`adaafford bench store`."""
    command = parse_flags(StoreCommand, args, "bench store").settings
    from cluster.benchmarks.storing import StoringBenchmark

    with stored(command) as source:
        benchmark = StoringBenchmark(source, command.repeats, command.bucket)
        with Progress("turns of writing and reading", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, source)
    print(f"{result['interactions']} interactions in {result['shards']} shards, {command.repeats} times; medians")
    print(f"  bytes an interaction  {result['bytes_per_interaction']:.0f}")
    for name, cost in result["commit_ms_per_shard"].items():
        each = result["commit_ms_per_interaction"][name]
        print(f"  commit, {name:<13} {cost:.1f} ms a shard, {each:.2f} ms an interaction")
    print(f"  {'reading':<14}{'interactions/s':>15}{'MB/s':>8}{'raw MB/s':>10}{'times raw':>11}")
    for name, figures in result["read"].items():
        rate, speed = figures["interactions_per_second"], figures["megabytes_per_second"]
        raw = figures["raw_megabytes_per_second"]
        print(f"  {name:<14}{rate:>15,.0f}{speed:>8.1f}{raw:>10.1f}{figures['times_raw']:>11.1f}")
    return finish(command, "store", result)
