"""Parquet: rows to bytes and hostile bytes to columns."""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shared.errors import StoreError
from shared.store.columns import INTERACTION_COLUMNS, LIST, ROLLOUT_COLUMNS, Column

Row = TypeVar("Row")

MAX_ROW_BYTES = 1 << 16
"""Uncompressed, on average; a row of an object with 255 parts has a tenth of it."""


def schema_of(columns: Sequence[Column[Any]]) -> Any:
    """The pyarrow schema of some columns."""
    return pa.schema([column.field for column in columns])


ROLLOUT_SCHEMA = schema_of(ROLLOUT_COLUMNS)
INTERACTION_SCHEMA = schema_of(INTERACTION_COLUMNS)


def table_bytes(columns: Sequence[Column[Row]], rows: Sequence[Row]) -> bytes:
    """A Parquet file of `rows`.

    Raises:
        ValueError, TypeError, OverflowError: a row does not fit the columns.
    """
    table = pa.Table.from_arrays([_array(column, rows) for column in columns], schema=schema_of(columns))
    sink = pa.BufferOutputStream()
    # Dictionaries only for text: Arrow's would take all NaNs, and both zeros, for one value.
    # Statistics would cost more than the rows of a small shard, and nobody filters within one.
    texts = [column.name for column in columns if not column.dtype]
    pq.write_table(table, sink, compression="zstd", compression_level=3, use_dictionary=texts, write_statistics=False)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_table(data: bytes, schema: Any, rows: int, source: str, names: Sequence[str] | None = None) -> Any:
    """A table from hostile bytes.

    Args:
        data: a Parquet file.
        schema: what its schema must equal.
        rows: how many rows it must have.
        source: what messages call it.
        names: read these columns only.

    Raises:
        StoreError: not Parquet, another schema, another number of rows, or absurdly large when unpacked.
    """
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        metadata = file.metadata
        if not file.schema_arrow.equals(schema):
            raise StoreError(f"{source}: has other columns than this schema version; the file is damaged or foreign")
        unpacked = sum(metadata.row_group(k).total_byte_size for k in range(metadata.num_row_groups))
        if metadata.num_rows != rows or unpacked > (rows + 16) * MAX_ROW_BYTES:
            raise StoreError(f"{source}: {metadata.num_rows} rows, {unpacked} bytes; the manifest says {rows} rows")
        table = file.read(columns=None if names is None else list(names))
        table.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        line = " ".join(str(error).split())[:100]
        raise StoreError(f"{source}: cannot be decoded ({line}); the file is damaged or foreign") from None
    return table


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
