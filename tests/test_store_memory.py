"""Memory of whoever goes through a store: it must not grow with the manifests, of which there may be a million."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from shared.store import Store, compact, export, info, merge, verify
from shared.store.export import splits_by_share
from tests.fabricate import fabricate_store

FEW, MANY = 40, 140
MOST_BYTES = 2048
"""Of a shard; its manifest alone took 20 KB. Names and ranges of shards are kept, some hundred bytes each."""

COMMANDS: dict[str, Callable[[Store, Path], object]] = {
    "jobs": lambda store, _: store.jobs(),
    "digest": lambda store, _: store.digest(),
    "info": lambda store, _: info(store),
    "verify": lambda store, _: verify(store),
    "merge": lambda store, out: merge([store], out),
    "export": lambda store, out: export(store, out, splits_by_share(store, 0.0, 1)),
    "compact": lambda store, _: compact(store, 16),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_memory_hardly_grows_with_the_number_of_shards(name: str, tmp_path: Path) -> None:
    peaks = []
    # The first store warms up whatever is kept for good.
    for k, shards in enumerate((FEW, FEW, MANY)):
        store = fabricate_store(tmp_path / f"store-{k}", shards)
        tracemalloc.start()
        COMMANDS[name](store, tmp_path / f"out-{k}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (peaks[2] - peaks[1]) / (MANY - FEW) < MOST_BYTES
