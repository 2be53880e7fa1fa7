"""Parquet as `datasets`, DuckDB and Polars read it; a row holds all of one step.

OUT/data/<split>-00000-of-00003.parquet
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from shared.store.maintenance.formats import ExportFormat, Summary, nothing_to_finish
from shared.store.maintenance.steps import Content, Piece, parquet_writer, step_tables

FILE_BYTES = 256 << 20
"""Of the clouds of a file, not compressed; a file has a fraction of it."""


def _write(content: Content, piece: Piece, folder: Path, shard_done: Callable[[], None]) -> Summary:
    path = folder / f"data/{piece.split}-{piece.number:05d}-of-{piece.of:05d}.parquet"
    path.parent.mkdir()
    with parquet_writer(path, content.schema) as writer:
        for table in step_tables(content, piece, shard_done):
            writer.write_table(table)
    return {}


def _patterns(content: Content) -> Mapping[str, Sequence[str]]:
    return {split: [f"data/{split}-*.parquet"] for split in content.splits}


def _files(content: Content) -> Sequence[str]:
    return [
        "- `data/<split>-*.parquet`: one row a step; a cloud is a fixed-size list. Every column is described in the",
        "  files' schema. Steps that were tried from one observed state repeat its cloud.",
    ]


HF = ExportFormat("hf", FILE_BYTES, _write, nothing_to_finish, _files, (), _patterns, schema=lambda c: c.schema)
