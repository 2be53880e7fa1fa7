"""PCD, the Point Cloud Library's format: ascii, binary and binary_compressed files of versions 0.5 to 0.7.

No maintained package for Python reads it from a wheel on every machine, so this is our own reader.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from adaafford.columns import (
    KNOWN,
    MAX_SCAN_BYTES,
    Columns,
    cloud_of,
    header_lines,
    number_of,
    numbers_of,
    shown,
    too_few,
    too_many,
    whole_number,
)

_MAX_STEPS = 8_000_000
"""Of unpacking: about four seconds of work, and several times what a cloud in Full HD takes."""
_KEYWORDS = {"VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
_USUAL = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
_SCALARS = {"F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"}


@dataclass(frozen=True, slots=True)
class _Field:
    """A column of so many values a point; `kind` is NumPy's."""

    name: str
    kind: str
    count: int

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return self.count * int(self.kind[2:])


_Column = Callable[[int], NDArray[np.generic]]
"""Gives the n-th field of all points, [M]."""


def read_pcd(data: bytes) -> Columns:
    """The cloud of x y z, and where the file has them normal_x normal_y normal_z, movable, and the camera (VIEWPOINT).

    Raises:
        ValueError: it holds none, or is damaged, with the reason.
    """
    header, start = _header(data)
    fields, points = _fields(header), _points(header)
    if points == 0:
        raise ValueError("holds no points")
    readers = {"ascii": _from_text, "binary": _from_rows, "binary_compressed": _from_compressed}
    encoding = " ".join(header["DATA"])
    if encoding not in readers:
        raise ValueError(f"its DATA is '{shown([encoding])}'; known: {' '.join(readers)}")
    found = cloud_of([field.name for field in fields], readers[encoding](data, start, fields, points))
    if "VIEWPOINT" in header:
        found["camera"] = _viewpoint(header["VIEWPOINT"])
    return found


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """What follows each keyword, and the place behind the header."""
    entries: dict[str, list[str]] = {}
    for words, end in header_lines(data):
        if not words or words[0].startswith("#"):
            continue
        # Files of version 0.5 have COLUMNS.
        keyword = "FIELDS" if words[0].upper() == "COLUMNS" else words[0].upper()
        if keyword not in _KEYWORDS:
            raise ValueError(f"its header has the line '{shown([' '.join(words)])}'")
        entries[keyword] = words[1:]
        if keyword == "DATA":
            return entries, end
    raise AssertionError("header_lines raises where a header does not end")


def _fields(header: dict[str, list[str]]) -> list[_Field]:
    """The columns; sizes, types and counts that are left out are 4, F and 1, as in the Point Cloud Library."""
    if "FIELDS" not in header:
        raise ValueError(f"its header has no FIELDS; it has {shown(header)}")
    names = header["FIELDS"]
    sizes, kinds, counts = (header.get(key, [usual] * len(names)) for key, usual in _USUAL.items())
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("its FIELDS, SIZE, TYPE and COUNT differ in length")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        # The Point Cloud Library reads types in either case.
        if kind.upper() + size not in _SCALARS:
            raise ValueError(f"its field '{shown([name])}' is of TYPE '{shown([kind])}' and SIZE '{shown([size])}'")
        fields.append(_Field(name, f"<{kind.lower()}{size}", whole_number(count, f"the COUNT of '{shown([name])}'")))
        if name in KNOWN and fields[-1].count != 1:
            raise ValueError(f"its field {name!r} has {fields[-1].count} values a point")
    return fields


def _points(header: dict[str, list[str]]) -> int:
    """How many points it announces: POINTS, and WIDTH times HEIGHT, which must agree where both are there."""
    told = {key: whole_number(" ".join(header[key]), key) for key in ("POINTS", "WIDTH", "HEIGHT") if key in header}
    if "WIDTH" not in told and "POINTS" not in told:
        raise ValueError(f"its header has neither POINTS nor WIDTH; it has {shown(header)}")
    area = told.get("WIDTH", 0) * told.get("HEIGHT", 1)
    if area and told.get("POINTS", area) != area:
        raise ValueError(f"its POINTS are {told['POINTS']}, but WIDTH times HEIGHT is {area}")
    return told.get("POINTS", area)


def _viewpoint(words: list[str]) -> NDArray[np.float64]:
    try:
        return np.array([number_of(word.encode("latin-1")) for word in words[:3]])
    except ValueError:
        raise ValueError(f"its VIEWPOINT is '{shown(words)}', which are no numbers") from None


def _from_text(data: bytes, start: int, fields: list[_Field], points: int) -> _Column:
    width = sum(field.count for field in fields)
    values, word = numbers_of(data, start, points * width + 1)
    if values.size > points * width:
        raise too_many(points, "points")
    if values.size < points * width:
        raise too_few(points, values.size // width, "points", word)
    table = values.reshape(points, width)
    return lambda place: table[:, sum(field.count for field in fields[:place])]


def _from_rows(data: bytes, start: int, fields: list[_Field], points: int) -> _Column:
    row = sum(field.size for field in fields)
    if points * row > len(data) - start:
        raise too_few(points, (len(data) - start) // row, "points")

    def column(place: int) -> NDArray[np.generic]:
        begin = start + sum(field.size for field in fields[:place])
        return np.ndarray(points, fields[place].kind, data, begin, row)

    return column


def _from_compressed(data: bytes, start: int, fields: list[_Field], points: int) -> _Column:
    """Of LZF data in which the columns follow one another; no more than what is needed is unpacked."""
    if len(data) < start + 8:
        raise ValueError("ends before its compressed data")
    (packed, unpacked), start = struct.unpack_from("<II", data, start), start + 8
    if packed > len(data) - start:
        raise ValueError(f"announces {packed} compressed bytes and holds {len(data) - start}")
    sizes = [points * field.size for field in fields]
    if unpacked != sum(sizes):
        # The Point Cloud Library leaves padding out of compressed files.
        sizes = [0 if field.name == "_" else size for field, size in zip(fields, sizes, strict=True)]
    if unpacked != sum(sizes):
        raise ValueError(f"announces {unpacked} bytes of {points} points, which take {sum(sizes)}")
    ends = list(accumulate(sizes))
    wanted = max((end for field, end in zip(fields, ends, strict=True) if field.name in KNOWN), default=0)
    if wanted > MAX_SCAN_BYTES:
        raise ValueError(f"unpacks to more than {MAX_SCAN_BYTES} bytes; keep fewer points or fields")
    columns = _unpacked(data, start, start + packed, wanted)
    return lambda place: np.frombuffer(columns, fields[place].kind, points, ends[place] - sizes[place])


def _unpacked(data: bytes, start: int, end: int, wanted: int) -> bytearray:
    """The first `wanted` bytes of LZF data between two places."""
    out, place = bytearray(), start
    for _ in range(_MAX_STEPS):
        if len(out) >= wanted:
            return out
        if place + 2 > end:
            break
        control = data[place]
        place += 1
        if control < 32:  # So many bytes and one follow as they are.
            if place + control + 1 > end:
                break
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place]
            place += 1
        if place >= end:
            break
        back = (control & 31) * 256 + data[place] + 1
        place += 1
        begin, length = len(out) - back, length + 2
        if begin < 0:
            break
        # What is repeated may reach into its own copy.
        out += out[begin : begin + length] if back >= length else (out[begin:] * (length // back + 1))[:length]
    else:
        raise ValueError("takes too long to unpack; write it as binary")
    raise ValueError(f"its compressed data are damaged: {len(out)} of {wanted} bytes can be unpacked")
