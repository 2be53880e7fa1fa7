"""Triangle meshes: strict parsers of Wavefront OBJ and STL, and the primitive shapes that a URDF may name.

Only vertex positions and faces are read; materials, normals and texture coordinates are skipped. Files are parsed in
blocks of lines, each as one array of bytes, so that memory does not grow with the number of lines.
"""

import re
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from collector.objects.articulation import Mesh
from shared.errors import ObjectError
from shared.types import Float

MAX_OBJ_BYTES = 64 << 20
MAX_VERTICES = 2_000_000
MAX_TRIANGLES = 4_000_000
MAX_COORDINATE = 1e6

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# The first two bytes of every statement that a polygonal OBJ file may hold; those that carry no geometry are skipped.
_VERTEX, _FACE = b"v ", b"f "
_SKIPPED = (b"vn", b"vt", b"vp", b"o ", b"g ", b"s ", b"us", b"mt", b"l ", b"p ", b"o\n", b"g\n", b"s\n")
_SPACE, _LINE_END, _SLASH, _COMMENT = b" \n/#"
_MAY_BE_SKIPPED = np.zeros(1 << 16, dtype=np.bool_)
"""Of two bytes at the beginning of a line: whether it is a comment, empty, or a statement that carries no geometry."""
_MAY_BE_SKIPPED[[int.from_bytes(prefix, "big") for prefix in _SKIPPED]] = True
_MAY_BE_SKIPPED.reshape(256, 256)[[_COMMENT, _LINE_END]] = True
_BLANKS = b"\t\r\v\f"
_STL_HEADER, _STL_TRIANGLE = 84, 50
_STL_VERTEX = b"vertex "
_BLOCK_BYTES = 2 << 20
_BLOCK_TRIANGLES = 1 << 16
_FIRST_TRIANGLES = 16
_MIN_SINE = 1e-9
"""Of the angle at a triangle's first corner; a triangle with a smaller one is a line or a point."""


class MeshSizeError(ObjectError):
    """A mesh file is beyond a bound, so that its object is refused rather than used without it."""


def parse_mesh(data: bytes, name: str) -> Mesh:
    """The triangles of a mesh file, by the ending of its name: Wavefront OBJ or STL.

    Args:
        data: the whole file.
        name: what messages call it.

    Raises:
        MeshSizeError: the file is beyond a bound.
        ObjectError: it is truncated, malformed, not finite, or holds no face that has an area.
    """
    if len(data) > MAX_OBJ_BYTES:
        raise MeshSizeError(f"{name}: {len(data)} bytes; at most {MAX_OBJ_BYTES} are allowed")
    return checked(parse_stl(data, name) if name.lower().endswith(".stl") else parse_obj(data, name), name)


def checked(mesh: Mesh, name: str) -> Mesh:
    """`mesh`, whose faces name its vertices, if it is small enough, finite, and has an area.

    Raises:
        MeshSizeError: it is beyond a bound.
        ObjectError: it is not finite, or no face has an area.
    """
    if len(mesh.vertices) > MAX_VERTICES or len(mesh.faces) > MAX_TRIANGLES:
        raise MeshSizeError(f"{name}: more than {MAX_VERTICES} vertices or {MAX_TRIANGLES} triangles")
    _bounded(mesh.vertices, name)
    if not _has_area(mesh):
        raise ObjectError(f"{name}: no triangle has an area: each is a line or a point")
    return mesh


def _has_area(mesh: Mesh) -> bool:
    """Whether a triangle is more than a line or a point."""
    # Nearly always the first triangles have an area.
    starts = [0, *range(_FIRST_TRIANGLES, len(mesh.faces), _BLOCK_TRIANGLES)]
    for start, stop in zip(starts, [*starts[1:], len(mesh.faces)], strict=True):
        first, second, third = mesh.vertices[mesh.faces[start:stop]].swapaxes(0, 1)
        a, b = second - first, third - first
        lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        if (np.linalg.norm(np.cross(a, b), axis=1) > _MIN_SINE * lengths).any():
            return True
    return False


