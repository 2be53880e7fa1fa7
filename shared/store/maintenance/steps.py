"""What an export writes, whatever the format: one row a step, with the cloud that its action was chosen from.

A rollout is an episode and an interaction is a step of it; rollouts without interactions are no episodes. The rows of
each split are divided into pieces, each of which is written by itself, so that memory does not grow with the store and
an export that was killed goes on.

Shapes: N points of a cloud; S steps of a table.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shared.errors import StoreError
from shared.store.codecs.columns import INTERACTION_COLUMNS, interaction_columns
from shared.store.codecs.observations import ObservationArrays
from shared.store.codecs.tables import joined, schema_of, unknown_columns
from shared.store.coverage import ROLLOUT_COLUMN, Part, Snapshot
from shared.store.maintenance.datacard import SplitFigures
from shared.store.store import Store

GROUP_BYTES = 16 << 20
"""Of the clouds of the steps that are in memory together and, in Parquet, are a row group."""
Splits = Mapping[str, frozenset[str]]
"""Objects of each split."""


@dataclass(frozen=True, slots=True)
class CloudColumn:
    """A column of a step that holds a field of its observation.

    Attributes:
        name: of the column.
        field: of `shared.types.Observation`.
        dtype: numpy type of the numbers.
        tail: shape of a cell; 0 stands for N.
        description: for schemas and cards.
    """

    name: str
    field: str
    dtype: str
    tail: tuple[int, ...]
    description: str

    def shape(self, points: int) -> tuple[int, ...]:
        """Shape of a cell, for clouds of `points`."""
        return tuple(size or points for size in self.tail)


CLOUD_COLUMNS = (
    CloudColumn("observation.points", "points", "float32", (0, 3), "points, world frame, furthest-point order"),
    CloudColumn("observation.normals", "normals", "float32", (0, 3), "unit normals, world frame"),
    CloudColumn("observation.movable", "movable", "bool", (0,), "whether the task may act on the point"),
    CloudColumn("observation.part_ids", "part_ids", "uint8", (0,), "0: static body; k: k-th movable part"),
    CloudColumn(
        "observation.camera", "world_from_camera", "float64", (4, 4), "pose: world from camera, x forward, y left, z up"
    ),
)
ACTION_COLUMNS = {
    "action.point": "p, where the gripper touches, world",
    "action.approach": "direction in which the gripper approaches, unit, world",
    "action.forward": "forward direction of the gripper, unit, world",
}
"""Three numbers each."""
_ELSEWHERE = ("observation", "point")
"""Columns of interactions that the columns above replace."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Some whole shards, of which the rows of one split are written together.

    Attributes:
        split: whose rows.
        number: which piece of the split, from 0.
        of: how many pieces the split has.
        parts: what counts of each shard.
        first_episode: how many episodes of the split come before.
        episodes: how many there are in the piece.
        steps: the same.
    """

    split: str
    number: int
    of: int
    parts: tuple[Part, ...]
    first_episode: int
    episodes: int
    steps: int


@dataclass(frozen=True, slots=True)
class Content:
    """What a store holds for an export.

    Attributes:
        store: the store.
        digest: its content digest.
        splits: objects of each split.
        figures: of each split.
        interactions: schema of the table of interactions, with the columns of newer software.
        parts: of each split, the shards with rows of it, and how many episodes and steps these are.
        shards: how many there are in all.
    """

    store: Store
    digest: str
    splits: Splits
    figures: Mapping[str, SplitFigures]
    interactions: Any
    parts: Mapping[str, Sequence[tuple[Part, int, int]]]
    shards: int
    _pieces: dict[int | None, list[Piece]] = field(init=False, repr=False, default_factory=dict)

    @property
    def points(self) -> int:
        """N."""
        return self.store.setting.collection.camera.points

    @property
    def step_bytes(self) -> int:
        """Of the clouds of one step, not compressed."""
        return sum(int(np.prod(c.shape(self.points))) * np.dtype(c.dtype).itemsize for c in CLOUD_COLUMNS)

    @property
    def group_steps(self) -> int:
        """Most steps of a table."""
        return max(1, GROUP_BYTES // self.step_bytes)

    @property
    def schema(self) -> Any:
        """Of a table of steps."""
        numbers = {"episode_index": "number of the rollout in its split", "frame_index": "number within the rollout"}
        three = pa.list_(pa.field("element", pa.float64(), nullable=False), 3)
        fields = [_field(name, pa.int64(), description) for name, description in numbers.items()]
        fields += [_field(c.name, _nested(c.dtype, c.shape(self.points)), c.description) for c in CLOUD_COLUMNS]
        fields += [_field(name, three, description) for name, description in ACTION_COLUMNS.items()]
        return pa.schema([*fields, *(each for each in self.interactions if each.name not in _ELSEWHERE)])

    def pieces(self, most_bytes: int | None) -> list[Piece]:
        """The rows of all splits, divided.

        Args:
            most_bytes: a piece ends with the shard that brings its clouds above this; None: one piece a split.
        """
        if most_bytes not in self._pieces:
            parts = self.parts.items()
            self._pieces[most_bytes] = [
                piece for split, each in parts for piece in self._divided(split, each, most_bytes)
            ]
        return self._pieces[most_bytes]

    def _divided(self, split: str, parts: Sequence[tuple[Part, int, int]], most_bytes: int | None) -> list[Piece]:
        groups: list[list[tuple[Part, int, int]]] = [[]]
        size, step_bytes = 0, self.step_bytes
        for part in parts:
            if most_bytes is not None and size >= most_bytes and part[2]:
                groups.append([])
                size = 0
            groups[-1].append(part)
            size += part[2] * step_bytes
        found, episode = list[Piece](), 0
        for number, group in enumerate(groups):
            episodes, steps = sum(each[1] for each in group), sum(each[2] for each in group)
            shards = tuple(part for part, *_ in group)
            found.append(Piece(split, number, len(groups), shards, episode, episodes, steps))
            episode += episodes
        return found


def survey(store: Store, splits: Splits, progress: Callable[[int, int], None]) -> Content:
    """Go through the tables of a store once, without its clouds.

    Args:
        store: what is exported.
        splits: objects of each split.
        progress: called after each shard with how many are done and how many there are.

    Raises:
        StoreError: a file is damaged or foreign, or a split comes out empty.
    """
    figures = dict.fromkeys(splits, SplitFigures.nothing())
    parts: dict[str, list[tuple[Part, int, int]]] = {split: [] for split in splits}
    unknown: list[Any] = []
    there = store.parts()
    # What others commit meanwhile is in neither the files nor the digest.
    store = store.as_of(Snapshot.of(there))
    for done, part in enumerate(there, 1):
        rollouts, rows = store.tables_of(part)
        of_newer = unknown_columns(rows.slice(0, 0), INTERACTION_COLUMNS, ROLLOUT_COLUMN)
        if not any(of_newer.schema.equals(each.schema) for each in unknown):
            unknown.append(of_newer)
        for split, objects in splits.items():
            mine, steps = of_objects(rollouts, objects), of_objects(rows, objects)
            if len(mine):
                clouds = pc.sum(mine.column("observations")).as_py()
                figures[split] = figures[split].with_rows(mine, steps, clouds)
                parts[split].append((part, int(_begins(steps).sum()), len(steps)))
        progress(done, 2 * len(there))
    for split, found in figures.items():
        if not found.interactions:
            raise StoreError(f"split '{split}' has no interaction; list other objects, or collect more")
    known = schema_of(interaction_columns(store.setting.dynamics.added))
    more = [each for each in joined(unknown, store.where).schema if each.name != ROLLOUT_COLUMN] if unknown else []
    return Content(store, store.digest(), splits, figures, pa.schema([*known, *more]), parts, len(there))


def of_objects(table: Any, objects: frozenset[str]) -> Any:
    """The rows of one of a shard's tables that are of some objects."""
    return table.filter(pc.is_in(table.column("object_id"), value_set=pa.array(sorted(objects), pa.string())))


