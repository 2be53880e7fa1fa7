"""Parquet: rows to bytes and hostile bytes to columns.

What the pages of a file unpack to is told from their headers before anything is unpacked. A file of some kilobytes may
claim gigabytes: in the size of a page, in the run length of a column, or by repeating one long text of a dictionary.
Neither the file's footer nor its reader bounds that. The store writes few of the kinds of pages that there are, and
only those are let through, for which the size of what comes out follows from the header. A header is a struct in the
compact protocol of Thrift.
"""

from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shared.errors import StoreError
from shared.io.text import MAX_WORD, plain
from shared.store.codecs.columns import LIST, Column, added_column, added_in

MAX_PAGES = 4096
"""Of a file; the store's have a page or two a column, and one more for each megabyte."""
_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
_ABOUT = {_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}
"""The field of a header that tells of a page of this kind."""
_PLAIN, _PLAIN_DICTIONARY, _RLE_DICTIONARY = 0, 2, 8
_CODECS = ("ZSTD", "SNAPPY", "UNCOMPRESSED")
_ITEM_BITS = {"BOOLEAN": 1, "INT32": 32, "INT64": 64, "FLOAT": 32, "DOUBLE": 64}
_TEXT = "BYTE_ARRAY"
_MOST_FIELDS = 32
_TRUE, _FALSE, _BYTE, _SHORT, _INT, _LONG, _BINARY, _STRUCT = 1, 2, 3, 4, 5, 6, 8, 12
_DEEPEST = 3
_LONGEST_VARINT = 10


def unpacked_size(data: bytes, group: Any, columns: Collection[str] | None, most: int) -> int:
    """How many bytes the pages of some columns unpack to; texts of a dictionary count once.

    Args:
        data: the file.
        group: metadata of its row group, which are as hostile.
        columns: names of those that will be read; None: all.
        most: bytes that are allowed.

    Raises:
        ValueError: more, or a page that the store does not write, or that contradicts the metadata.
    """
    size = pages = 0
    for number in range(group.num_columns):
        column = group.column(number)
        if columns is not None and column.path_in_schema.partition(".")[0] not in columns:
            continue
        walked = _walk(data, column, group.num_rows, most - size, MAX_PAGES - pages)
        size, pages = size + walked[0], pages + walked[1]
    return size


def _walk(data: bytes, column: Any, rows: int, most: int, most_pages: int) -> tuple[int, int]:
    """Bytes unpacked and pages of one column."""
    name, kind = column.path_in_schema[:80], column.physical_type
    if column.compression not in _CODECS or (kind != _TEXT and kind not in _ITEM_BITS):
        raise ValueError(f"column {name} is {kind} in {column.compression}")
    if not column.num_values:
        # No page is read, and a file without rows has none.
        return 0, 0
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < (column.dictionary_page_offset or 0) < start:
        start = column.dictionary_page_offset
    place, stop = start, start + column.total_compressed_size
    if not 0 < start <= stop <= len(data):
        raise ValueError(f"column {name} is outside of the file")
    size = values = pages = 0
    while place < stop:
        header, place = _struct(data, place, stop)
        kind_of_page, unpacked, packed = (header.get(field) for field in (1, 2, 3))
        about = header.get(_ABOUT.get(kind_of_page, 0)) if type(kind_of_page) is int else None
        if not isinstance(about, dict) or type(unpacked) is not int or type(packed) is not int:
            raise ValueError(f"column {name} has a page of an unknown kind")
        count, encoding = about.get(1), about.get(4 if kind_of_page == _DATA_V2 else 2)
        size, pages, place = size + max(unpacked, 0), pages + 1, place + packed
        if type(count) is not int or min(count, unpacked, packed) < 0 or place > stop:
            raise ValueError(f"column {name} has a page outside of it")
        if size > most or pages > most_pages:
            raise ValueError(f"column {name} unpacks to more than {most} bytes or {most_pages} pages")
        if kind_of_page == _DICTIONARY:
            allowed = kind == _TEXT and encoding in (_PLAIN, _PLAIN_DICTIONARY) and 4 * count <= unpacked and pages == 1
        else:
            allowed = encoding == _PLAIN or (kind == _TEXT and encoding in (_PLAIN_DICTIONARY, _RLE_DICTIONARY))
            values += count
        if not allowed:
            raise ValueError(f"column {name} has a page in encoding {encoding} with {count} values")
    # A text takes no more memory than its length and its index; a number of an empty list takes none.
    fit = rows if "." not in name else rows + 8 * size // _ITEM_BITS.get(kind, 64)
    if values != column.num_values or values > fit:
        raise ValueError(f"column {name} has {values} values in its pages, {column.num_values} by its metadata")
    return size, pages