def parse_obj(data: bytes, name: str) -> Mesh:
    """The triangles of a Wavefront OBJ file; polygons become fans, negative indices count from the end.

    Args:
        data: the whole file.
        name: what messages call it.

    Raises:
        MeshSizeError: the file is beyond a bound.
        ObjectError: it is truncated, malformed, not finite, or holds no face.
    """
    vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int32)]
    above, triangles = 0, 0
    for lines in _blocks(data, name):
        is_vertex, is_face = lines.starts_with(_VERTEX), lines.starts_with(_FACE)
        lines.refuse_others(is_vertex | is_face, name)
        if is_face.any():
            # A negative index counts back from the vertices that stand above its face.
            faces.append(_faces(lines.of(is_face), above + np.cumsum(is_vertex)[is_face], name))
            triangles += len(faces[-1])
        if is_vertex.any():
            vertices.append(_vertices(lines.of(is_vertex), above, name))
            above += len(vertices[-1])
        if above > MAX_VERTICES or triangles > MAX_TRIANGLES:
            raise MeshSizeError(f"{name}: more than {MAX_VERTICES} vertices or {MAX_TRIANGLES} triangles")
    mesh = Mesh(np.concatenate(vertices), np.concatenate(faces))
    if not triangles:
        raise ObjectError(f"{name}: no faces; the file is empty or truncated")
    if mesh.faces.min() < 0 or mesh.faces.max() >= above:
        raise ObjectError(f"{name}: a face names a vertex that is not among the {above} there are; truncated?")
    return mesh


def _blocks(data: bytes, name: str) -> Iterator["_Lines"]:
    """The lines of a file, some millions of bytes at a time."""
    start = len(_BYTE_ORDER_MARK) if data.startswith(_BYTE_ORDER_MARK) else 0
    while start < len(data):
        stop = data.find(b"\n", start + _BLOCK_BYTES)
        stop = len(data) if stop < 0 else stop + 1
        if stop - start > 2 * _BLOCK_BYTES:
            raise MeshSizeError(f"{name}: a line of more than {_BLOCK_BYTES} bytes")
        yield _Lines(data[start:stop])
        start = stop


class _Lines:
    """Lines of a text file as one array of bytes, without blanks at their beginnings."""

    def __init__(self, text: bytes) -> None:
        text = text.translate(bytes.maketrans(_BLANKS, b" " * len(_BLANKS)))
        if text.startswith(b" ") or b"\n " in text:
            text = re.sub(rb"(?m)^ +", b"", text)
        # The last line may lack its end, and every line needs a second byte to look at.
        self._bytes = np.frombuffer(text + b"\n\n", np.uint8)
        ends = np.flatnonzero(self._bytes[:-1] == _LINE_END)
        self._starts = np.concatenate([[0], ends[:-1] + 1])
        self._lengths = np.diff(self._starts, append=len(self._bytes) - 1)
        self._prefixes = self._bytes[self._starts].astype(np.uint16) << 8 | self._bytes[self._starts + 1]

    def starts_with(self, prefix: bytes) -> NDArray[np.bool_]:
        """Which lines start with two bytes."""
        found: NDArray[np.bool_] = self._prefixes == int.from_bytes(prefix, "big")
        return found

    def refuse_others(self, known: NDArray[np.bool_], name: str) -> None:
        """Refuse lines that are neither `known` nor one of OBJ's other statements."""
        odd = np.flatnonzero(~known & ~_MAY_BE_SKIPPED[self._prefixes])
        if len(odd):
            line = self._bytes[self._starts[odd[0]] :][: min(self._lengths[odd[0]], 40)].tobytes()
            raise ObjectError(f"{name}: not a Wavefront OBJ statement: {line.decode('ascii', 'replace').strip()!r}")

    def of(self, which: NDArray[np.bool_]) -> bytes:
        """Some lines without the byte that they start with, each with its line end."""
        kept = np.repeat(which, self._lengths)
        kept[self._starts] = False
        return self._bytes[:-1][kept].tobytes()


def _numbers(text: bytes, dtype: Any) -> NDArray[Any]:
    """The numbers between the blanks of a text; none if a word is no number."""
    with warnings.catch_warnings():
        # Older releases of NumPy warn of such a word, newer ones raise.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (ValueError, DeprecationWarning):
            return np.empty(0, dtype)


