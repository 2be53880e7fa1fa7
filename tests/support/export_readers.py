"""Reads exports with the programs that they are for, by the Python of an environment that has these, not by ours.

python export_readers.py FOLDER ROWS     # FOLDER/hf, FOLDER/minari, ... in; FOLDER/<reader>-<split>.npz out
"""

import os
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

SPLITS = ("train", "test")


def by_datasets(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    import datasets

    with tempfile.TemporaryDirectory() as cache:
        yield from datasets.load_dataset(str(folder / "hf"), split=split, cache_dir=cache)


def by_duckdb(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    import duckdb

    found = duckdb.sql(f"SELECT * FROM '{folder}/hf/data/{split}-*.parquet'")  # noqa: S608
    for row in found.fetchall():
        yield dict(zip(found.columns, row, strict=True))


def by_polars(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    import polars

    return polars.scan_parquet(f"{folder}/hf/data/{split}-*.parquet").collect().to_dicts()


def by_webdataset(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    import webdataset

    files = sorted(map(str, (folder / "webdataset").glob(f"{split}-*.tar")))
    for sample in webdataset.WebDataset(files, shardshuffle=False).decode():
        clouds = {f"observation.{name[:-4]}": each for name, each in sample.items() if name.endswith(".npy")}
        yield clouds | sample["json"]


def by_minari(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    import minari

    for episode in minari.load_dataset(f"adaafford/push-{split}-v0"):
        groups = (("observation.", episode.observations), ("action.", episode.actions), ("", episode.infos))
        for step in range(len(episode)):
            yield {prefix + name: each[step] for prefix, group in groups for name, each in group.items()}


def by_lerobot(folder: Path, split: str) -> Iterable[dict[str, Any]]:
    import torch

    # A build of torchvision for GPUs asks for operators that a PyTorch without them lacks; none is used here.
    torch.library.register_fake = lambda *args, **kwargs: lambda function: function
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    told = LeRobotDataset("local/export", root=folder / "lerobot").meta.info["splits"][split]
    first, stop = map(int, told.split(":"))
    frames = LeRobotDataset("local/export", root=folder / "lerobot", episodes=list(range(first, stop)))
    assert len([frames[k] for k in range(len(frames))]) == len(frames)
    # Its tensors are of single precision, and so are the arrays of `datasets`.
    for row in frames.hf_dataset.with_format("arrow")[:].to_pylist():
        yield row | {"episode_index": row["episode_index"] - first}


READERS: dict[str, Callable[[Path, str], Iterable[dict[str, Any]]]] = {
    "datasets": by_datasets,
    "duckdb": by_duckdb,
    "polars": by_polars,
    "webdataset": by_webdataset,
    "minari": by_minari,
    "lerobot": by_lerobot,
}


def main() -> None:
    """Read with some readers, and keep the first rows as arrays by column."""
    folder, rows, *readers = sys.argv[1:]
    for name in readers:
        for split in SPLITS:
            found = list(READERS[name](Path(folder), split))
            first = found[: int(rows)]
            columns = {column: array_of([row[column] for row in first]) for column in first[0]}
            kept = {column: each for column, each in columns.items() if each is not None and each.dtype != object}
            np.savez(Path(folder) / f"{name}-{split}.npz", __count__=len(found), **kept)


def array_of(cells: list[Any]) -> Any:
    """Cells as one array; None where they are of several lengths, as the lists of all joints are."""
    return None if len({np.shape(cell) for cell in cells}) > 1 else np.array(cells)


if __name__ == "__main__":
    main()
