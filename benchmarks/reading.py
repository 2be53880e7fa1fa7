"""How fast a store on a disk is read from Python, beside pyarrow and zarr alone on the same shards, from a warm cache.

Ours checks every file against its checksum and every cell against its column, and raw reading does not.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import pyarrow.parquet as pq
import zarr
from pydantic import Field

from benchmarks.script import main
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from shared.errors import StoreError
from shared.progress import Progress
from shared.store import Store
from shared.store.layout import INTERACTIONS_FILE, OBSERVATIONS_FOLDER, SHARDS_FOLDER
from shared.store.streaming import InteractionDataset

COLUMNS = ("point_index", "point", "rotation", "motion", "success")


class ReadingSettings(StoredSettings):
    """Time tables, clouds and samples for PyTorch, beside raw reading of the same shards."""

    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""


def measure(command: ReadingSettings) -> dict[str, Any]:
    """Measure, and print a table."""
    with stored(command) as store:
        shards = [store.path / SHARDS_FOLDER / part.shard.shard_id for part in store.parts()]
        rows = store.interactions(COLUMNS)
        if not len(rows):
            raise StoreError(f"{store.where}: holds no interaction; collect some first")
        ways: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
            "table, 5 columns": (
                lambda: store.interactions(COLUMNS),
                lambda: [pq.read_table(shard / INTERACTIONS_FILE, columns=list(COLUMNS)) for shard in shards],
            ),
            "clouds": (
                lambda: [store.read_observations(shard.name) for shard in shards],
                lambda: [_raw_clouds(str(shard / OBSERVATIONS_FOLDER)) for shard in shards],
            ),
            "samples with clouds": (
                lambda: _samples(store),
                lambda: [
                    (pq.read_table(shard / INTERACTIONS_FILE), _raw_clouds(str(shard / OBSERVATIONS_FOLDER)))
                    for shard in shards
                ],
            ),
        }
        read: dict[str, dict[str, float]] = {}
        with Progress("ways of reading", len(ways)) as progress:
            for name, (ours, raw) in ways.items():
                seconds = [(_seconds(ours), _seconds(raw)) for _ in range(command.repeats)]
                ours_s, raw_s = median(each[0] for each in seconds), median(each[1] for each in seconds)
                rates = {"interactions_per_second": len(rows) / ours_s, "raw_per_second": len(rows) / raw_s}
                read[name] = rates | {"times_raw": ours_s / raw_s}
                progress.advance()
        result = {"shards": len(shards), "interactions": len(rows), "read": read} | source_of(command, store)
    print(f"{result['interactions']} interactions in {result['shards']} shards, {command.repeats} times; medians")
    print(f"  {'reading':<22}{'interactions/s':>15}{'raw':>12}{'times raw':>11}")
    for name, figures in read.items():
        ours_rate, raw_rate = figures["interactions_per_second"], figures["raw_per_second"]
        print(f"  {name:<22}{ours_rate:>15,.0f}{raw_rate:>12,.0f}{figures['times_raw']:>11.1f}")
    return result


def _samples(store: Store) -> int:
    return sum(1 for _ in InteractionDataset(store, COLUMNS, clouds=("points", "movable")))


def _raw_clouds(path: str) -> list[Any]:
    group = zarr.open_group(path, mode="r")
    return [array[...] for _, array in group.arrays()]


def _seconds(act: Callable[[], object]) -> float:
    begun = time.perf_counter()
    act()
    return time.perf_counter() - begun


if __name__ == "__main__":
    main("reading", ReadingSettings, measure)
