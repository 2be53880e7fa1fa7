"""PLY, the Stanford triangle format: the vertices of a file in any of its dialects, as text or binary.

This is our own reader because no library that installs everywhere from a wheel reads what depth cameras write: trimesh
takes a text that broke off for a whole one, both trimesh and plyfile want one line for each vertex, and plyfile
reserves gigabytes for a file of 200 bytes and is under the GPL. Elements behind the vertices (faces) are not read.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaafford.columns import (
    MAX_NUMBERS,
    Columns,
    cloud_of,
    header_lines,
    numbers_of,
    shown,
    too_few,
    too_many,
    whole_number,
)

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
    # Of no standard, but trimesh writes them.
    **{"int64": "i8", "uint64": "u8", "float16": "f2"},
}
_MAX_ELEMENTS, _MAX_PROPERTIES = 64, 1024
_FIRST_RUN = 64
"""How many rows with lists are taken at once at first."""
_MAX_LAYOUTS = 200_000
"""How many properties of rows with lists are laid out one by one: about three seconds of work."""


@dataclass(frozen=True, slots=True)
class _Property:
    """A column of an element. Kinds are NumPy's; `length_kind` is that of a list's length, and "" for a scalar."""

    name: str
    kind: str
    length_kind: str = ""


@dataclass(frozen=True, slots=True)
class _Element:
    """A table: so many rows of these properties."""

    name: str
    count: int
    properties: list[_Property]

    @property
    def rows(self) -> str:
        """What its rows are called in a message."""
        return "vertices" if self.name == "vertex" else f"rows of element '{shown([self.name])}'"


@dataclass(frozen=True, slots=True)
class _Body:
    """What follows a header.

    Attributes:
        data: the bytes of the file, or of a text's numbers.
        order: NumPy's sign for the order of bytes.
        kind: of every value, where it is one for all (a text's); "" where the header says it.
        word: what ended the numbers of a text, "" where nothing did.
    """

    data: NDArray[np.uint8]
    order: str
    kind: str = ""
    word: str = ""

    def dtype(self, kind: str) -> np.dtype[np.generic]:
        return np.dtype(self.order + (self.kind or kind))


def read_ply(data: bytes) -> Columns:
    """The cloud that the element "vertex" holds: x y z, and where it has them nx ny nz and movable.

    Raises:
        ValueError: it holds none, or is damaged, with the reason.
    """
    order, elements, start = _header(data)
    place = next((place for place, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise ValueError(f"has no element 'vertex' among {shown(element.name for element in elements)}")
    vertex = elements[place]
    if vertex.count == 0:
        raise ValueError("holds no vertices")
    if order:
        body = _Body(np.frombuffer(data, np.uint8), order)
    else:
        body, start = _numbers(data, start, elements[: place + 1], place + 1 == len(elements)), 0
    tables = list[NDArray[np.void]]()
    turns = iter(range(_MAX_LAYOUTS // max(1, *(len(each.properties) for each in elements[: place + 1]))))
    for element in elements[: place + 1]:
        tables, start = _rows(element, body, start, turns)
    names = ["" if each.length_kind else each.name for each in vertex.properties]
    return cloud_of(names, lambda n: np.concatenate([table[str(n)] for table in tables]))


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """NumPy's sign for the order of bytes ("" of a text), the elements, and the place where their rows begin."""
    lines = header_lines(data)
    if [word.lower() for word in next(lines)[0]] != ["ply"]:
        raise ValueError("does not begin with the line 'ply'")
    order: str | None = None
    elements: list[_Element] = []
    for words, end in lines:
        match [words[0].lower(), *words[1:]] if words else ["comment"]:
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, *_]:
                if name.lower() not in _ORDERS:
                    raise ValueError(f"its format is '{shown([name])}'; known: {' '.join(_ORDERS)}")
                order = _ORDERS[name.lower()]
            case ["element", name, count] if len(elements) < _MAX_ELEMENTS:
                name = name.lower()
                if any(each.name == name for each in elements):
                    raise ValueError(f"has the element '{shown([name])}' twice")
                elements.append(_Element(name, whole_number(count, f"the count of element '{shown([name])}'"), []))
            case ["property", "list" | "LIST", length_kind, kind, name] if _has_room(elements):
                elements[-1].properties.append(_Property(name, _kind(kind, name), _kind(length_kind, name)))
            case ["property", kind, name] if _has_room(elements):
                elements[-1].properties.append(_Property(name, _kind(kind, name)))
            case ["end_header"] if order is not None:
                return order, elements, end
            case ["end_header"]:
                raise ValueError("its header has no line 'format'")
            case _:
                raise ValueError(f"its header has the line '{shown([' '.join(words)])}'")
    raise AssertionError("header_lines raises where a header does not end")


