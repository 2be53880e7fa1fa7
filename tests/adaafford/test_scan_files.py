"""Files of clouds: every dialect that cameras and libraries write is read; all else is refused in one line."""

import codecs
import io
import json
import os
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaafford import pcd as pcd_reader
from adaafford.histories import read_history
from adaafford.scans import (
    Scan,
    ScanFrame,
    checked_scan,
    doubtful_up,
    missing_points,
    observation_of,
    parse_scan,
    read_scan,
)
from shared.errors import AdaAffordError, UsageError
from shared.types import Float

XYZ = (("float", "x"), ("float", "y"), ("float", "z"))
NORMAL = (("float", "nx"), ("float", "ny"), ("float", "nz"))
COLOURS = (("uchar", "red"), ("uchar", "green"), ("uchar", "blue"))
STRUCT = {"char": "b", "uchar": "B", "short": "h", "int": "i", "uint": "I", "float": "f", "double": "d"}
STRUCT |= {"int64": "q", "uint64": "Q", "float16": "e"}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")


def front(count: int = 99, seed: int = 1) -> Float:
    """A cabinet's front, 0.9 m ahead of a camera at the origin, z up; exact in a float."""
    points = np.random.default_rng(seed).uniform([0.9, -0.3, -0.4], [0.95, 0.3, 0.4], (count, 3))
    return points.astype(np.float32).astype(np.float64)


# PLY.


def element(
    encoding: str, name: str, columns: tuple[tuple[str, str], ...], rows: list[list[object]]
) -> tuple[str, bytes]:
    """An element's lines in the header and its data; a kind such as "list uchar int" has lists as values."""
    header = f"element {name} {len(rows)}\n" + "".join(f"property {kind} {column}\n" for kind, column in columns)
    order, text, packed = ">" if encoding.endswith("big_endian") else "<", [], b""
    for row in rows:
        words: list[str] = []
        for (kind, _), value in zip(columns, row, strict=True):
            kinds = [STRUCT[each] for each in kind.split() if each != "list"]
            values = [len(value), *value] if isinstance(value, list) else [value]
            kinds = [kinds[0], *kinds[1:] * (len(values) - 1)]
            words += [repr(each) for each in values]
            packed += b"".join(
                struct.pack(order + code, int(each) if code in "bBhiIqQ" else each)
                for code, each in zip(kinds, values, strict=True)
            )
        text.append(" ".join(words) + "\n")
    return header, "".join(text).encode() if encoding == "ascii" else packed


def ply(
    points: Float, encoding: str = "ascii", columns: tuple[tuple[str, str], ...] = XYZ, more: object = None
) -> bytes:
    """A file of vertices with 0, 1, 2 ... in the columns behind the first three; `more` maps elements of its own."""
    rows: list[list[object]] = [
        [*row, *([1] * n if kind.startswith("list") else n for n, (kind, _) in enumerate(columns[3:]))]
        for row in points.tolist()
    ]
    parts = {"vertex": element(encoding, "vertex", columns, rows)}
    if callable(more):
        parts = more(parts)
    header = f"ply\nformat {encoding} 1.0\n" + "".join(part[0] for part in parts.values()) + "end_header\n"
    return header.encode() + b"".join(part[1] for part in parts.values())


def faces_first(encoding: str, lengths: Callable[[int], int]) -> Callable[[dict[str, tuple[str, bytes]]], object]:
    rows: list[list[object]] = [[[1] * lengths(n), 7] for n in range(500)]
    faces = element(encoding, "face", (("list uchar int", "vertex_indices"), ("short", "flags")), rows)
    return lambda parts: {"face": faces, **parts}


@pytest.mark.parametrize("encoding", FORMATS)
@pytest.mark.parametrize(
    "columns",
    [
        XYZ,
        tuple(("double", name) for _, name in XYZ),
        (*XYZ, *COLOURS, ("float", "quality"), ("double", "confidence"), ("int", "label")),
        (*XYZ, ("list uchar int", "of_same_length")),
        (*XYZ, ("int64", "index"), ("uint64", "time"), ("float16", "weight"), ("list uint64 float16", "of_any_type")),
    ],
)
def test_vertices_of_any_columns_and_order_are_read(encoding: str, columns: tuple[tuple[str, str], ...]) -> None:
    scan = parse_scan(ply(front(), encoding, columns), Path("scan.ply"))
    np.testing.assert_array_equal(scan.points, front())
    assert scan.normals is None
    assert scan.movable is None


@pytest.mark.parametrize("encoding", FORMATS)
@pytest.mark.parametrize("lengths", [lambda n: 3, lambda n: 3 + n % 2, lambda n: n % 7, lambda n: 3 + (n > 400)])
def test_lists_before_the_vertices_are_passed_over(encoding: str, lengths: Callable[[int], int]) -> None:
    data = ply(front(), encoding, more=faces_first(encoding, lengths))
    np.testing.assert_array_equal(parse_scan(data, Path("scan.ply")).points, front())
    with pytest.raises(UsageError, match=r"announces 500 rows of element 'face' and holds \d+"):
        parse_scan(data[: data.index(b"end_header") + 600], Path("scan.ply"))


