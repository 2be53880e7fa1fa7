"""LeRobot's data sets, version 3.0 of their format: a frame is a step, and the splits are ranges of episodes.

OUT/data/chunk-000/file-000.parquet            frames; each split begins a new chunk
OUT/meta/episodes/chunk-000/file-000.parquet   the episodes of the file of frames that has the same number
OUT/meta/info.json, stats.json, tasks.parquet

Features have a fixed shape there, so the columns that list all joints of an object are left out; its other columns are
kept. Statistics of clouds are those of all points together, so that they fit clouds of any size.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shared.store.maintenance.formats import ExportFormat, Summary
from shared.store.maintenance.steps import (
    ACTION_COLUMNS,
    CLOUD_COLUMNS,
    Content,
    Piece,
    cells,
    fixed_size_lists,
    parquet_writer,
    step_tables,
)

FILE_MB, FILES_A_CHUNK = 100, 1000
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_TASK_INDEX = 0
_ACTION = [f"{name.removeprefix('action.')}.{axis}" for name in ACTION_COLUMNS for axis in "xyz"]
_OF_FRAMES = {
    "action": pa.list_(pa.field("element", pa.float32(), nullable=False), len(_ACTION)),
    "next.reward": pa.float32(),
    "next.success": pa.bool_(),
    "next.done": pa.bool_(),
    "timestamp": pa.float32(),
    "frame_index": pa.int64(),
    "episode_index": pa.int64(),
    "index": pa.int64(),
    "task_index": pa.int64(),
}
"""Columns that LeRobot has or expects; a step is a second, since a trial has no rate."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a piece is in the whole data set."""

    chunk: int
    file: int
    first_episode: int
    first_frame: int


def _places(content: Content) -> dict[tuple[str, int], _Place]:
    """By split and number of the piece."""
    places, chunk, episode, frame = dict[tuple[str, int], _Place](), 0, 0, 0
    for piece in content.pieces(FILE_MB << 20):
        _, file = divmod(piece.number, FILES_A_CHUNK)
        if not file and places:
            chunk += 1
        places[piece.split, piece.number] = _Place(chunk, file, episode, frame)
        episode, frame = episode + piece.episodes, frame + piece.steps
    return places


def _schema(content: Content) -> Any:
    """Of a file of frames."""
    kept = [each for each in content.schema if each.name not in {*ACTION_COLUMNS, *_OF_FRAMES} and _fits(each.type)]
    return pa.schema([*kept, *(pa.field(name, kind, nullable=False) for name, kind in _OF_FRAMES.items())])


def _fits(kind: Any) -> bool:
    """Whether LeRobot takes a column of this type; PyTorch has no 64-bit numbers without a sign."""
    while pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    numbers = pa.types.is_boolean(kind) or pa.types.is_floating(kind) or pa.types.is_integer(kind)
    return bool(pa.types.is_string(kind) or (numbers and kind != pa.uint64()))


def _write(content: Content, piece: Piece, folder: Path, shard_done: Callable[[], None]) -> Summary:
    place, schema = _places(content)[piece.split, piece.number], _schema(content)
    numbers = {"chunk_index": place.chunk, "file_index": place.file}
    data, episodes = folder / _DATA.format(**numbers), folder / _EPISODES.format(**numbers)
    for path in (data, episodes):
        path.parent.mkdir(parents=True)
    lengths: Counter[int] = Counter()
    moments: dict[str, _Moments] = {}
    frame = place.first_frame
    with parquet_writer(data, schema) as writer:
        following = chain(step_tables(content, piece, shard_done), [None])
        for steps, after in pairwise(following):
            table = _frames(steps, after, place.first_episode - piece.first_episode, frame, schema)
            writer.write_table(table)
            lengths.update(table.column("episode_index").to_pylist())
            for each in schema:
                if not pa.types.is_string(each.type):
                    found = _Moments.of(cells(table.column(each.name)), is_cloud=each.name in _CLOUDS)
                    moments[each.name] = found.plus(moments[each.name]) if each.name in moments else found
            frame += len(table)
    _write_episodes(episodes, lengths, place, content.store.setting.task)
    return {name: each.as_document() for name, each in moments.items()}


