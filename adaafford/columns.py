"""What the readers of PLY and PCD share: header lines, numbers in text, and which columns make a cloud.

Every function raises `ValueError` with a reason that a user understands; `adaafford.scans` adds the file's name.
"""

import codecs
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from shared.io.text import plain
from shared.types import Float

Columns = dict[str, NDArray[np.generic]]
"""Of a file: "points" [M, 3], and where it has them "normals" [M, 3], "movable" [M], "camera" [3] and "up" [3]."""

MAX_SCAN_BYTES = 128 << 20
"""Of a file, and of what is packed in it."""
MAX_HEADER_BYTES = 1 << 20
MAX_NUMBERS = 8 * 1920 * 1080
"""In text: about three seconds of work and 133 MB."""
_PIECE_BYTES = 1 << 20
_GROUPS = (
    ("points", ("x", "y", "z")),
    ("normals", ("nx", "ny", "nz")),
    ("normals", ("normal_x", "normal_y", "normal_z")),
    ("movable", ("movable",)),
)
KNOWN = frozenset(name for _, names in _GROUPS for name in names)
_LINE_END = re.compile(rb"\r\n|\n|\r")
_SPACE = re.compile(rb"\s")
_NOT_FINITE = re.compile(rb"[-+]?(nan\(\w*\)|1\.#(qnan|snan|ind|inf)\w*)", re.IGNORECASE)
"""How the C library of Windows writes NaN and infinity."""


def without_mark(data: bytes) -> bytes:
    """The data without the byte order mark of UTF-8, which Windows' editors write; UTF-16 is refused."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError("is text in UTF-16; save it in UTF-8")
    return data.removeprefix(codecs.BOM_UTF8)


def shown(names: Iterable[str]) -> str:
    """The first names that a file gave, short and without control characters."""
    return " ".join(plain(name, 40) for name in islice(names, 12)) or "nothing"


def header_lines(data: bytes) -> Iterator[tuple[list[str], int]]:
    """The words of each line of a header, and the place where the next line begins.

    Lines end as the first one does, in a line feed (a carriage return before it is ignored) or a carriage return.
    """
    first = _LINE_END.search(data, 0, MAX_HEADER_BYTES)
    ending = b"\r" if first is not None and first[0] == b"\r" else b"\n"
    start = 0
    while (end := data.find(ending, start, MAX_HEADER_BYTES)) >= 0:
        yield [word.decode("latin-1") for word in data[start:end].split()], end + 1
        start = end + 1
    if len(data) <= MAX_HEADER_BYTES:
        raise ValueError(f"is cut off: its {len(data)} bytes end before its header does")
    raise ValueError(f"its header does not end within {MAX_HEADER_BYTES} bytes")


def whole_number(word: str, what: str) -> int:
    """A count that a header gives."""
    if not re.fullmatch(r"[0-9]{1,18}", word):
        raise ValueError(f"{what} is '{shown([word])}', which is no count")
    return int(word)


def numbers_of(text: bytes, start: int, most: int) -> tuple[Float, str]:
    """The numbers in text from `start` on, separated by any white space.

    Args:
        text: a whole file.
        start: where its numbers begin.
        most: how many are wanted; what follows them is not looked at.

    Returns:
        [K] with K <= `most`, and the word that ended them; "" where the text or `most` did.
    """
    if most > MAX_NUMBERS and len(text) - start > 2 * MAX_NUMBERS:
        raise ValueError(f"announces more than the {MAX_NUMBERS} numbers that are read as text; write it as binary")
    values, held = np.empty(min(most, (len(text) - start) // 2 + 1)), 0
    while start < len(text) and held < most:
        space = _SPACE.search(text, start + _PIECE_BYTES)
        end = len(text) if space is None else space.start()
        piece = text[start:end]
        words = piece.split()[: most - held]
        # Without an underscore, which is rare, Python's own reading will do and is faster.
        reading = number_of if b"_" in piece else float
        try:
            values[held : held + len(words)] = np.fromiter(map(reading, words), dtype=np.float64, count=len(words))
        except ValueError:
            for word in words:
                number = _number(word)
                if number is None:
                    return values[:held], word[:40].decode("latin-1")
                values[held] = number
                held += 1
        else:
            held += len(words)
        start = end
    return values[:held], ""


def number_of(word: bytes) -> float:
    """The number that a word in text is; Python alone would read 0.9_3 as 0.93."""
    if b"_" in word:
        raise ValueError(f"'{shown([word.decode('latin-1')])}' is no number")
    return float(word)


def too_few(announced: int, held: int, what: str, word: str = "") -> ValueError:
    """The error of a file that ends early, or at a word that is no number."""
    reason = f" before '{shown([word])}', which is no number" if word else ""
    return ValueError(f"announces {announced} {what} and holds {held}{reason}")


def too_many(announced: int, what: str) -> ValueError:
    """The error of a text that holds more numbers than its header explains, so that none can be told apart."""
    return ValueError(f"announces {announced} {what} and holds more numbers than these have")


def cloud_of(names: Sequence[str], column: Callable[[int], NDArray[np.generic]]) -> Columns:
    """The cloud among a file's columns.

    Args:
        names: of the columns.
        column: gives the n-th of them, [M].
    """
    found: Columns = {}
    for group, wanted in _GROUPS:
        if group in found or not set(wanted) <= set(names):
            continue
        if twice := [name for name in wanted if names.count(name) > 1]:
            raise ValueError(f"has the column {twice[0]} twice")
        columns = [column(names.index(name)) for name in wanted]
        found[group] = np.column_stack(columns) if len(columns) > 1 else columns[0]
    if "points" not in found:
        raise ValueError(f"has no x y z among {shown(names)}")
    return found


def _number(word: bytes) -> float | None:
    try:
        return number_of(word)
    except ValueError:
        return np.nan if _NOT_FINITE.fullmatch(word) else None