@pytest.mark.parametrize("encoding", FORMATS)
def test_lists_inside_the_vertices_are_passed_over(encoding: str) -> None:
    columns = (("float", "x"), ("list uchar uchar", "seen_from"), ("float", "y"), ("float", "z"))
    rows: list[list[object]] = [[x, [1] * (n % 3), y, z] for n, (x, y, z) in enumerate(front().tolist())]
    header, body = element(encoding, "vertex", columns, rows)
    data = f"ply\nformat {encoding} 1.0\n{header}end_header\n".encode() + body
    np.testing.assert_array_equal(parse_scan(data, Path("scan.ply")).points, front())


@pytest.mark.parametrize("encoding", FORMATS)
def test_faces_behind_the_vertices_are_not_read(encoding: str) -> None:
    header, _ = element(encoding, "face", (("list uchar int", "vertex_indices"),), [[[0, 1, 2]]])
    data = ply(front(), encoding, more=lambda parts: {**parts, "face": (header, b"")})
    np.testing.assert_array_equal(parse_scan(data, Path("scan.ply")).points, front())


@pytest.mark.parametrize("names", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")])
def test_normals_and_labels_of_a_ply_are_read(names: tuple[str, ...]) -> None:
    data = ply(front(), columns=(*XYZ, *(("float", name) for name in names), ("uchar", "movable")))
    scan = parse_scan(data.replace(b" 0 1 2 3\n", b" 0 1 2 1\n"), Path("scan.ply"))
    assert scan.normals is not None
    assert (scan.normals == [0, 1, 2]).all()
    assert scan.movable is not None
    assert scan.movable.all()


DIALECTS = {
    "windows": lambda text: text.replace(b"\n", b"\r\n"),
    "old mac": lambda text: text.replace(b"\n", b"\r"),
    "byte order mark": lambda text: codecs.BOM_UTF8 + text,
    "all on lines of their own": lambda text: (
        text[: text.index(b"end_header\n") + 11] + text[text.index(b"end_header\n") + 11 :].replace(b" ", b" \n\t")
    ),
    "all on one line": lambda text: (
        text[: text.index(b"end_header\n") + 11] + text[text.index(b"end_header\n") + 11 :].replace(b"\n", b" ")
    ),
    "upper-case keywords": lambda text: (
        text.replace(b"ply", b"PLY", 1)
        .replace(b"format ascii", b"FORMAT ASCII")
        .replace(b"element vertex", b"ELEMENT VERTEX")
        .replace(b"property float", b"PROPERTY FLOAT")
    ),
    "sized types": lambda text: text.replace(b"property float ", b"property float32 "),
    "blank lines": lambda text: text.replace(b"\nproperty", b"\n\n  \nproperty").replace(
        b"end_header\n", b"end_header\n\n"
    ),
    "comments": lambda text: text.replace(b"\nproperty", b"\ncomment Gr\xfc\xdfe \xff\nobj_info num_cols 3\nproperty"),
    "words after the numbers": lambda text: text + b"end of file\n",
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_dialect_of_text_is_read(dialect: str) -> None:
    data = DIALECTS[dialect](ply(front(), columns=(*XYZ, *COLOURS)))
    np.testing.assert_array_equal(parse_scan(data, Path("scan.ply")).points, front())


def test_a_binary_body_that_begins_like_a_line_end_is_not_cut() -> None:
    points = front()
    points[0, 0] = struct.unpack("<f", b"\x0a\x0d\x6f\x3f")[0]
    whole = ply(points, "binary_little_endian")
    header, body = whole.split(b"end_header\n", 1)
    for ending in (b"\n", b"\r\n", b"\r"):
        data = (header + b"end_header\n").replace(b"\n", ending) + body
        np.testing.assert_array_equal(parse_scan(data, Path("scan.ply")).points, points)


@pytest.mark.parametrize(
    "word", [b"nan", b"-nan(ind)", b"NaN", b"inf", b"-Infinity", b"1.#QNAN", b"-1.#IND00", b"1.#INF"]
)
def test_any_way_to_write_a_missing_number_is_understood(word: bytes) -> None:
    header, body = ply(front()).split(b"end_header\n", 1)
    rows = body.splitlines(keepends=True)
    rows[7] = b" ".join([word] * 3) + b"\n"
    scan = parse_scan(header + b"end_header\n" + b"".join(rows), Path("scan.ply"))
    assert scan.missing == 1
    np.testing.assert_array_equal(scan.points, np.delete(front(), 7, axis=0))


# PCD.


def pcd(points: Float, encoding: str = "ascii", padding: bool = True, kind: str = "F4") -> bytes:
    """A file with padding, as the Point Cloud Library writes it."""
    names = ["x", "y", "z", *(["_"] if padding else []), "rgb"]
    kinds = [*[kind] * 3, *(["U1"] if padding else []), "U4"]
    counts = [1, 1, 1, *([3] if padding else []), 1]
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(each[1] for each in kinds)}\n"
        f"TYPE {' '.join(each[0] for each in kinds)}\nCOUNT {' '.join(map(str, counts))}\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0.5 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    rest = [*([0] * 3 if padding else []), 255]
    if encoding == "ascii":
        return header + b"".join(" ".join(map(repr, [*row, *rest])).encode() + b"\n" for row in points.tolist())
    dtype = np.dtype(
        [(str(n), f"<{k.lower()}", (count,)) for n, (k, count) in enumerate(zip(kinds, counts, strict=True))]
    )
    table = np.zeros(len(points), dtype=dtype)
    for axis in range(3):
        table[str(axis)][:, 0] = points[:, axis]
    if encoding == "binary":
        return header + table.tobytes()
    columns = b"".join(table[str(n)].tobytes() for n, name in enumerate(names) if name != "_")
    packed = lzf(columns)
    return header + struct.pack("<II", len(packed), len(columns)) + packed


def lzf(data: bytes) -> bytes:
    """Packed as LibLZF does it: what stood at most 8192 bytes before is named, not repeated."""
    out, literal, seen, place = bytearray(), bytearray(), dict[bytes, int](), 0

    def flush() -> None:
        for start in range(0, len(literal), 32):
            part = literal[start : start + 32]
            out.extend([len(part) - 1, *part])
        literal.clear()

    while place < len(data):
        key = data[place : place + 3]
        before, seen[key] = seen.get(key, -1), place
        if len(key) < 3 or before < 0 or place - before > 8192:
            literal.append(data[place])
            place += 1
            continue
        flush()
        length, back = 3, place - before - 1
        while length < 264 and place + length < len(data) and data[before + length] == data[place + length]:
            length += 1
        if length < 9:
            out.extend([(length - 2) << 5 | back >> 8, back & 255])
        else:
            out.extend([7 << 5 | back >> 8, length - 9, back & 255])
        place += length
    flush()
    return bytes(out)


@given(st.lists(st.sampled_from([b"abc", b"\0" * 50, b"abcd" * 90, b"x", bytes(range(40))]), max_size=40).map(b"".join))
def test_lzf_comes_back(data: bytes) -> None:
    packed = lzf(data)
    for wanted in {0, len(data) // 2, len(data)}:
        assert pcd_reader._unpacked(b"head" + packed + b"tail", 4, 4 + len(packed), wanted)[:wanted] == data[:wanted]


@pytest.mark.parametrize("kind", ["F4", "F8"])
@pytest.mark.parametrize("padding", [False, True])
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_of_pcd_is_read(encoding: str, padding: bool, kind: str) -> None:
    scan = parse_scan(pcd(front(), encoding, padding, kind), Path("scan.pcd"))
    np.testing.assert_array_equal(scan.points, front())
    assert scan.camera == (0.5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"FIELDS", b"COLUMNS"),
        (b"POINTS 99\n", b""),
        (b"WIDTH 99\nHEIGHT 1\n", b""),
        (b"WIDTH 99\nHEIGHT 1\n", b"WIDTH 33\nHEIGHT 3\n"),
        (b"POINTS 99\n", b"POINTS 99\n\n# gr\xc3\xbc\xc3\x9fe\n"),
        (b"# .PCD v0.7\n", codecs.BOM_UTF8 + b"# \xff\n"),
        (b"COUNT 1 1 1 1\n", b""),
        (b"TYPE F F F U\n", b"TYPE f f f u\n"),
    ],
)
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_dialect_of_a_pcd_header_is_read(old: bytes, new: bytes, encoding: str) -> None:
    whole = pcd(front(), encoding, padding=False)
    assert old in whole
    np.testing.assert_array_equal(parse_scan(whole.replace(old, new, 1), Path("scan.pcd")).points, front())