def _has_room(elements: list[_Element]) -> bool:
    """Whether a property may follow."""
    return bool(elements) and len(elements[-1].properties) < _MAX_PROPERTIES


def _kind(name: str, of: str) -> str:
    if name.lower() not in _KINDS:
        raise ValueError(f"its property '{shown([of])}' has the type '{shown([name])}'; known: {' '.join(_KINDS)}")
    return _KINDS[name.lower()]


def _numbers(text: bytes, start: int, elements: list[_Element], to_the_end: bool) -> _Body:
    """The body of a text, as if it were a binary file of doubles: values are separated by any white space.

    Args:
        text: the file.
        start: where its rows begin.
        elements: those that are read.
        to_the_end: whether nothing follows them.
    """
    lists = any(each.length_kind for element in elements for each in element.properties)
    needed = sum(each.count * len(each.properties) for each in elements)
    values, word = numbers_of(text, start, MAX_NUMBERS if lists else needed + to_the_end)
    if to_the_end and not lists and values.size > needed:
        raise too_many(elements[-1].count, elements[-1].rows)
    return _Body(values.view(np.uint8), "=", "f8", word)


def _rows(element: _Element, body: _Body, start: int, turns: Iterator[int]) -> tuple[list[NDArray[np.void]], int]:
    """The rows of an element in tables whose fields are the places of its scalars, and the place behind them.

    Rows with lists are of any length; those that follow each other and are as long as the first are taken in one turn.
    """
    tables, done, run = list[NDArray[np.void]](), 0, _FIRST_RUN
    for _ in turns:
        wanted = element.count - done
        if wanted == 0 or not element.properties:
            return tables, start
        layout, lengths = _layout(element, body, start)
        count = min(wanted, run if lengths else wanted, (body.data.size - start) // layout.itemsize)
        if count == 0:
            break
        table = np.frombuffer(body.data, layout, count, start)
        same = np.logical_and.reduce([np.ones(count, bool), *(table[name] == length for name, length in lengths)])
        alike = count if same.all() else int(same.argmin())
        tables.append(table[:alike])
        start, done = start + alike * layout.itemsize, done + alike
        run = 4 * run if alike == count else _FIRST_RUN
    else:
        raise ValueError(f"the lists of its {element.rows} differ too often in length; save it as points alone")
    raise too_few(element.count, done, element.rows, body.word)


def _layout(element: _Element, body: _Body, start: int) -> tuple[np.dtype[np.void], list[tuple[str, int]]]:
    """How the row at `start` is laid out, and the fields that hold a list's length, with that length.

    The row may reach beyond the body; lists do not.
    """
    fields, lengths, place = list[tuple[object, ...]](), list[tuple[str, int]](), start
    for number, each in enumerate(element.properties):
        kind = body.dtype(each.kind)
        if not each.length_kind:
            fields.append((str(number), kind))
            place += kind.itemsize
            continue
        length_kind = body.dtype(each.length_kind)
        fields.append((f"length {number}", length_kind))
        place += length_kind.itemsize
        if place > body.data.size:
            break
        length = float(np.frombuffer(body.data, length_kind, 1, place - length_kind.itemsize)[0])
        if not (0 <= length <= body.data.size and length.is_integer()):
            raise ValueError(f"its {element.rows} have a list of {length:g} values")
        fields.append((f"list {number}", kind, (int(length),)))
        lengths.append((f"length {number}", int(length)))
        place += int(length) * kind.itemsize
    return np.dtype(fields), lengths
