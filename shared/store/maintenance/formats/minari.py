"""Minari's data sets, kept in Parquet: one a split, and in it one folder an episode.

OUT/adaafford/<task>-<split>-v0/data/metadata.json         spaces and counts
OUT/adaafford/<task>-<split>-v0/data/<n>/part-0.parquet    an episode, with one row more than it has steps
OUT/adaafford/<task>-<split>-v0/data/<n>/metadata.json

Minari has an observation after the last step, which nobody made here: the last row repeats the one before. The reward
is the success, an episode ends because its budget does (`truncations`), and all other columns are `infos` of the step.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shared.store.maintenance.formats import ExportFormat, Summary, word
from shared.store.maintenance.steps import ACTION_COLUMNS, CLOUD_COLUMNS, Content, Piece, cells, step_tables

FILE_BYTES = 256 << 20
"""Of the clouds of the episodes that are written together."""
MINARI_VERSION = "0.5.3"
"""The first that has Parquet."""


def _dataset_id(content: Content, split: str) -> str:
    return f"adaafford/{word(content.store.setting.task)}-{split}-v0"


def _write(content: Content, piece: Piece, folder: Path, shard_done: Callable[[], None]) -> Summary:
    data = folder / _dataset_id(content, piece.split) / "data"
    for number, steps in _episodes(step_tables(content, piece, shard_done)):
        episode = data / str(number)
        episode.mkdir(parents=True)
        pq.write_table(_episode_table(steps), episode / "part-0.parquet", compression="zstd", use_dictionary=False)
        described = {"id": number, "total_steps": len(steps), "object_id": steps.column("object_id")[0].as_py()}
        (episode / "metadata.json").write_text(json.dumps(described))
    return {}


def _episodes(tables: Iterator[Any]) -> Iterator[tuple[int, Any]]:
    """The steps of each episode, whose rows may go across tables."""
    number, waiting = -1, list[Any]()
    for table in chain(tables, [None]):
        numbers = np.empty(0) if table is None else table.column("episode_index").to_numpy()
        starts = [0, *(np.flatnonzero(numbers[1:] != numbers[:-1]) + 1).tolist()]
        for start, stop in zip(starts, [*starts[1:], len(numbers)], strict=True):
            following = -1 if table is None else int(numbers[start])
            if waiting and following != number:
                yield number, pa.concat_tables(waiting)
                waiting = []
            if table is not None:
                number = following
                waiting.append(table.slice(start, stop - start))


def _episode_table(steps: Any) -> Any:
    count = len(steps)
    steps = pa.concat_tables([steps, steps.slice(count - 1)]).combine_chunks()
    success = np.append(steps.column("success").to_numpy(zero_copy_only=False)[:-1], False)
    ends = np.arange(count + 1) == count - 1
    observed = {column.name: column.name.removeprefix("observation.") for column in CLOUD_COLUMNS}
    acted = {name: name.removeprefix("action.") for name in ACTION_COLUMNS}
    infos = {name: name for name in steps.column_names if name not in observed and name not in acted}
    return pa.table(
        {
            "observations": _struct(steps, observed),
            "actions": _struct(steps, acted),
            "rewards": pa.array(success.astype(np.float64)),
            "terminations": pa.array(np.zeros(count + 1, np.bool_)),
            "truncations": pa.array(ends),
            "infos": _struct(steps, infos),
        }
    )


def _struct(steps: Any, names: dict[str, str]) -> Any:
    """Some columns as one, whose cells have one axis at the most, as Minari has them."""
    arrays, fields = [], []
    for name, short in names.items():
        array, shape = steps.column(name).chunk(0), list[int]()
        if pa.types.is_fixed_size_list(array.type):
            values = cells(array)
            shape = list(values.shape[1:])
            array = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), int(np.prod(shape)))
        told = {"shape": ",".join(map(str, shape))} if shape else None
        arrays.append(array)
        fields.append(pa.field(short, array.type, metadata=told))
    return pa.StructArray.from_arrays(arrays, fields=fields)


def _finish(content: Content, folder: Path, summaries: Sequence[Summary]) -> None:
    spaces = {
        "observation_space": {
            c.name.removeprefix("observation."): _box(c.dtype, c.shape(content.points)) for c in CLOUD_COLUMNS
        },
        "action_space": {name.removeprefix("action."): _box("float64", (3,)) for name in ACTION_COLUMNS},
    }
    for split, parts in content.parts.items():
        data = folder / _dataset_id(content, split) / "data"
        size = sum(path.stat().st_size for path in data.rglob("*") if path.is_file())
        described = {
            "total_episodes": sum(episodes for _, episodes, _ in parts),
            "total_steps": content.figures[split].interactions,
            "data_format": "parquet",
            "jpeg_encoding": False,
            **{name: json.dumps({"type": "Dict", "subspaces": boxes}) for name, boxes in spaces.items()},
            "dataset_id": _dataset_id(content, split),
            "minari_version": MINARI_VERSION,
            "dataset_size": round(size / 1e6, 1),
            "algorithm_name": ", ".join(plan.key for plan in content.store.plans()),
            "description": "Trials of a flying gripper on articulated objects; README.md says what they are.",
        }
        (data / "metadata.json").write_text(json.dumps(described))


def _box(dtype: str, shape: tuple[int, ...]) -> dict[str, Any]:
    """A space of all numbers of a type."""
    low, high = {"bool": (0, 1), "uint8": (0, 255)}.get(dtype, (-np.inf, np.inf))
    limits = {name: np.full(shape, limit).tolist() for name, limit in (("low", low), ("high", high))}
    return {"type": "Box", "dtype": dtype, "shape": list(shape), **limits}


def _files(content: Content) -> Sequence[str]:
    return [
        "- `adaafford/<task>-<split>-v0`: a data set of Minari, an episode a rollout. The reward is the success, and",
        "  the last observation of an episode repeats the one before; `infos` has all else, by the step it is of.",
    ]


MINARI = ExportFormat("minari", FILE_BYTES, _write, _finish, _files)