def _struct(data: bytes, place: int, stop: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """The integers and structs in a struct, by field; texts are skipped."""
    fields: dict[int, Any] = {}
    field = 0
    while place < stop:
        step, kind = data[place] >> 4, data[place] & 15
        place += 1
        if kind == 0:
            return fields, place
        if step:
            field += step
        else:
            field, place = _integer(data, place, stop)
        if kind in (_TRUE, _FALSE):
            fields[field] = kind == _TRUE
        elif kind in (_SHORT, _INT, _LONG):
            fields[field], place = _integer(data, place, stop)
        elif kind == _BYTE:
            place += 1
        elif kind == _BINARY:
            length, place = _varint(data, place, stop)
            place += length
        elif kind == _STRUCT and depth < _DEEPEST:
            fields[field], place = _struct(data, place, stop, depth + 1)
        else:
            raise ValueError(f"a page's header has a field of kind {kind}")
        if len(fields) > _MOST_FIELDS:
            break
    raise ValueError("a page's header has no end")


def _integer(data: bytes, place: int, stop: int) -> tuple[int, int]:
    # Most integers of a header have one byte.
    if place < stop and (number := data[place]) < 128:
        place += 1
    else:
        number, place = _varint(data, place, stop)
    return (number >> 1) ^ -(number & 1), place


def _varint(data: bytes, place: int, stop: int) -> tuple[int, int]:
    number = 0
    for shift in range(0, 7 * _LONGEST_VARINT, 7):
        if place >= stop:
            break
        byte = data[place]
        place += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, place
    raise ValueError("a page's header is cut off")


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


def size_limit(rows: int) -> int:
    """Bytes that a table of so many rows has at the most, packed or unpacked."""
    return min((rows + 16) * MAX_ROW_BYTES, MAX_TABLE_BYTES)


def table_bytes(columns: Sequence[Column[Row]], rows: Sequence[Row], unknown: Any = None) -> bytes:
    """A Parquet file of `rows`.

    Args:
        columns: of the table.
        rows: what the cells are computed from.
        unknown: columns of these rows that newer software wrote, as `unknown_columns` has them; kept as they are.

    Raises:
        ValueError, TypeError, OverflowError: a row does not fit the columns.
        StoreError: the rows are too large for one file.
    """
    table = pa.Table.from_arrays([_array(column, rows) for column in columns], schema=schema_of(columns))
    for name in () if unknown is None else unknown.column_names:
        if name not in table.column_names:
            table = table.append_column(unknown.schema.field(name), unknown.column(name))
    if table.nbytes > size_limit(len(rows)):
        raise StoreError(f"{len(rows)} rows of {table.nbytes} bytes are too many for one shard; divide the job")
    sink = pa.BufferOutputStream()
    # Dictionaries only for text: Arrow's would take all NaNs, and both zeros, for one value.
    # Statistics would cost more than the rows of a small shard, and nobody filters within one.
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    pq.write_table(table, sink, compression="zstd", compression_level=3, use_dictionary=texts, write_statistics=False)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_table(data: bytes, columns: Columns, rows: int, source: str, names: Sequence[str] | None = None) -> Any:
    """A table from hostile bytes: the known columns, in their order, then those that newer software added.

    Args:
        data: a Parquet file.
        columns: what it must hold; what has a default may be missing. Further hidden parameters may come beside
            them, whether their packages are installed here or not.
        rows: how many rows it must have.
        source: what messages call it.
        names: read these columns only.

    Raises:
        StoreError: not Parquet, other columns, another number of rows, absurdly large when unpacked, or a cell that its
            column does not allow.
    """
    try:
        table, columns = _read(data, columns, rows, source, names)
    except (pa.ArrowException, OSError, ValueError, LookupError, OverflowError) as error:
        if isinstance(error, StoreError):
            raise
        line = plain(" ".join(str(error).split()), 100)
        raise StoreError(f"{source}: cannot be decoded ({line}); the file is damaged or foreign") from None
    left, there = size_limit(rows), set(table.column_names)
    fields, arrays = [], []
    for column in columns:
        if names is not None and column.name not in names:
            continue
        fields.append(column.field)
        if column.name not in there:
            arrays.append(pa.array([column.default] * rows, column.arrow_type))
            continue
        cells = table.column(column.name)
        left -= _check_cells(cells, column, left, source)
        if cells.type != column.arrow_type:
            cells = cells.cast(column.arrow_type)
        if cells.null_count:
            # Older software wrote this shard anew, from some that had the column and some that had not.
            filled = [column.default if cell is None else cell for cell in cells.to_pylist()]
            cells = pa.array(filled, column.arrow_type)
        arrays.append(cells)
    known = {column.name for column in columns}
    for field in table.schema:
        if field.name not in known:
            cells = table.column(field.name)
            if pa.types.is_dictionary(field.type):
                left -= _size_of_texts(cells)
                if left < 0:
                    raise StoreError(
                        f"{source}: column {plain(field.name, MAX_WORD)} is too large; the file is foreign"
                    )
                cells = cells.cast(field.type.value_type)
            fields.append(pa.field(field.name, cells.type, field.nullable))
            arrays.append(cells)
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def with_added(columns: Columns, there: Sequence[str]) -> Columns:
    """Columns, and those of further hidden parameters among what is there."""
    return (*columns, *(added_column(name, content=False) for name in added_in(there)))


def unknown_columns(table: Any, columns: Columns, key: str) -> Any:
    """Columns of a table that this software does not know, beside its column `key`; missing values may be filled in."""
    known = {column.name for column in with_added(columns, table.column_names)}
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


def _read(data: bytes, columns: Columns, rows: int, source: str, names: Sequence[str] | None) -> tuple[Any, Columns]:
    """Some columns, or all, and which are known; texts as dictionaries, which do not grow by being repeated."""
    texts = [column.name for column in columns if not column.dtype and column.default is None]
    file = _open(data, texts)
    there = file.schema_arrow
    columns = with_added(columns, there.names)
    _check_columns(there, columns, source)
    wanted = [name for name in there.names if names is None or name in names]
    if more := [name for name in wanted if pa.types.is_string(there.field(name).type)]:
        # Of newer software, or added later, so that it was not known before whether the file has them.
        file = _open(data, [*texts, *more])
    metadata = file.metadata
    if metadata.num_rows != rows or metadata.num_row_groups > 1:
        raise StoreError(f"{source}: {metadata.num_rows} rows; the manifest says {rows} rows: the file is foreign")
    if metadata.num_row_groups:
        group = metadata.row_group(0)
        if group.num_rows != rows:
            raise ValueError(f"a group of {group.num_rows} rows")
        unpacked_size(data, group, frozenset(wanted), size_limit(rows))
    # In this thread: a worker of Arrow's that lets go of `data` while Python ends brings the process down (SIGABRT).
    table = file.read(columns=wanted, use_threads=False)
    table.validate(full=True)
    if len(table) != rows:
        raise ValueError(f"{len(table)} rows in the columns")
    return table, columns


def _open(data: bytes, texts: Sequence[str]) -> Any:
    """A Parquet file whose footer is bounded, and some of whose columns are read as dictionaries."""
    if int.from_bytes(data[-8:-4], "little") > MAX_FOOTER_BYTES:
        raise ValueError(f"a footer of more than {MAX_FOOTER_BYTES} bytes")
    return pq.ParquetFile(
        pa.BufferReader(data),
        read_dictionary=list(texts),
        thrift_string_size_limit=MAX_FOOTER_BYTES,
        thrift_container_size_limit=MAX_FOOTER_ITEMS,
    )


def _check_columns(there: Any, columns: Columns, source: str) -> None:
    """Check that a file has the columns that it must have, and none twice.

    Raises:
        StoreError: a column is missing that has no default, or one is of another type.
    """
    names = there.names
    if names == [column.name for column in columns] and there.equals(_schema_when_read(tuple(columns))):
        return
    if len(set(names)) != len(names):
        raise StoreError(f"{source}: has two columns of one name; the file is damaged or foreign")
    for column, field in zip(columns, _schema_when_read(tuple(columns)), strict=True):
        is_there = column.name in names
        nullable = is_there and column.default is not None and there.field(column.name).nullable
        is_right = is_there and there.field(column.name).equals(field.with_nullable(nullable))
        if not is_right and (is_there or column.default is None):
            raise StoreError(f"{source}: has other columns than this schema version; the file is damaged or foreign")


def _check_cells(cells: Any, column: Column[Any], most: int, source: str) -> int:
    """Hold the cells of a column to what it allows; returns the bytes of its texts."""
    if column.dtype:
        for chunk in cells.chunks if column.finite and column.dtype[1] == "f" else ():
            numbers = chunk.flatten() if column.width else chunk
            if not np.isfinite((numbers.drop_null() if numbers.null_count else numbers).to_numpy()).all():
                raise StoreError(f"{source}: column {column.name} holds a number that is not finite; it is foreign")
        return 0
    allowed = None if column.allowed is None else set(column.allowed)
    for chunk in cells.chunks:
        for word in chunk.dictionary.to_pylist():
            if allowed is not None and word not in allowed:
                raise StoreError(
                    f"{source}: column {column.name} holds '{plain(word, MAX_WORD)}'; it is damaged or foreign"
                )
            if len(word) > column.longest or not word.isprintable():
                what = f"a text of {len(word)} characters, '{plain(word, 40)}'"
                raise StoreError(f"{source}: column {column.name} holds {what}; it is damaged or foreign")
    size = _size_of_texts(cells)
    if size > most:
        raise StoreError(f"{source}: column {column.name} unpacks to {size} bytes; the file is damaged or foreign")
    return size


def _size_of_texts(cells: Any) -> int:
    """Bytes of the texts that a column of dictionaries stands for."""
    size = 0
    for chunk in cells.chunks:
        lengths = np.array([len((word or "").encode()) for word in chunk.dictionary.to_pylist()], np.int64)
        size += int(lengths[chunk.indices.drop_null().to_numpy()].sum())
    return size


@lru_cache(maxsize=64)
def _schema_when_read(columns: tuple[Column[Any], ...]) -> Any:
    texts = pa.dictionary(pa.int32(), pa.string())
    return pa.schema(
        [
            column.field.with_type(texts) if not column.dtype and column.default is None else column.field
            for column in columns
        ]
    )


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
