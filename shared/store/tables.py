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


def table_bytes(columns: Sequence[Column[Row]], rows: Sequence[Row], unknown: Any = None) -> bytes:
    """A Parquet file of `rows`.

    Args:
        columns: of the table.
        rows: what the cells are computed from.
        unknown: columns of these rows that newer software wrote, as `unknown_columns` has them; kept as they are.

    Raises:
        ValueError, TypeError, OverflowError: a row does not fit the columns.
    """
    table = pa.Table.from_arrays([_array(column, rows) for column in columns], schema=schema_of(columns))
    for name in () if unknown is None else unknown.column_names:
        if name not in table.column_names:
            table = table.append_column(unknown.schema.field(name), unknown.column(name))
    sink = pa.BufferOutputStream()
    # Dictionaries only for text: Arrow's would take all NaNs, and both zeros, for one value.
    # Statistics would cost more than the rows of a small shard, and nobody filters within one.
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    pq.write_table(table, sink, compression="zstd", compression_level=3, use_dictionary=texts, write_statistics=False)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_table(
    data: bytes, columns: Sequence[Column[Any]], rows: int, source: str, names: Sequence[str] | None = None
) -> Any:
    """A table from hostile bytes: the known columns, in their order, then those that newer software added.

    Args:
        data: a Parquet file.
        columns: what it must hold; what has a default may be missing.
        rows: how many rows it must have.
        source: what messages call it.
        names: read these columns only.

    Raises:
        StoreError: not Parquet, other columns, another number of rows, or absurdly large when unpacked.
    """
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        metadata, there = file.metadata, file.schema_arrow
        missing = _missing(there, columns, source)
        unpacked = sum(metadata.row_group(k).total_byte_size for k in range(metadata.num_row_groups))
        if metadata.num_rows != rows or unpacked > (rows + 16) * MAX_ROW_BYTES:
            raise StoreError(f"{source}: {metadata.num_rows} rows, {unpacked} bytes; the manifest says {rows} rows")
        known = [column.name for column in columns]
        wanted = list(names) if names is not None else [*known, *(n for n in there.names if n not in known)]
        table = file.read(columns=[name for name in wanted if name in there.names])
        table.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        line = " ".join(str(error).split())[:100]
        raise StoreError(f"{source}: cannot be decoded ({line}); the file is damaged or foreign") from None
    for column in columns:
        if column in missing:
            table = table.append_column(column.field, pa.array([column.default] * rows, column.arrow_type))
        elif column.name in table.column_names and table.schema.field(column.name).nullable:
            # Older software wrote this shard anew, from some that had the column and some that had not.
            cells = [column.default if cell is None else cell for cell in table.column(column.name).to_pylist()]
            place = table.column_names.index(column.name)
            table = table.set_column(place, column.field, pa.array(cells, column.arrow_type))
    return table.select(wanted)


def unknown_columns(table: Any, columns: Sequence[Column[Any]], key: str) -> Any:
    """Columns of a table that this software does not know, beside its column `key`; missing values may be filled in."""
    known = {column.name for column in columns}
    fields = [field for field in table.schema if field.name == key or field.name not in known]
    return table.select([field.name for field in fields]).cast(pa.schema([f.with_nullable(True) for f in fields]))


def joined(tables: Sequence[Any], source: str) -> Any:
    """Tables of `unknown_columns`, one below the other; what one of them lacks is null there.

    Raises:
        StoreError: a column is of two types.
    """
    try:
        return pa.concat_tables(tables, promote_options="default")
    except pa.ArrowException:
        raise StoreError(
            f"{source}: a column that this software does not know is of two types; use the software that wrote it"
        ) from None


def _missing(there: Any, columns: Sequence[Column[Any]], source: str) -> list[Column[Any]]:
    """Columns that a file lacks and that have a default.

    Raises:
        StoreError: another column is missing, or one is of another type.
    """
    names = there.names
    for column in columns:
        found = names.count(column.name)
        nullable = found == 1 and column.default is not None and there.field(column.name).nullable
        is_right = found == 1 and there.field(column.name).equals(column.field.with_nullable(nullable))
        if not is_right and (found or column.default is None):
            raise StoreError(f"{source}: has other columns than this schema version; the file is damaged or foreign")
    if len(set(names)) != len(names):
        raise StoreError(f"{source}: has two columns of one name; the file is damaged or foreign")
    return [column for column in columns if column.name not in names]


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
