"""Memory of whoever goes through a store: it must not grow with the manifests, of which there may be a million."""

import gc
import itertools
import os
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from shared.store import Store, compact, export, info, merge, reader, verify
from shared.store.maintenance.export import splits_by_share
from tests.support.fabricate import fabricate_store

FEW, MANY, AT_ONCE = 4, 20, 4
MOST_BYTES = 10_000
"""Of a shard, whose manifest alone took 20 KB. Names and ranges are kept, some hundred bytes each; a small store also
shows what caches and garbage take once."""


def tidy(done: int, total: int) -> None:
    """Collect what Zarr leaves in cycles, which Python does when it sees fit."""
    gc.collect()


COMMANDS: dict[str, Callable[[Store, Path], object]] = {
    "jobs": lambda store, _: store.jobs(),
    "digest": lambda store, _: store.digest(),
    "info": lambda store, _: info(store),
    "verify": lambda store, _: verify(store, tidy),
    "merge": lambda store, out: merge([store], out, tidy),
    "export": lambda store, out: export(store, out, splits_by_share(store, 0.0, 1), tidy),
    **{
        f"export as {name}": partial(
            lambda name, store, out: export(store, out, splits_by_share(store, 0.0, 1), tidy, format=name), name
        )
        for name in ("hf", "lerobot", "webdataset", "minari")
    },
    "compact": lambda store, _: compact(store, 4, tidy),
}
LONGER = {name for name in COMMANDS if name.startswith("export as ")} | {"compact"}


@pytest.fixture
def little_garbage() -> Iterator[None]:
    """What other tests have imported is not looked through at every collection."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Stores by their number of shards, of which tests use copies."""
    folder = tmp_path_factory.mktemp("made")
    return {shards: fabricate_store(folder / str(shards), shards, rollouts=1).path for shards in (FEW, MANY)}


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("little_garbage")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in LONGER else []) for name in COMMANDS]
)
def test_memory_hardly_grows_with_the_number_of_shards(
    name: str, made: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As many manifests are in memory at once as a bucket gives at once; fewer here, so that a small store shows it.
    monkeypatch.setattr(reader, "_BATCH", AT_ONCE)
    numbers = itertools.count()

    def command(shards: int) -> None:
        number = next(numbers)
        copy = shutil.copytree(made[shards], tmp_path / f"store-{number}", copy_function=os.link)
        COMMANDS[name](Store.open(copy), tmp_path / f"out-{number}")

    def peak(shards: int) -> int:
        tracemalloc.start()
        command(shards)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    command(FEW)  # It warms up whatever is kept for good.
    few = peak(FEW)
    # Of the large ones, one may meet the moment at which Python makes its table of texts larger.
    assert any((peak(MANY) - few) / (MANY - FEW) < MOST_BYTES for _ in range(2))