# NPZ.


def packed(**held: object) -> bytes:
    data = io.BytesIO()
    np.savez_compressed(data, **held)  # type: ignore[arg-type]
    return data.getvalue()


def npz_of(header: str, body: bytes = b"", packing: int = zipfile.ZIP_DEFLATED, name: str = "points.npy") -> bytes:
    """An archive of one array with this header."""
    text = header.encode()
    text += b" " * (63 - (len(text) + 10) % 64) + b"\n"
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", packing) as archive, archive.open(name, "w") as entry:
        entry.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)
        for start in range(0, len(body), 1 << 20):
            entry.write(body[start : start + (1 << 20)])
    return data.getvalue()


def shape_of(shape: str, kind: str = "'<f8'") -> str:
    return f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}"


@pytest.mark.parametrize("dtype", ["f2", "f4", ">f4", "f8", "longdouble"])
def test_arrays_of_any_float_and_order_are_read(dtype: str) -> None:
    points = np.asfortranarray(front().astype(dtype))
    scan = parse_scan(packed(points=points, image=np.zeros((4, 4, 3))), Path("scan.npz"))
    np.testing.assert_array_equal(scan.points, points.astype(np.float64))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, np.float32, np.float16])
def test_marks_of_any_type_are_read_and_labels_are_refused(dtype: type) -> None:
    marks = (np.arange(99) % 2).astype(dtype)
    scan = parse_scan(packed(points=front(), movable=marks), Path("scan.npz"))
    assert scan.movable is not None
    assert (scan.movable == (np.arange(99) % 2 == 1)).all()
    if dtype is not bool:
        wrong = marks.copy()
        wrong[5] = 3
        with pytest.raises(UsageError, match="movable holds 3; allowed are 0, 1, false and true"):
            checked_scan(front(), movable=wrong)