def _words(text: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Where the words of some lines start, and how many each line has; every line ends with a line end."""
    blank = text <= _SPACE
    starts = ~blank
    starts[1:] &= blank[:-1]
    ends = np.flatnonzero(text == _LINE_END)
    counts = np.add.reduceat(starts, np.concatenate([[0], ends[:-1] + 1]), dtype=np.int64)
    return starts, counts


def _vertices(text: bytes, above: int, name: str) -> Float:
    """[V, 3], from lines of x y z, which a weight or a colour may follow; `above` are in the file before them."""
    _, counts = _words(np.frombuffer(text, np.uint8))
    plain = bool((counts == 3).all())
    if not plain and len(odd := np.flatnonzero(~np.isin(counts, (3, 4, 6, 7)))):
        number = above + odd[0] + 1
        raise ObjectError(f"{name}: vertex {number} has {counts[odd[0]]} numbers instead of 3; truncated?")
    numbers = _numbers(text, np.float64)
    if len(numbers) != counts.sum():
        word = next((word for word in text.split() if not len(_numbers(word, np.float64))), b"")
        raise ObjectError(f"{name}: a vertex is not a number ({word[:60].decode('ascii', 'replace')!r})")
    if not plain:
        numbers = numbers[((np.cumsum(counts) - counts)[:, None] + np.arange(3)).ravel()]
    return _bounded(numbers.reshape(-1, 3), name)


def _bounded(vertices: Float, name: str) -> Float:
    """Vertices [V, 3], none of which may be far away or nowhere."""
    if not (np.abs(vertices) <= MAX_COORDINATE).all():
        raise ObjectError(f"{name}: a vertex is not finite, or beyond {MAX_COORDINATE:g}")
    return vertices


def _faces(text: bytes, above: NDArray[np.int64], name: str) -> NDArray[np.int32]:
    """[F, 3], zero-based, from lines of corners `v`, `v/t`, `v//n` or `v/t/n`.

    Args:
        text: the lines.
        above: how many vertices stand above each.
        name: what messages call the file.
    """
    array = np.frombuffer(text, np.uint8)
    starts, counts = _words(array)
    fewest = int(np.argmin(counts))
    if counts[fewest] < 3:
        raise ObjectError(f"{name}: a face has {counts[fewest]} corners; at least 3 are needed; truncated?")
    _check_forms(array, np.flatnonzero(starts), counts, name)
    # With its slashes blank, the text is one list of numbers; those that no slash precedes come first in a corner.
    gap = (array <= _SPACE) | (array == _SLASH)
    fields = ~gap
    fields[1:] &= gap[:-1]
    numbers = _numbers(text.replace(b"/", b" "), np.int64)
    if len(numbers) != np.count_nonzero(fields) or (numbers != numbers.astype(np.int32)).any():
        raise ObjectError(f"{name}: a face's corner is not a vertex number")
    index = numbers[starts[fields]]
    index = np.where(index < 0, index + np.repeat(above, counts), index - 1)
    # What is out of range stays so in fewer bits.
    return index.reshape(-1, 3).astype(np.int32) if counts.max() == 3 else _fans(index, counts)


def _check_forms(array: NDArray[np.uint8], starts: NDArray[np.int64], counts: NDArray[np.int64], name: str) -> None:
    """Refuse a face whose corners are not all of one form, as a cut line's are.

    Args:
        array: the bytes of the faces' lines.
        starts: where corners start.
        counts: corners of each face.
        name: what messages call the file.
    """
    slash = array == _SLASH
    if not slash.any():
        return
    if slash[starts].any() or (slash[:-1] & (array[1:] <= _SPACE)).any():
        raise ObjectError(f"{name}: a face's corner is incomplete; truncated?")
    slashes = np.add.reduceat(slash, starts, dtype=np.int64)
    odd = np.flatnonzero(slashes != np.repeat(slashes[np.cumsum(counts) - counts], counts))
    if len(odd):
        corner = array[starts[odd[0]] :][:40].tobytes().split()[0].decode("ascii", "replace")
        raise ObjectError(f"{name}: a face mixes forms of corners ({corner!r})")
    if slashes.max() > 2:
        raise ObjectError(f"{name}: a face's corner is not a vertex number")


def parse_stl(data: bytes, name: str) -> Mesh:
    """The triangles of an STL file, binary or ASCII; corners at the very same place become one vertex.

    Args:
        data: the whole file.
        name: what messages call it.

    Raises:
        MeshSizeError: the file is beyond a bound.
        ObjectError: it is truncated, malformed, not finite, or holds no face.
    """
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    if len(data) == _STL_HEADER + _STL_TRIANGLE * count and count:
        triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
        corners = np.frombuffer(data, triangle, offset=_STL_HEADER)["corners"].reshape(-1, 3).astype(np.float64)
    elif data.removeprefix(_BYTE_ORDER_MARK).lstrip()[:5].lower() == b"solid":
        corners = _ascii_corners(data, name)
    else:
        raise ObjectError(f"{name}: no STL file of the length that it states; truncated?")
    vertices, index = np.unique(_bounded(corners, name), axis=0, return_inverse=True)
    return Mesh(vertices, index.reshape(-1, 3).astype(np.int32))


def _ascii_corners(data: bytes, name: str) -> Float:
    """[3 * triangles, 3], from the lines `vertex x y z`."""
    corners = [np.empty((0, 3))]
    for lines in _blocks(data.lower(), name):
        is_vertex = lines.starts_with(_STL_VERTEX[:2])
        if is_vertex.any():
            text = lines.of(is_vertex)
            if text.count(_STL_VERTEX[1:]) != is_vertex.sum():
                raise ObjectError(f"{name}: not an STL file's line; truncated?")
            corners.append(_vertices(text.replace(_STL_VERTEX[1:], b" "), sum(map(len, corners)), name))
    if len(corners) == 1 or sum(map(len, corners)) % 3:
        raise ObjectError(f"{name}: no triangles of three vertices; the file is empty or truncated")
    return np.concatenate(corners)


def _fans(index: NDArray[np.int64], corners: NDArray[np.int64]) -> NDArray[np.int32]:
    """Triangles [F, 3] of polygons with `corners` corners each, whose vertices follow one another in `index`."""
    first = np.concatenate([[0], np.cumsum(corners)[:-1]])
    triangles = corners - 2
    start = np.repeat(first, triangles)
    offset = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    fans: NDArray[np.int64] = index[np.stack([start, start + offset + 1, start + offset + 2], axis=1)]
    return fans.astype(np.int32)


def placed(mesh: Mesh, pose: Float, scale: Float | None = None) -> Mesh:
    """`mesh` scaled along its own axes, then moved by `pose` [4, 4].

    A scale that mirrors turns the faces over, so that their normals still point outward.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if scale is not None:
        vertices = vertices * scale
        faces = faces[:, ::-1] if np.prod(scale) < 0 else faces
    return Mesh(vertices @ pose[:3, :3].T + pose[:3, 3], faces)


def box(size: Float) -> Mesh:
    """An axis-aligned box of `size` [3] about the origin."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    return Mesh(signs * size / 2, np.array(faces, dtype=np.int32))


def frustum(bottom_radius: float, top_radius: float, length: float, sides: int = 24) -> Mesh:
    """A cylinder or truncated cone about the z axis, centred at the origin."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
    half = np.array([0.0, 0.0, length / 2])
    vertices = np.concatenate([ring * bottom_radius - half, ring * top_radius + half, [-half, half]])
    here, after = np.arange(sides), np.roll(np.arange(sides), -1)
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = np.concatenate(
        [
            np.stack([here, after, after + sides], axis=1),
            np.stack([here, after + sides, here + sides], axis=1),
            np.stack([after, here, bottom], axis=1),
            np.stack([here + sides, after + sides, top], axis=1),
        ]
    )
    return Mesh(vertices, faces.astype(np.int32))


def sphere(radius: float, rings: int = 12, sides: int = 24) -> Mesh:
    """A sphere about the origin, poles on the z axis."""
    polar = np.pi * np.arange(1, rings) / rings
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    body = np.concatenate([np.column_stack([np.sin(p) * circle, np.full(sides, np.cos(p))]) for p in polar])
    vertices = radius * np.concatenate([body, [[0, 0, 1], [0, 0, -1]]])
    here, after = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = [np.stack([np.full(sides, len(body)), here, after], axis=1)]
    for ring in range(rings - 2):
        upper, lower = ring * sides, (ring + 1) * sides
        faces.append(np.stack([here + upper, here + lower, after + lower], axis=1))
        faces.append(np.stack([here + upper, after + lower, after + upper], axis=1))
    last = (rings - 2) * sides
    faces.append(np.stack([np.full(sides, len(body) + 1), after + last, here + last], axis=1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))
