"""One Parquet table and one Zarr group a split: the rows of the store as they are, each cloud once.

OUT/<split>/interactions.parquet   one row an interaction, failures included
OUT/<split>/observations.zarr/     the clouds that the rows' "observation" counts
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from shared.store.codecs.observations import ArrayKind, ObservationArrays, kinds
from shared.store.layout import MAX_ROWS
from shared.store.maintenance.formats import ExportFormat, Summary, nothing_to_finish
from shared.store.maintenance.steps import Content, Piece, of_objects, with_all_columns

CLOUDS_A_CHUNK = 64
DEPTH_LINES = (
    "- `depth` there: packed depth images. With x a number of an image, s is x / 2 where x is even, else -(x + 1) / 2.",
    "  Sums of s along rows, then along columns, modulo 65,536, are steps of 0.25 mm along the camera's forward axis;",
    "  32,768 is the depth of the world's origin, and 0 no surface. `focal`: pixels.",
)
SHARDS_A_GROUP = 256
"""Shards whose rows are written together, or fewer with many rows. What is known of each group of rows, 40 KB, is in
memory until the last one is written."""


def _write(content: Content, piece: Piece, folder: Path, shard_done: Callable[[], None]) -> Summary:
    writer = _SplitWriter(folder / piece.split, content)
    for part in piece.parts:
        rollouts, rows = (of_objects(table, content.splits[piece.split]) for table in content.store.tables_of(part))
        writer.add(rollouts, rows, content.store.read_observations(part.shard.shard_id))
        shard_done()
    writer.finish()
    return {}


class _SplitWriter:
    """One split's files, shard by shard, so that memory does not grow with the store."""

    def __init__(self, folder: Path, content: Content) -> None:
        folder.mkdir()
        self._schema = content.interactions
        self._rows = pq.ParquetWriter(folder / "interactions.parquet", self._schema, compression="zstd")
        self._clouds = zarr.create_group(folder / "observations.zarr", zarr_format=3)
        camera = content.store.setting.collection.camera
        self._kinds: tuple[ArrayKind, ...] = kinds(camera.depth_size)
        for kind in self._kinds:
            shape = kind.shape(camera.points, camera.depth_size)
            self._clouds.create_array(
                kind.name,
                shape=(0, *shape),
                dtype=kind.kept,
                chunks=(CLOUDS_A_CHUNK, *shape),
                compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
                attributes={"description": kind.description},
            )
        self._tables: list[Any] = []
        self._packed: dict[str, list[NDArray[Any]]] = {kind.name: [] for kind in self._kinds}
        self._written = self._waiting = 0

    def add(self, rollouts: Any, rows: Any, clouds: ObservationArrays) -> None:
        """Take what belongs to the split of a shard's two tables, and the shard's clouds."""
        numbers = np.fromiter(_observations_of(rollouts), np.int64)
        places = np.full(len(clouds), -1, np.int32)
        places[numbers] = self._written + np.arange(len(numbers), dtype=np.int32)
        column = rows.schema.get_field_index("observation")
        renumbered = pa.array(places[rows.column("observation").to_numpy()], pa.int32())
        rows = rows.set_column(column, rows.schema.field(column), renumbered)
        self._tables.append(with_all_columns(rows, self._schema))
        if len(self._tables) == SHARDS_A_GROUP or sum(map(len, self._tables)) >= MAX_ROWS:
            self._write_rows()
        for kind in self._kinds if len(numbers) else ():
            self._packed[kind.name].append(kind.pack(getattr(clouds, kind.name)[numbers]))
        self._waiting += len(numbers)
        if self._waiting >= CLOUDS_A_CHUNK:
            self._write_clouds(self._waiting - self._waiting % CLOUDS_A_CHUNK)
        self._written += len(numbers)

    def finish(self) -> None:
        """Close the files."""
        self._write_rows()
        self._rows.close()
        self._write_clouds(self._waiting)

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


def _patterns(content: Content) -> Mapping[str, Sequence[str]]:
    return {split: [f"{split}/interactions.parquet"] for split in content.splits}


def _files(content: Content) -> Sequence[str]:
    return [
        "- `<split>/interactions.parquet`: one row an interaction; every column is described in the file's schema.",
        "  `observation` counts the clouds of the same split.",
        "- `<split>/observations.zarr`: points (world), normals (times 127), part ids, movable mask, pixels, camera.",
        *(DEPTH_LINES if content.store.setting.collection.camera.keep_depth else ()),
    ]


PLAIN = ExportFormat(
    "plain", None, _write, nothing_to_finish, _files, (), _patterns, schema=lambda content: content.interactions
)
