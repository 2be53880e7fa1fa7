"""Tar files as `webdataset` reads them: the files of one step follow each other, and all begin with its key.

OUT/<split>-000000.tar
  random-v0-00000012-003.points.npy, .normals.npy, .movable.npy, .part_ids.npy, .camera.npy
  random-v0-00000012-003.json        all other columns; null stands for NaN
"""

import io
import json
import tarfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from shared.formatting import finite
from shared.store.maintenance.formats import ExportFormat, Summary, nothing_to_finish, word
from shared.store.maintenance.steps import CLOUD_COLUMNS, Content, Piece, cells, step_tables

FILE_BYTES = 256 << 20


def _write(content: Content, piece: Piece, folder: Path, shard_done: Callable[[], None]) -> Summary:
    with tarfile.open(folder / f"{piece.split}-{piece.number:06d}.tar", "w", format=tarfile.USTAR_FORMAT) as tar:
        for table in step_tables(content, piece, shard_done):
            clouds = {column.name: cells(table.column(column.name)) for column in CLOUD_COLUMNS}
            for k, row in enumerate(table.drop_columns(list(clouds)).to_pylist()):
                key = f"{word(row['plan_key'])}-{row['rollout']:08d}-{row['step']:03d}"
                for name, each in clouds.items():
                    array = io.BytesIO()
                    np.save(array, each[k], allow_pickle=False)
                    _add(tar, f"{key}.{name.removeprefix('observation.')}.npy", array.getvalue())
                _add(tar, f"{key}.json", json.dumps(finite(row), default=str).encode())
    return {}


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Put a file there that tells nothing of who wrote it, or when."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    # Otherwise it remembers all members until it is closed.
    tar.members.clear()  # type: ignore[attr-defined]


def _patterns(content: Content) -> Mapping[str, Sequence[str]]:
    return {split: [f"{split}-*.tar"] for split in content.splits}


def _files(content: Content) -> Sequence[str]:
    return [
        "- `<split>-*.tar`: the files of a step follow each other: `.points.npy`, `.normals.npy`, `.movable.npy`,",
        "  `.part_ids.npy`, `.camera.npy`, and `.json` with all else, where null stands for NaN. Frame: the world.",
    ]


WEBDATASET = ExportFormat(
    "webdataset", FILE_BYTES, _write, nothing_to_finish, _files, ("webdataset",), _patterns, "application/x-tar"
)