@pytest.mark.parametrize("wrong", [-1.0, 255.0, 0.5, np.nan, np.inf])
def test_a_mark_that_is_none_is_refused(wrong: float) -> None:
    marks = np.ones(99)
    marks[3] = wrong
    with pytest.raises(UsageError, match=f"movable holds {wrong:g}"):
        checked_scan(front(), movable=marks)
    points = front()
    points[3] = 0  # What was not measured needs no mark.
    assert checked_scan(points, movable=marks).missing == 1


# What was not measured.


@pytest.mark.parametrize("missing", [(0.0, 0.0, 0.0), (np.nan, 0.5, 0.5), (np.inf, 0.0, 0.0), (1e300, 0.0, 0.0)])
def test_points_that_were_not_measured_are_left_out_and_counted(missing: tuple[float, float, float]) -> None:
    points = front(400)
    points[::2] = missing
    scan = checked_scan(points, np.tile([1.0, 0, 0], (400, 1)), np.arange(400) % 4 == 1)
    np.testing.assert_array_equal(scan.points, points[1::2])
    assert (scan.missing, scan.rows is not None and scan.rows.tolist()) == (200, list(range(1, 400, 2)))
    assert scan.movable is not None
    assert scan.movable.sum() == 100
    assert missing_points(scan) == "200 of 400 points were not measured (0 0 0 or not finite) and are left out"
    pixels = observation_of(scan, ScanFrame.around(scan), points=64).pixels
    assert (pixels % 2 == 1).all(), "pixels name places in the file"
    assert missing_points(checked_scan(np.concatenate([front(400), np.zeros((10, 3))]))) is None


def test_an_observation_without_points_is_refused() -> None:
    scan = checked_scan(front(400))
    with pytest.raises(UsageError, match="points=0"):
        observation_of(scan, ScanFrame.around(scan), points=0)