def with_all_columns(rows: Any, schema: Any) -> Any:
    """Interactions with the columns of a schema; a shard of older software lacks those that newer software added."""
    for each in schema:
        if each.name not in rows.column_names:
            rows = rows.append_column(each, pa.nulls(len(rows), each.type))
    return rows.select(schema.names).cast(schema)


def step_tables(content: Content, piece: Piece, shard_done: Callable[[], None]) -> Iterator[Any]:
    """The steps of a piece, in order, as tables of at most `content.group_steps` rows; rollouts may go across tables.

    Args:
        content: what is exported.
        piece: of `content.pieces`.
        shard_done: called after each shard.

    Raises:
        StoreError: a file is damaged or foreign.
    """
    waiting: list[Any] = []
    for table in _shard_tables(content, piece, shard_done):
        while table is not None:
            room = content.group_steps - sum(map(len, waiting))
            waiting.append(table.slice(0, room))
            table = table.slice(room) if len(table) > room else None
            if sum(map(len, waiting)) == content.group_steps:
                yield pa.concat_tables(waiting)
                waiting.clear()
    if waiting:
        yield pa.concat_tables(waiting)


def _shard_tables(content: Content, piece: Piece, shard_done: Callable[[], None]) -> Iterator[Any]:
    episode, objects = piece.first_episode, content.splits[piece.split]
    for part in piece.parts:
        rows = of_objects(content.store.tables_of(part)[1], objects)
        if len(rows):
            clouds = content.store.read_observations(part.shard.shard_id)
            begins = _begins(rows)
            episodes = np.cumsum(begins) - 1
            frames = np.arange(len(rows)) - np.flatnonzero(begins)[episodes]
            for start in range(0, len(rows), content.group_steps):
                chosen = slice(start, start + content.group_steps)
                few = rows.slice(start, content.group_steps)
                yield _step_table(content, few, clouds, episode + episodes[chosen], frames[chosen])
            episode += int(begins.sum())
        shard_done()


