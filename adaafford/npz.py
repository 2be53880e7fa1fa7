"""NPZ, NumPy's archive of arrays: read without pickle, with checked sizes."""

import io
import struct
import tokenize
import warnings
import zipfile
import zlib
from math import prod
from typing import IO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from adaafford.columns import MAX_SCAN_BYTES, Columns, shown

_NAMES = ("points", "normals", "movable", "camera", "up")
_MAX_ENTRIES = 4096
_DAMAGED: tuple[type[Exception], ...] = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, OSError, EOFError),
    *(RuntimeError, SyntaxError, zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError),
)
"""What `zipfile` and `numpy.lib.format` raise when bytes are not what they pretend to be."""


def read_npz(data: bytes, names: tuple[str, ...] = _NAMES) -> Columns:
    """The first array of some names, and the others where they are there.

    Raises:
        ValueError: it holds no such arrays of numbers, or is damaged, with the reason.
    """
    # Each entry becomes an object of some 500 bytes, though it takes 46 in the file.
    if data.count(b"PK\1\2") > _MAX_ENTRIES:
        raise ValueError(f"holds more than {_MAX_ENTRIES} arrays")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            if names[0] not in entries:
                raise ValueError(f"has no array {names[0]!r}; it holds {shown(entries)}")
            wanted = {name: entries[name] for name in names if name in entries}
            if sum(entry.file_size for entry in wanted.values()) > MAX_SCAN_BYTES:
                raise ValueError(f"unpacks to more than {MAX_SCAN_BYTES} bytes")
            found: Columns = {}
            for name, entry in wanted.items():
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"its array {name!r} is packed otherwise than NumPy does")
                with archive.open(entry) as file:
                    found[name] = _array(file, name, entry.file_size)
            return found
    except _DAMAGED as error:
        raise ValueError(" ".join(str(error).split())[:200] or type(error).__name__) from None


def read_npy(file: IO[bytes], name: str, size: int) -> NDArray[np.generic]:
    """An array of numbers from an NPY file of `size` bytes.

    Raises:
        ValueError: it is none, or damaged, with the reason.
    """
    try:
        return _array(file, name, size)
    except _DAMAGED as error:
        raise ValueError(" ".join(str(error).split())[:200] or type(error).__name__) from None


def _array(file: IO[bytes], name: str, size: int) -> NDArray[np.generic]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns of files that Python 2 wrote, which it reads.
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, in_columns, dtype = read_header(file)
    if dtype.kind not in "biuf":
        raise ValueError(f"its array {name!r} holds {shown([str(dtype)])}, not numbers")
    # The shape is made of whole numbers of any size and sign.
    if min(shape, default=0) < 0 or prod(shape) * dtype.itemsize > size:
        raise ValueError(f"its array {name!r} announces the shape {shown([str(shape)])} and holds less")
    values = file.read(size)
    if len(values) != prod(shape) * dtype.itemsize:
        raise ValueError(f"its array {name!r} of shape {shown([str(shape)])} takes {len(values)} bytes")
    return np.frombuffer(values, dtype).reshape(shape, order="F" if in_columns else "C")
