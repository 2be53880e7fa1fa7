"""Export: a store as plain files for people who want no store, with a card that says what they are.

OUT/
  README.md                      the data card
  setting.json                   how all of it was collected
  <split>/interactions.parquet   one row an interaction, failures included
  <split>/observations.zarr/     the clouds that the rows' "observation" counts
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from shared.errors import StoreError, UsageError
from shared.io.files import remove_tree, temporary_name
from shared.seeds import generator
from shared.store.codecs.columns import INTERACTION_COLUMNS, interaction_columns
from shared.store.codecs.observations import ArrayKind, ObservationArrays, kinds
from shared.store.codecs.tables import joined, schema_of, unknown_columns
from shared.store.coverage import ROLLOUT_COLUMN
from shared.store.layout import INTERACTIONS_FILE, MAX_ROWS
from shared.store.maintenance.datacard import SplitFigures, data_card
from shared.store.store import Store

CLOUDS_A_CHUNK = 64
SHARDS_A_GROUP = 256
"""Shards whose rows are written together, or fewer with many rows. What is known of each group of rows, 40 KB, is in
memory until the last one is written."""


@dataclass(frozen=True, slots=True)
class Export:
    """What an export wrote."""

    out: str
    splits: dict[str, SplitFigures]


def splits_by_share(store: Store, test_share: float, seed: int) -> dict[str, frozenset[str]]:
    """Objects drawn at random within each category: "train" and, if the share is above 0, "test".

    Raises:
        UsageError: the share is not one.
    """
    if not 0 <= test_share < 1:
        raise UsageError(f"--test-share {test_share} is not allowed; choose 0 to below 1")
    test: set[str] = set()
    by_category: dict[str, list[str]] = {}
    for ref in store.setting.objects:
        by_category.setdefault(ref.category, []).append(ref.id)
    for category, ids in sorted(by_category.items()):
        count = round(test_share * len(ids))
        test |= set(generator(seed, f"export/{category}").choice(sorted(ids), count, replace=False).tolist())
    train = {ref.id for ref in store.setting.objects} - test
    return {"train": frozenset(train)} | ({"test": frozenset(test)} if test_share else {})


def export(
    store: Store,
    out: Path,
    splits: Mapping[str, frozenset[str]],
    progress: Callable[[int, int], None] | None = None,
) -> Export:
    """Write a store as plain files: all of it or nothing.

    Args:
        store: what is written.
        out: a folder that is not there yet.
        splits: objects of each split; rows of objects in none are left out.
        progress: called after each shard with how many are done and how many there are.

    Raises:
        UsageError: the folder is there, or cannot be made; or an object is in two splits, or in no store.
        StoreError: the store is damaged, or a split comes out empty.
    """
    _check_splits(store, splits)
    if out.exists():
        raise UsageError(f"{out}: is there already; name a new folder")
    temporary = out.parent / temporary_name(out.name)
    try:
        temporary.mkdir(parents=True)
        parts = store.parts()
        unknown = _unknown_fields(store)
        writers = {name: _SplitWriter(temporary / name, store, objects, unknown) for name, objects in splits.items()}
        for done, part in enumerate(parts, 1):
            tables = store.tables_of(part)
            clouds = store.read_observations(part.shard.shard_id)
            for writer in writers.values():
                writer.add(*tables, clouds)
            if progress is not None:
                progress(done, len(parts))
        figures = {name: writer.finish() for name, writer in writers.items()}
        (temporary / "setting.json").write_text(json.dumps(store.setting.as_document(), indent=2) + "\n")
        (temporary / "README.md").write_text(data_card(store, figures), encoding="utf-8")
        temporary.rename(out)
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror}); name another folder") from None
    finally:
        remove_tree(temporary)
    return Export(str(out), figures)


def _unknown_fields(store: Store) -> Any:
    """Columns that newer software added to any shard; those of a file are fixed once its first row is written."""
    found: list[Any] = []
    for _, _, table in store.each(INTERACTIONS_FILE):
        unknown = unknown_columns(table.slice(0, 0), INTERACTION_COLUMNS, ROLLOUT_COLUMN)
        if not any(unknown.schema.equals(schema) for schema in found):
            found.append(unknown.schema)
    tables = [schema.empty_table() for schema in found]
    fields = joined(tables, store.where).schema if tables else []
    return [field for field in fields if field.name != ROLLOUT_COLUMN]


def _check_splits(store: Store, splits: Mapping[str, frozenset[str]]) -> None:
    known = {ref.id for ref in store.setting.objects}
    seen: set[str] = set()
    for name, objects in splits.items():
        for odd, what in ((objects - known, "is not in the store"), (objects & seen, "is in another split too")):
            if odd:
                raise UsageError(f"split '{name}': object '{min(odd)}' {what}; list each object of the store once")
        seen |= objects


class _SplitWriter:
    """One split's files, shard by shard, so that memory does not grow with the store."""

    def __init__(self, folder: Path, store: Store, objects: frozenset[str], unknown: Sequence[Any]) -> None:
        folder.mkdir()
        self._name, self._objects = folder.name, pa.array(sorted(objects), pa.string())
        columns = interaction_columns(store.setting.dynamics.added)
        self._schema = pa.schema([*schema_of(columns), *unknown])
        self._rows = pq.ParquetWriter(folder / "interactions.parquet", self._schema, compression="zstd")
        self._clouds = zarr.create_group(folder / "observations.zarr", zarr_format=3)
        camera = store.setting.collection.camera
        sizes = (camera.points, camera.image_size if camera.keep_depth else 0)
        self._kinds: tuple[ArrayKind, ...] = kinds(sizes[1])
        for kind in self._kinds:
            self._clouds.create_array(
                kind.name,
                shape=(0, *kind.shape(*sizes)),
                dtype=kind.kept,
                chunks=(CLOUDS_A_CHUNK, *kind.shape(*sizes)),
                compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
                attributes={"description": kind.description},
            )
        self._tables: list[Any] = []
        self._packed: dict[str, list[NDArray[Any]]] = {kind.name: [] for kind in self._kinds}
        self._written = self._waiting = 0
        self._figures = SplitFigures.nothing()

    def add(self, rollouts: Any, rows: Any, clouds: ObservationArrays) -> None:
        """Take what belongs to the split of a shard's two tables and its clouds."""
        rollouts, rows = (t.filter(pc.is_in(t.column("object_id"), value_set=self._objects)) for t in (rollouts, rows))
        numbers = np.fromiter(_observations_of(rollouts), np.int64)
        places = np.full(len(clouds), -1, np.int32)
        places[numbers] = self._written + np.arange(len(numbers), dtype=np.int32)
        column = rows.schema.get_field_index("observation")
        renumbered = pa.array(places[rows.column("observation").to_numpy()], pa.int32())
        rows = rows.set_column(column, rows.schema.field(column), renumbered)
        for field in self._schema:
            if field.name not in rows.column_names:
                rows = rows.append_column(field, pa.nulls(len(rows), field.type))
        self._tables.append(rows.select(self._schema.names).cast(self._schema))
        if len(self._tables) == SHARDS_A_GROUP or sum(map(len, self._tables)) >= MAX_ROWS:
            self._write_rows()
        for kind in self._kinds if len(numbers) else ():
            self._packed[kind.name].append(kind.pack(getattr(clouds, kind.name)[numbers]))
        self._waiting += len(numbers)
        if self._waiting >= CLOUDS_A_CHUNK:
            self._write_clouds(self._waiting - self._waiting % CLOUDS_A_CHUNK)
        self._written += len(numbers)
        self._figures = self._figures.with_rows(rollouts, rows, len(numbers))

    def finish(self) -> SplitFigures:
        """Close the files.

        Raises:
            StoreError: there is not one row.
        """
        self._write_rows()
        self._rows.close()
        self._write_clouds(self._waiting)
        if not self._figures.interactions:
            raise StoreError(f"split '{self._name}' has no interaction; list other objects, or collect more")
        return self._figures

    def _write_rows(self) -> None:
        self._rows.write_table(pa.concat_tables([self._schema.empty_table(), *self._tables]))
        self._tables.clear()

    def _write_clouds(self, count: int) -> None:
        """Write the first `count` clouds that wait: whole chunks, unless it is the last time."""
        for kind in self._kinds if count else ():
            array: Any = self._clouds[kind.name]
            waiting = np.concatenate(self._packed[kind.name])
            array.append(waiting[:count])
            self._packed[kind.name] = [waiting[count:]]
        self._waiting -= count


def _observations_of(rollouts: Any) -> Iterator[int]:
    """Indices in the shard of the observations of some rollouts."""
    for row in rollouts.select(["first_observation", "observations"]).to_pylist():
        yield from range(row["first_observation"], row["first_observation"] + row["observations"])