def _step_table(
    content: Content, rows: Any, clouds: ObservationArrays, episodes: NDArray[Any], frames: NDArray[Any]
) -> Any:
    rotation = cells(rows.column("rotation")).reshape(-1, 3, 3)
    seen = rows.column("observation").to_numpy()
    arrays: dict[str, Any] = {"episode_index": pa.array(episodes), "frame_index": pa.array(frames)}
    arrays |= {column.name: fixed_size_lists(getattr(clouds, column.field)[seen]) for column in CLOUD_COLUMNS}
    arrays["action.point"] = rows.column("point")
    arrays["action.approach"] = fixed_size_lists(rotation[:, :, 2])
    arrays["action.forward"] = fixed_size_lists(rotation[:, :, 0])
    rows, schema = with_all_columns(rows, content.interactions), content.schema
    columns = [arrays[name] if name in arrays else rows.column(name) for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


def fixed_size_lists(values: NDArray[Any]) -> Any:
    """An array [S, ...] as a column of fixed-size lists, one within the other for each further axis."""
    values = np.ascontiguousarray(values)
    array = pa.array(values.ravel())
    for axis in range(values.ndim - 1, 0, -1):
        array = pa.FixedSizeListArray.from_arrays(array, type=_nested(values.dtype, values.shape[axis:]))
    return array


def cells(column: Any) -> NDArray[Any]:
    """What a column of fixed-size lists holds, [S, ...]."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    shape = [len(array)]
    while pa.types.is_fixed_size_list(array.type):
        shape.append(array.type.list_size)
        array = array.flatten()
    numbers: NDArray[Any] = array.to_numpy(zero_copy_only=False)
    return numbers.reshape(shape)


def parquet_writer(path: Path, schema: Any) -> Any:
    """A Parquet file of tables with clouds, for the formats that have such files.

    Dictionaries only for texts and for numbers of which there are few: Arrow's would take all NaNs, and both zeros, for
    one value. Coordinates are compressed a byte at a time, since the lower ones of most are zero.
    """
    leaves = {each.name: f"{each.name}{_leaf(each.type)}" for each in schema}
    texts = [each.name for each in schema if pa.types.is_string(each.type)]
    few = [leaves[name] for name in ("observation.normals", "observation.part_ids") if name in leaves]
    points = [leaves[name] for name in ("observation.points",) if name in leaves]
    return pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=[*texts, *few],
        column_encoding=dict.fromkeys(points, "BYTE_STREAM_SPLIT"),
        write_statistics=[each.name for each in schema if not pa.types.is_nested(each.type)],
    )


def _leaf(kind: Any) -> str:
    """What Parquet calls the numbers of a column, after its name."""
    return f".list.element{_leaf(kind.value_type)}" if pa.types.is_fixed_size_list(kind) else ""


def _begins(rows: Any) -> NDArray[np.bool_]:
    """Whether each of a shard's interactions is the first of its rollout, [S]."""
    rollouts = rows.column(ROLLOUT_COLUMN).to_numpy()
    begins = np.ones(len(rollouts), np.bool_)
    begins[1:] = rollouts[1:] != rollouts[:-1]
    return begins


def _nested(dtype: Any, shape: Sequence[int]) -> Any:
    """The type of a cell of some shape."""
    kind = pa.from_numpy_dtype(np.dtype(dtype))
    for size in reversed(shape):
        kind = pa.list_(pa.field("element", kind, nullable=False), size)
    return kind


def _field(name: str, kind: Any, description: str) -> Any:
    return pa.field(name, kind, nullable=False, metadata={"description": description})