_CLOUDS = tuple(column.name for column in CLOUD_COLUMNS if not all(column.tail))


def _frames(steps: Any, after: Any, episodes_before: int, first: int, schema: Any) -> Any:
    """A table of steps as one of frames, given the table that follows it."""
    episodes = steps.column("episode_index").to_numpy()
    success = steps.column("success").combine_chunks()
    next_episode = None if after is None else after.column("episode_index")[0].as_py()
    action = np.concatenate([cells(steps.column(name)) for name in ACTION_COLUMNS], axis=1)
    numbers = np.arange(first, first + len(steps))
    made = {
        "action": fixed_size_lists(action.astype(np.float32)),
        "next.reward": success.cast(pa.uint8()).cast(pa.float32()),
        "next.success": success,
        "next.done": pa.array(np.append(episodes[1:] != episodes[:-1], episodes[-1] != next_episode)),
        "timestamp": steps.column("frame_index").cast(pa.float32()),
        "frame_index": steps.column("frame_index"),
        "episode_index": pa.array(episodes + episodes_before),
        "index": pa.array(numbers),
        "task_index": pa.array(np.full(len(steps), _TASK_INDEX)),
    }
    columns = [made[name] if name in made else steps.column(name) for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


def _write_episodes(path: Path, lengths: Mapping[int, int], place: _Place, task: str) -> None:
    stops = np.cumsum([0, *lengths.values()]) + place.first_frame
    constant = {"data/chunk_index": place.chunk, "data/file_index": place.file}
    constant |= {f"meta/episodes/{name.removeprefix('data/')}": number for name, number in constant.items()}
    columns = {
        "episode_index": pa.array(list(lengths), pa.int64()),
        "tasks": pa.array([[task]] * len(lengths), pa.list_(pa.string())),
        "length": pa.array(list(lengths.values()), pa.int64()),
        "dataset_from_index": pa.array(stops[:-1], pa.int64()),
        "dataset_to_index": pa.array(stops[1:], pa.int64()),
        **{name: pa.array([number] * len(lengths), pa.int64()) for name, number in constant.items()},
    }
    pq.write_table(pa.table(columns), path, compression="zstd")


def _finish(content: Content, folder: Path, summaries: Sequence[Summary]) -> None:
    moments: dict[str, _Moments] = {}
    for summary in summaries:
        for name, document in summary.items():
            found = _Moments.from_document(document)
            moments[name] = moments[name].plus(found) if name in moments else found
    frames = sum(figures.interactions for figures in content.figures.values())
    stats = {name: each.as_stats(frames) for name, each in moments.items()}
    (folder / "meta/stats.json").write_text(json.dumps(stats) + "\n")
    (folder / "meta/info.json").write_text(json.dumps(_info(content), indent=4) + "\n")
    _write_tasks(folder / "meta/tasks.parquet", content.store.setting.task)


def _info(content: Content) -> dict[str, Any]:
    episodes = {split: sum(each[1] for each in parts) for split, parts in content.parts.items()}
    stops = np.cumsum([0, *episodes.values()]).tolist()
    return {
        "codebase_version": "v3.0",
        "robot_type": "flying gripper",
        "total_episodes": stops[-1],
        "total_frames": sum(figures.interactions for figures in content.figures.values()),
        "total_tasks": 1,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": 1,
        "splits": {split: f"{start}:{stop}" for split, (start, stop) in zip(episodes, pairwise(stops), strict=True)},
        "data_path": _DATA,
        "video_path": None,
        "features": {each.name: _feature(each) for each in _schema(content)},
    }


def _feature(each: Any) -> dict[str, Any]:
    kind, shape = each.type, list[int]()
    while pa.types.is_fixed_size_list(kind):
        shape.append(kind.list_size)
        kind = kind.value_type
    names = _ACTION if each.name == "action" else None
    return {
        "dtype": {"float": "float32", "double": "float64"}.get(str(kind), str(kind)),
        "shape": shape or [1],
        "names": names,
    }


def _write_tasks(path: Path, task: str) -> None:
    """A table as pandas writes it, whose index is the tasks' texts."""
    index = "__index_level_0__"
    described: list[dict[str, str | None]] = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    pandas = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [{**one, "metadata": None} for one in described],
    }
    table = pa.table({"task_index": pa.array([_TASK_INDEX], pa.int64()), index: pa.array([task])})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


