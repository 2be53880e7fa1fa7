"""What the pages of a Parquet file unpack to, told from their headers before anything is unpacked.

A file of some kilobytes may claim gigabytes: in the size of a page, in the run length of a column, or by repeating one
long text of a dictionary. Neither the file's footer nor its reader bounds that. The store writes few of the kinds of
pages that there are, and only those are let through, for which the size of what comes out follows from the header.

A header is a struct in the compact protocol of Thrift.
"""

from collections.abc import Collection
from typing import Any

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
