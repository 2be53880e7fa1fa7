"""Parquet: rows to bytes and hostile bytes to columns."""

from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shared.documents import printable
from shared.errors import StoreError
from shared.store.columns import INTERACTION_COLUMNS, LIST, ROLLOUT_COLUMNS, Column
from shared.store.pages import unpacked_size

Row = TypeVar("Row")
Columns = Sequence[Column[Any]]

MAX_ROW_BYTES = 1 << 16
"""Uncompressed, on average; a row of an object with 255 parts has a tenth of it."""
MAX_TABLE_BYTES = 256 << 20
"""Uncompressed; as many rows as a shard may have take a tenth of it, unless their objects have dozens of parts."""
MAX_FOOTER_BYTES = 1 << 18
MAX_FOOTER_ITEMS = 256
"""Of each list in a footer, so that no schema is deeper; the store's have a third of it."""


def schema_of(columns: Columns) -> Any:
    """The pyarrow schema of some columns."""
    return pa.schema([column.field for column in columns])


ROLLOUT_SCHEMA = schema_of(ROLLOUT_COLUMNS)
INTERACTION_SCHEMA = schema_of(INTERACTION_COLUMNS)


def size_limit(rows: int) -> int:
    """Bytes that a table of so many rows has at the most, packed or unpacked."""
    return min((rows + 16) * MAX_ROW_BYTES, MAX_TABLE_BYTES)


def table_bytes(columns: Sequence[Column[Row]], rows: Sequence[Row]) -> bytes:
    """A Parquet file of `rows`.

    Raises:
        ValueError, TypeError, OverflowError: a row does not fit the columns.
        StoreError: the rows are too large for one file.
    """
    table = pa.Table.from_arrays([_array(column, rows) for column in columns], schema=schema_of(columns))
    if table.nbytes > size_limit(len(rows)):
        raise StoreError(f"{len(rows)} rows of {table.nbytes} bytes are too many for one shard; divide the job")
    sink = pa.BufferOutputStream()
    # Dictionaries only for text: Arrow's would take all NaNs, and both zeros, for one value.
    # Statistics would cost more than the rows of a small shard, and nobody filters within one.
    texts = _texts(columns)
    pq.write_table(table, sink, compression="zstd", compression_level=3, use_dictionary=texts, write_statistics=False)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_table(data: bytes, columns: Columns, rows: int, source: str, names: Sequence[str] | None = None) -> Any:
    """A table from hostile bytes.

    Args:
        data: a Parquet file.
        columns: those that it must have.
        rows: how many rows it must have.
        source: what messages call it.
        names: read these columns only.

    Raises:
        StoreError: not Parquet, other columns, another number of rows, absurdly large when unpacked, or a cell that its
            column does not allow.
    """
    wanted = [column for column in columns if names is None or column.name in names]
    try:
        table = _read(data, columns, wanted, rows, source)
    except (pa.ArrowException, OSError, ValueError, LookupError, OverflowError) as error:
        if isinstance(error, StoreError):
            raise
        line = printable(" ".join(str(error).split()), 100)
        raise StoreError(f"{source}: cannot be decoded ({line}); the file is damaged or foreign") from None
    left = size_limit(rows)
    for column in wanted:
        left -= _check_cells(table.column(column.name), column, left, source)
    return table.cast(_cached_schema(tuple(wanted)))


def _read(data: bytes, columns: Columns, wanted: Columns, rows: int, source: str) -> Any:
    """Some columns; texts as dictionaries, which do not grow by being repeated."""
    if int.from_bytes(data[-8:-4], "little") > MAX_FOOTER_BYTES:
        raise ValueError(f"a footer of more than {MAX_FOOTER_BYTES} bytes")
    file = pq.ParquetFile(
        pa.BufferReader(data),
        read_dictionary=_texts(columns),
        thrift_string_size_limit=MAX_FOOTER_BYTES,
        thrift_container_size_limit=MAX_FOOTER_ITEMS,
    )
    metadata = file.metadata
    if not file.schema_arrow.equals(_schema_when_read(tuple(columns))):
        raise StoreError(f"{source}: has other columns than this schema version; the file is damaged or foreign")
    if metadata.num_rows != rows or metadata.num_row_groups > 1:
        raise StoreError(f"{source}: {metadata.num_rows} rows; the manifest says {rows} rows: the file is foreign")
    if metadata.num_row_groups:
        group, names = metadata.row_group(0), frozenset(column.name for column in wanted)
        if group.num_rows != rows:
            raise ValueError(f"a group of {group.num_rows} rows")
        unpacked_size(data, group, names, size_limit(rows))
    table = file.read(columns=[column.name for column in wanted])
    table.validate(full=True)
    if len(table) != rows:
        raise ValueError(f"{len(table)} rows in the columns")
    return table


def _check_cells(cells: Any, column: Column[Any], most: int, source: str) -> int:
    """Hold the cells of a column to what it allows; returns the bytes of its texts."""
    size = 0
    for chunk in cells.chunks:
        if column.dtype:
            numbers = chunk.flatten() if column.width else chunk
            if column.finite and column.dtype[1] == "f" and not np.isfinite(numbers.to_numpy()).all():
                raise StoreError(f"{source}: column {column.name} holds a number that is not finite; it is foreign")
            continue
        words, indices = chunk.dictionary.to_pylist(), chunk.indices.to_numpy()
        for word in words:
            if column.allowed is not None and word not in list(column.allowed):
                raise StoreError(f"{source}: column {column.name} holds '{printable(word)}'; it is damaged or foreign")
            if len(word) > column.longest or not word.isprintable():
                what = f"a text of {len(word)} characters, '{printable(word, 40)}'"
                raise StoreError(f"{source}: column {column.name} holds {what}; it is damaged or foreign")
        lengths = np.array([len(word.encode()) for word in words], np.int64)
        size += int(lengths[indices].sum())
    if size > most:
        raise StoreError(f"{source}: column {column.name} unpacks to {size} bytes; the file is damaged or foreign")
    return size


@cache
def _cached_schema(columns: tuple[Column[Any], ...]) -> Any:
    return schema_of(columns)


@cache
def _schema_when_read(columns: tuple[Column[Any], ...]) -> Any:
    fields = [column.field for column in columns]
    return pa.schema(
        [f if f.type != pa.string() else f.with_type(pa.dictionary(pa.int32(), pa.string())) for f in fields]
    )


def _texts(columns: Columns) -> list[str]:
    return [column.name for column in columns if not column.dtype]


def column_values(table: Any, column: Column[Any]) -> Any:
    """A column as Python texts, as numbers [rows] or [rows, width], or as a list of arrays."""
    array = table.column(column.name).combine_chunks()
    if not column.dtype:
        return array.to_pylist()
    if not column.width:
        return array.to_numpy(zero_copy_only=False)
    numbers = array.flatten().to_numpy(zero_copy_only=False)
    if column.width == LIST:
        offsets = array.offsets.to_numpy()
        return [part.copy() for part in np.split(numbers, offsets[1:-1] - offsets[0])] if len(array) else []
    return numbers.reshape(-1, column.width)


def _array(column: Column[Row], rows: Sequence[Row]) -> Any:
    cells = column.gather(rows)
    if not column.dtype:
        return pa.array(cells.texts, pa.string())
    numbers = pa.array(cells.numbers)
    if column.width == LIST:
        offsets = pa.array(np.cumsum([0, *cells.lengths]), pa.int32())
        return pa.ListArray.from_arrays(offsets, numbers, type=column.arrow_type)
    if column.width:
        return pa.FixedSizeListArray.from_arrays(numbers, type=column.arrow_type)
    return numbers