@dataclass(frozen=True, slots=True)
class _Moments:
    """Statistics of a column, of each channel; what is not finite is left out."""

    count: NDArray[Any]
    mean: NDArray[Any]
    squares: NDArray[Any]
    """Sum of the squared differences from the mean."""
    low: NDArray[Any]
    high: NDArray[Any]

    @classmethod
    def of(cls, values: NDArray[Any], *, is_cloud: bool) -> "_Moments":
        """Of some rows: [S, ...]; the points of a cloud are taken together."""
        values = values.astype(np.float64)
        if is_cloud:
            values = values.reshape(-1, *values.shape[2:])
        if values.ndim == 1:
            values = values[:, None]
        is_there = np.isfinite(values)
        count = is_there.sum(axis=0)
        mean = np.where(is_there, values, 0.0).sum(axis=0) / np.maximum(count, 1)
        squares = (np.where(is_there, values - mean, 0.0) ** 2).sum(axis=0)
        low, high = (np.where(is_there, values, limit) for limit in (np.inf, -np.inf))
        return cls(count, mean, squares, low.min(axis=0), high.max(axis=0))

    def plus(self, other: "_Moments") -> "_Moments":
        """Of the rows of both."""
        count = self.count + other.count
        share = other.count / np.maximum(count, 1)
        between = other.mean - self.mean
        squares = self.squares + other.squares + between**2 * self.count * share
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        return _Moments(count, self.mean + between * share, squares, low, high)

    def as_stats(self, frames: int) -> dict[str, Any]:
        """As LeRobot has them; 0 where no number is finite."""
        numbers = {
            "min": self.low,
            "max": self.high,
            "mean": self.mean,
            "std": np.sqrt(self.squares / np.maximum(self.count, 1)),
        }
        return {name: np.where(self.count > 0, each, 0.0).tolist() for name, each in numbers.items()} | {
            "count": [frames]
        }

    def as_document(self) -> Summary:
        """For a note; where there is no number, `low` and `high` are said to be 0."""
        is_there = self.count > 0
        low, high = (np.where(is_there, each, 0.0) for each in (self.low, self.high))
        fields = {"count": self.count, "mean": self.mean, "squares": self.squares, "low": low, "high": high}
        return {name: each.tolist() for name, each in fields.items()}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "_Moments":
        """What `as_document` gave."""
        found = {name: np.array(each) for name, each in document.items()}
        is_there = found["count"] > 0
        found["low"] = np.where(is_there, found["low"], np.inf)
        found["high"] = np.where(is_there, found["high"], -np.inf)
        return cls(**found)


def _patterns(content: Content) -> Mapping[str, Sequence[str]]:
    chunks: dict[str, dict[int, None]] = {split: {} for split in content.splits}
    for (split, _), place in _places(content).items():
        chunks[split][place.chunk] = None
    return {split: [f"data/chunk-{chunk:03d}/*.parquet" for chunk in found] for split, found in chunks.items()}


def _files(content: Content) -> Sequence[str]:
    return [
        "- A data set of LeRobot (format v3.0): `data/` has a frame a step, `meta/` what these are. The splits are",
        "  ranges of episodes (`meta/info.json`, `splits`). `action` is point, approach and forward, in single",
        "  precision; `action.*` of other formats is exact, as `rotation` is here. `next.success` is the outcome.",
        "- Left out, since a feature has a fixed shape: the lists of all joints, and the seed (`setting.json` has it).",
    ]


LEROBOT = ExportFormat("lerobot", FILE_MB << 20, _write, _finish, _files, ("LeRobot",), _patterns, schema=_schema)
