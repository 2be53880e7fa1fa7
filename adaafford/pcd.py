"""PCD, the Point Cloud Library's format: as much of it as depth cameras write (ascii and binary, scalar fields)."""

import warnings

import numpy as np
from numpy.typing import NDArray

MAX_HEADER_BYTES = 4096
_KNOWN = {"x", "y", "z", "normal_x", "normal_y", "normal_z", "movable"}


def read_pcd(data: bytes) -> dict[str, NDArray[np.generic]]:
    """The columns "points", and "normals", "movable" and "camera" where they are there.

    Raises:
        ValueError: the header is none, or asks for more than there is.
    """
    header, body = _header(data)
    names = header["FIELDS"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(header["SIZE"]) == len(header["TYPE"]) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    if len(set(names) & _KNOWN) != sum(name in _KNOWN for name in names):
        raise ValueError("a field stands twice")
    length = int(header["POINTS"][0])
    # Unknown fields, which may share a name such as "_", are told apart by their places.
    fields = [
        (name if name in _KNOWN else f"_{place}", _scalar(kind, size), (count,))
        for place, (name, kind, size, count) in enumerate(
            zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
        )
    ]
    table = _table(header["DATA"][0], body, np.dtype(fields), length)
    found: dict[str, NDArray[np.generic]] = {"points": _columns(table, ("x", "y", "z"))}
    if {"normal_x", "normal_y", "normal_z"} <= set(names):
        found["normals"] = _columns(table, ("normal_x", "normal_y", "normal_z"))
    if "movable" in names:
        found["movable"] = _columns(table, ("movable",))[:, 0]
    if "VIEWPOINT" in header:
        found["camera"] = np.array([float(value) for value in header["VIEWPOINT"][:3]])
    return found


def _header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The header's entries, and what follows it."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("its header has no end")
        words = data[start:end].decode("ascii").split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
        start = end + 1
    return entries, data[start:]


def _scalar(kind: str, size: str) -> str:
    if kind not in ("F", "I", "U") or size not in ("1", "2", "4", "8"):
        raise ValueError(f"a field of type {kind[:8]} and size {size[:8]}")
    return f"<{kind.lower()}{size}"


def _table(encoding: str, body: bytes, dtype: np.dtype[np.void], length: int) -> NDArray[np.void]:
    """The rows, [length]; never more than the body holds."""
    if encoding == "binary":
        if length * dtype.itemsize > len(body):
            raise ValueError(f"announces {length} points and holds fewer")
        return np.frombuffer(body, dtype=dtype, count=length)
    if encoding != "ascii":
        raise ValueError(f"DATA {encoding[:20]} is not read; write it as binary or ascii")
    width = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns of words among the numbers; then there are too few numbers.
        values = np.fromstring(body.decode("ascii"), dtype=np.float64, sep=" ")
    if values.size != length * width:
        raise ValueError(f"announces {length} points of {width} numbers and holds {values.size} numbers")
    rows = np.zeros(length, dtype=dtype)
    place, table = 0, values.reshape(length, width)
    for name in dtype.names or ():
        count = int(np.prod(dtype[name].shape))
        rows[name] = table[:, place : place + count]
        place += count
    return rows


def _columns(table: NDArray[np.void], names: tuple[str, ...]) -> NDArray[np.float64]:
    """Scalar fields side by side, [length, len(names)]."""
    return np.column_stack([table[name][:, 0].astype(np.float64) for name in names])