@pytest.mark.parametrize("missing", [0.0, np.nan, np.inf, 1e300])
def test_a_normal_that_is_missing_is_estimated_and_its_point_stays(missing: float) -> None:
    points = front(400)
    points[:, 0] = 0.9
    normals = np.tile([-0.6, 0.0, 0.8], (400, 1))
    normals[:200] = missing
    scan = checked_scan(points, normals)
    assert len(scan.points) == 400
    frame = ScanFrame.around(scan)
    observation = observation_of(scan, frame, points=400)
    facing = observation.normals @ frame.world_from_scan
    given = observation.pixels >= 200
    np.testing.assert_allclose(facing[given], np.tile([-0.6, 0, 0.8], (given.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(facing[~given], np.tile([-1, 0, 0], ((~given).sum(), 1)), atol=0.01)
    assert checked_scan(points, np.full((400, 3), missing)).normals is None


# What is up.


def optical(points: Float) -> Float:
    """In a camera's frame: x right, y down, z forward."""
    return np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1)


def opengl(points: Float) -> Float:
    """In a camera's frame of computer graphics: x right, y up, z backward."""
    return optical(points) * [1, -1, -1]


@pytest.mark.parametrize(
    ("points", "up", "camera", "probable"),
    [
        (front(), (0.0, 0.0, 1.0), None, None),
        (front() + np.array([2.0, 0.0, 1.0]), (0.0, 0.0, 1.0), (0.5, 0.0, 1.5), None),
        (front() + np.array([-0.5, 0.0, 0.6]), (0.0, 0.0, 1.0), (2.0, 0.0, 1.5), None),
        (front() - np.array([0.3, 0.0, 0.3]), (0.0, 0.0, 1.0), None, None),
        (optical(front()), (0.0, 0.0, 1.0), None, "0 -1 0"),
        (optical(front()) + np.array([0.4, 0.2, 0.0]), (0.0, 0.0, 1.0), None, "0 -1 0"),
        (optical(front()) + np.array([0.4, 0.3, -0.3]), (0.0, 0.0, 1.0), None, "0 -1 0"),
        (optical(front()), (0.0, -1.0, 0.0), None, None),
        (opengl(front()), (0.0, 0.0, 1.0), None, "0 1 0"),
        (opengl(front()) - np.array([0.0, 0.4, 0.3]), (0.0, 0.0, 1.0), None, "0 1 0"),
        (opengl(front()) + np.array([0.4, 0.3, 0.3]), (0.0, 0.0, 1.0), None, "0 1 0"),
        (opengl(front()), (0.0, 1.0, 0.0), None, None),
        (front(), (0.0, 0.0, 1.0), (0.92, 0.0, 3.0), "0 1 0"),
        (front(), (0.0, 0.0, 1.0), (0.92, 0.0, -3.0), "0 -1 0"),
    ],
)
def test_a_frame_whose_camera_stands_below_or_above_the_object_is_doubtful(
    points: Float, up: tuple[float, float, float], camera: tuple[float, float, float] | None, probable: str | None
) -> None:
    scan = checked_scan(points)
    line = doubtful_up(scan, ScanFrame.around(scan, up, camera))
    assert line is None if probable is None else line is not None and line.endswith(f"up is probably {probable}")


# What is refused.


def announcing(count: object, encoding: str = "binary_little_endian") -> bytes:
    return ply(front(), encoding).replace(b"vertex 99", f"vertex {count}".encode())


FACES = b"element face 9\nproperty list uchar int v\n"
HOSTILE: dict[str, tuple[bytes, str]] = {
    # Text and binary that broke off.
    "cut.ply": (ply(front(), "binary_little_endian")[:-8], "announces 99 vertices and holds 98"),
    "cut-big.ply": (ply(front(), "binary_big_endian")[:-80], "announces 99 vertices and holds 92"),
    "cut-text.ply": (b"\n".join(ply(front()).split(b"\n")[:-41]) + b"\n", "announces 99 vertices and holds 59"),
    "longer.ply": (ply(front()) + b"1 2 3\n", "announces 99 vertices and holds more numbers"),
    "columns.ply": (ply(front(), columns=(*XYZ, *COLOURS)).replace(b"property uchar red\n", b""), "holds more numbers"),
    "huge.ply": (announcing(999999999999), "announces 999999999999 vertices and holds 99"),
    "huge-text.ply": (announcing(999999999999, "ascii"), "announces 999999999999 vertices and holds 99"),
    "negative.ply": (announcing(-1), "the count of element 'vertex' is '-1', which is no count"),
    "float.ply": (announcing("9e9"), "which is no count"),
    "hollow.ply": (announcing(0), "holds no vertices"),
    "words.ply": (ply(front()).replace(b"0.9", b"zero"), "holds 0 before 'zero"),
    "underscore.ply": (ply(front()).replace(b"0.9", b"0.9_"), "holds 0 before '0.9_"),
    "comma.ply": (ply(front()).replace(b"0.9", b"0,9"), "which is no number"),
    # Headers.
    "nothing.ply": (b"", "nothing.ply: is empty; export it again"),
    "nothing.pcd": (b"", "nothing.pcd: is empty; export it again"),
    "nothing.npz": (b"", "nothing.npz: is empty; export it again"),
    "cut-header.ply": (ply(front())[:60], "is cut off: its 60 bytes end before its header does"),
    "cut-header.pcd": (pcd(front())[:60], "is cut off: its 60 bytes end before its header does"),
    "other.ply": (b"solid stl\nfacet\n", "does not begin with the line 'ply'"),
    "utf16.ply": (ply(front()).decode().encode("utf-16"), "is text in UTF-16; save it in UTF-8"),
    "endless.ply": (b"ply\nformat ascii 1.0\nelement vertex 5\n" + b"comment\n" * 200_000, "does not end within"),
    "no-format.ply": (ply(front()).replace(b"format ascii 1.0\n", b""), "has no line 'format'"),
    "format.ply": (ply(front()).replace(b"ascii", b"asci\xcc"), "its format is 'asci\u00cc'; known: ascii"),
    "faces.ply": (ply(front()).replace(b"element vertex", b"element point"), "no element 'vertex' among point"),
    "bool.ply": (ply(front()).replace(b"float x", b"bool x"), "its property 'x' has the type 'bool'; known: char"),
    "capitals.ply": (ply(front()).replace(b"t x", b"t X").replace(b"t y", b"t Y"), "has no x y z among X Y z"),
    "list.ply": (ply(front(), "ascii").replace(b"float x", b"list uchar float x"), "vertices"),
    "twice.ply": (ply(front(), columns=(*XYZ, ("float", "y"))), "has the column y twice"),
    "vertices.ply": (ply(front()).replace(b"end_", b"element vertex 2\nend_"), "has the element 'vertex' twice"),
    "elements.ply": (
        ply(front()).replace(b"end_", b"".join(b"element e%d 0\n" % n for n in range(99)) + b"end_"),
        "line",
    ),
    "properties.ply": (ply(front()).replace(b"end_", b"property char a\n" * 9999 + b"end_"), "its header has the line"),
    "lists.ply": (b"ply\nformat ascii 1.0\n" + FACES + b"element vertex 9\nend_header\n-1\n", "a list of -1 values"),
    "nan-list.ply": (b"ply\nformat ascii 1.0\n" + FACES + b"element vertex 9\nend_header\nnan\n", "a list of nan"),
    "long-list.ply": (b"ply\nformat ascii 1.0\n" + FACES + b"element vertex 9\nend_header\n1e9\n", "a list of 1e+09"),
    "escape.ply": (ply(front()).replace(b"property float x", b"\x1b[31mx"), r"its header has the line '\x1b[31mx'"),
    # PCD.
    "header.pcd": (b"FIELDS x y z\n" * 2000, "is cut off: its 26000 bytes"),
    "endless.pcd": (b"FIELDS x y z\n" * 90_000, "does not end within 1048576 bytes"),
    "huge.pcd": (pcd(front(), "binary").replace(b"POINTS 99", b"POINTS 99999999999"), "but WIDTH times HEIGHT is 99"),
    "huge-2.pcd": (
        pcd(front(), "binary").replace(b" 99\n", b" 99999999999\n"),
        "announces 99999999999 points and holds",
    ),
    "huge-3.pcd": (
        pcd(front(), "binary_compressed").replace(b" 99\n", b" 99999999999\n"),
        "bytes of 99999999999 points",
    ),
    "cut.pcd": (pcd(front(), "binary")[:-1], "announces 99 points and holds 98"),
    "cut-text.pcd": (pcd(front())[:-60], "announces 99 points and holds 9"),
    "longer.pcd": (pcd(front()) + b"7\n", "holds more numbers"),
    "cut-packed.pcd": (pcd(front(), "binary_compressed")[:-1], "compressed bytes and holds"),
    "no-packed.pcd": (pcd(front()).split(b"ascii\n")[0] + b"binary_compressed\n", "ends before its compressed data"),
    "other-size.pcd": (pcd(front(), "binary_compressed").replace(b" 99\n", b" 98\n"), "bytes of 98 points, which take"),
    "words.pcd": (pcd(front()).replace(b"0.9", b"zero"), "which is no number"),
    "missing.pcd": (pcd(front()).replace(b"FIELDS x y z", b"FIELDS x y w"), "has no x y z among x y w _ rgb"),
    "fields.pcd": (pcd(front()).replace(b"FIELDS", b"#"), "its header has no FIELDS; it has VERSION SIZE"),
    "points.pcd": (pcd(front()).replace(b"POINTS", b"#").replace(b"WIDTH", b"#"), "neither POINTS nor WIDTH"),
    "none.pcd": (pcd(front()).replace(b" 99\n", b" 0\n"), "holds no points"),
    "twice.pcd": (pcd(front()).replace(b"FIELDS x y z _", b"FIELDS x y z z").replace(b"1 1 1 3", b"1 1 1 1"), "twice"),
    "type.pcd": (pcd(front()).replace(b"TYPE F F F", b"TYPE O F F"), "its field 'x' is of TYPE 'O' and SIZE '4'"),
    "count.pcd": (pcd(front()).replace(b"COUNT 1", b"COUNT 2"), "its field 'x' has 2 values a point"),
    "zero.pcd": (pcd(front()).replace(b"COUNT 1", b"COUNT 0"), "its field 'x' has 0 values a point"),
    "lengths.pcd": (pcd(front()).replace(b"COUNT 1", b"COUNT 1 1"), "differ in length"),
    "data.pcd": (pcd(front()).replace(b"DATA ascii", b"DATA zstd"), "its DATA is 'zstd'; known: ascii binary"),
    "underscore.pcd": (pcd(front()).replace(b"0.9", b"0.9_"), "holds 0 before '0.9_"),
    "viewpoint-underscore.pcd": (pcd(front()).replace(b"POINT 0.5", b"POINT 0_5"), "its VIEWPOINT is '0_5 0 0"),
    "viewpoint.pcd": (pcd(front()).replace(b"POINT 0.5", b"POINT here"), "its VIEWPOINT is 'here 0 0 1 0 0 0'"),
    "keyword.pcd": (pcd(front()).replace(b"VERSION", b"VERSIO"), "its header has the line 'VERSIO 0.7'"),
    # NPZ.
    "pickle.npz": (packed(points=np.array([{"a": print}] * 99, dtype=object)), "holds object, not numbers"),
    "keys.npz": (packed(xyz=front(), rgb=front()), "has no array 'points'; it holds xyz rgb"),
    "empty.npz": (packed(), "it holds nothing"),
    "words.npz": (packed(points=np.array([["a", "b", "c"]] * 99)), "holds <U1, not numbers"),
    "complex.npz": (packed(points=front().astype(complex)), "holds complex128, not numbers"),
    "times.npz": (packed(points=front().astype("m8[s]")), "not numbers"),
    "flat.npz": (packed(points=np.zeros((99, 2))), "needs points of shape [M, 3]; given (99, 2)"),
    "six.npz": (packed(points=np.ones((99, 6))), "needs points of shape [M, 3]; given (99, 6)"),
    "image.npz": (packed(points=np.ones((9, 11, 3))), "given (9, 11, 3)"),
    "scalar.npz": (packed(points=np.float64(3)), "given ()"),
    "few.npz": (packed(points=front(10)), "needs 64 to 2073600 finite points other than 0 0 0; given 10 of 10"),
    "nan.npz": (packed(points=np.full((99, 3), np.nan)), "given 0 of 99"),
    "zeros.npz": (packed(points=np.zeros((99, 3))), "given 0 of 99"),
    "point.npz": (packed(points=np.ones((99, 3))), "measures 0"),
    "millimetres.npz": (packed(points=1000 * front()), "in metres"),
    "lowest.npz": (packed(points=np.full((99, 3), np.iinfo(np.int64).min)), "given 0 of 99"),
    "normals.npz": (packed(points=front(), normals=np.zeros((98, 3))), "needs normals of shape (99, 3)"),
    "mask.npz": (packed(points=front(), movable=np.ones((9, 11))), "needs movable of shape (99,)"),
    "camera.npz": (packed(points=front(), camera=np.array([np.nan, 0, 0])), "needs a camera of three numbers"),
    "zip.npz": (b"PK\x03\x04 cut off", "not readable as NPZ"),
    "array.npz": (b"\x93NUMPY\x01\x00", "not readable as NPZ"),
    "bomb.npz": (npz_of(shape_of("(6000000, 3)"), bytes(144 << 20)), "unpacks to more than"),
    "lying.npz": (npz_of(shape_of("(5000000000, 3)")), "announces the shape (5000000000, 3) and holds less"),
    "overflow.npz": (npz_of(shape_of("(4294967296, 4294967296, 3)"), bytes(240)), "and holds less"),
    "negative.npz": (npz_of(shape_of("(-9, -3)"), bytes(216)), "and holds less"),
    "longer.npz": (npz_of(shape_of("(9, 3)"), bytes(217)), "of shape (9, 3) takes 217 bytes"),
    "hollow.npz": (npz_of(shape_of("(5000000000, 3)", "'|V0'")), "holds |V0, not numbers"),
    "hollow-text.npz": (npz_of(shape_of("(5000000000, 3)", "'|S0'")), "holds |S0, not numbers"),
    "nested.npz": (npz_of(shape_of("(9, 3)", "('<f8', (1000000,))")), "not numbers"),
    "deep.npz": (npz_of("(" * 9000), "not readable as NPZ"),
    "method.npz": (npz_of(shape_of("(9, 3)"), bytes(216), zipfile.ZIP_LZMA), "is packed otherwise than NumPy does"),
    "many.npz": (b"PK\1\2" + b"PK\1\2" * 5000 + b"PK\5\6" + bytes(18), "holds more than 4096 arrays"),
    "cloud.xyz": (b"0 0 0\n", "allowed: .ply, .npz, .pcd"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_cloud_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    data, expected = HOSTILE[name]
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(AdaAffordError) as refused:
            read_scan(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 32 << 20, "a small file takes little memory whatever it announces"
    finally:
        tracemalloc.stop()
    assert name in str(refused.value)
    assert expected in str(refused.value)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_text_of_too_many_numbers_is_refused_unread(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adaafford.columns.MAX_NUMBERS", 200)
    data = {"ply": ply(front()), "pcd": pcd(front(), padding=False)}[kind]
    monkeypatch.setattr("adaafford.columns._number", None)
    with pytest.raises(
        UsageError, match="announces more than the 200 numbers that are read as text; write it as binary"
    ):
        parse_scan(data, Path(f"scan.{kind}"))


def test_packed_data_that_take_too_long_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adaafford.pcd._MAX_STEPS", 10)
    with pytest.raises(UsageError, match="takes too long to unpack; write it as binary"):
        parse_scan(pcd(front(), "binary_compressed"), Path("scan.pcd"))


def test_lists_that_always_differ_are_refused_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adaafford.ply._MAX_LAYOUTS", 100)
    data = ply(front(), more=faces_first("ascii", lambda n: n % 2))
    with pytest.raises(UsageError, match="differ too often in length; save it as points alone"):
        parse_scan(data, Path("scan.ply"))


@pytest.mark.parametrize("name", ["scan.ply", "history.json"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_file_is_refused_at_once(name: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / name)
    with pytest.raises(UsageError, match="a folder, pipe or device, and no file; name a"):
        (read_scan if name == "scan.ply" else read_history)(tmp_path / name)


# Histories.


HISTORY = json.dumps(
    {
        "format": "adaafford-history", "schema_version": 1,
        "frame": {"up": [0, 0, 1], "camera": [0, 0, 0], "origin": [0.92, 0, 0]},
        "interactions": [
            {"cloud": "scan-1.ply", "point": [0.9, 0.2, 0.1], "approach": [1, 0, 0], "forward": [0, 0, 1],
             "outcome": {"motion": 0.21, "success": True, "kind": "ok"}},
            {"cloud": "scan-2.ply", "point": [0.9, 0.2, 0.1], "approach": [1, 0, 0], "forward": [0, 0, 1]},
        ],
    }, indent=1,
)  # fmt: skip


def test_a_history_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    (tmp_path / "history.json").write_text(HISTORY, encoding="utf-8-sig")
    assert len(read_history(tmp_path / "history.json").interactions) == 2


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (HISTORY.encode("utf-16"), "is text in UTF-16; save it in UTF-8"),
        (b"\xff\xfe", "UTF-16"),
        (HISTORY.encode().replace(b'"motion"', b'"motion": 0.1, "motion"'), "the name 'motion' occurs twice"),
        (HISTORY.encode().replace(b'"frame"', b'"frame": {"origin": [0, 0, 0]}, "frame"'), "'frame' occurs twice"),
        (HISTORY.encode().replace(b"0.21", b"NaN"), "interactions.0.outcome.motion"),
        (HISTORY.encode().replace(b"0.21", b"1e999"), "interactions.0.outcome.motion"),
        (HISTORY.encode().replace(b"0.21", b"1" * 5000), "number out of range"),
        (HISTORY.encode().replace(b"0.21", b'0.2, "grasp_width": 20'), "interactions.0.outcome.grasp_width"),
        (HISTORY.encode().replace(b"0.21", b'0.2, "grasp_width": -0.01'), "interactions.0.outcome.grasp_width"),
        (HISTORY.encode().replace(b'"ok"', b'"slipped"'), "interactions.0.outcome.kind"),
        (HISTORY.encode().replace(b"0.21", b'{"a":' * 5000), "Invalid JSON"),
        (HISTORY.encode().replace(b"scan-1", b"a\\u001b[31m\\n"), "needs a name without control characters"),
        (HISTORY.encode().replace(b'"up"', b'"u\\n\\u001bp"'), r"frame.u\n\x1bp: Extra inputs"),
        (HISTORY.encode().replace(b"scan-1", b"\xff"), "Invalid JSON"),
    ],
)
def test_a_history_with_something_wrong_is_refused_in_one_line(data: bytes, expected: str, tmp_path: Path) -> None:
    (tmp_path / "history.json").write_bytes(data)
    with pytest.raises(AdaAffordError) as refused:
        read_history(tmp_path / "history.json")
    assert expected in str(refused.value)
    assert str(refused.value).isprintable()


# Mutants.


WHOLE: dict[str, list[bytes]] = {
    "ply": [
        ply(front(70), "ascii", (*XYZ, *NORMAL, ("uchar", "movable"))),
        ply(front(70), "binary_big_endian", (*XYZ, *COLOURS)),
        ply(front(70), "binary_little_endian", more=faces_first("binary_little_endian", lambda n: 3 + n % 2)),
        ply(front(70), "ascii", more=faces_first("ascii", lambda n: n % 3)),
    ],
    "pcd": [pcd(front(70), encoding) for encoding in ("ascii", "binary", "binary_compressed")],
    "npz": [
        packed(points=front(70), movable=np.ones(70, bool), normals=front(70), camera=np.ones(3)),
        npz_of(shape_of("(70, 3)"), front(70).tobytes(), zipfile.ZIP_STORED),
    ],
    "json": [HISTORY.encode()],
}
WORDS = (
    b"0",
    b"-1",
    b"99999999999999999",
    b"1e9",
    b"nan",
    b"",
    b"\n",
    b"\r",
    b"\0",
    b"\xff" * 8,
    b"list",
    b"[",
    b'"',
    b"\xef\xbb\xbf",
)


def mutant(whole: bytes, rng: np.random.Generator) -> bytes:
    """The file after one to four accidents, half of which hit its first 300 bytes or its last."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 5)):
        reach = min(len(data), 300)
        place = int(rng.integers(len(data) + 1) if rng.random() < 0.5 else rng.integers(reach + 1))
        if rng.random() < 0.2:
            place = len(data) - place
        length = int(rng.integers(1, 40))
        match rng.integers(6):
            case 0:
                data[place : place + 1] = bytes([rng.integers(256)])
            case 1:
                data[place : place + length] = b""
            case 2:
                data[place:place] = data[place : place + length]
            case 3:
                data[place : place + int(rng.integers(3))] = WORDS[rng.integers(len(WORDS))]
            case 4:
                data = data[:place] if rng.random() < 0.3 else data + data[place:]
            case _:
                start = int(rng.integers(len(data) + 1))
                data[place : place + length] = data[start : start + length]
    return bytes(data)


def try_mutants(count: int, seed: int, tmp_path: Path) -> int:
    """How many of so many mutants are read; all others must be refused in one line."""
    rng, read = np.random.default_rng(seed), 0
    kinds = [(kind, whole) for kind, files in WHOLE.items() for whole in files]
    for number in range(count):
        kind, whole = kinds[number % len(kinds)]
        data = mutant(whole, rng)
        try:
            if kind == "json":
                (tmp_path / "history.json").write_bytes(data)
                read_history(tmp_path / "history.json")
            else:
                look_at(parse_scan(data, Path(f"scan.{kind}")))
            read += 1
        except AdaAffordError as refused:
            assert str(refused).isprintable(), data
    return read


def look_at(scan: Scan) -> None:
    """What holds of every scan."""
    assert np.isfinite(scan.points).all()
    assert scan.points.shape == (len(scan.points), 3)
    assert scan.points.any(axis=1).all()
    observation = observation_of(scan, ScanFrame.around(scan), points=64)
    np.testing.assert_allclose(np.linalg.norm(observation.normals, axis=1), 1, atol=0.02)


def test_mutants_are_read_or_refused(tmp_path: Path) -> None:
    assert 0 < try_mutants(400, 1, tmp_path) < 400


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_many_mutants_are_read_or_refused(seed: int, tmp_path: Path) -> None:
    assert 0 < try_mutants(1000, 100 + seed, tmp_path) < 1000


@settings(max_examples=60)
@given(kind=st.sampled_from(["ply", "pcd", "npz"]), place=st.integers(0, 400), byte=st.integers(0, 255))
def test_a_flipped_byte_is_read_or_refused(kind: str, place: int, byte: int) -> None:
    whole = bytearray(WHOLE[kind][0])
    whole[place] = byte
    try:
        look_at(parse_scan(bytes(whole), Path(f"flipped.{kind}")))
    except AdaAffordError as refused:
        assert str(refused).isprintable()
