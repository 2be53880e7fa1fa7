"""Triangle meshes: a strict Wavefront OBJ parser, and the primitive shapes that a URDF may name.

Only vertex positions and faces are read; materials, normals and texture coordinates are skipped.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from collector.articulation import Mesh
from shared.errors import ObjectError
from shared.vocabulary import Float

MAX_OBJ_BYTES = 64 << 20
MAX_VERTICES = 2_000_000
MAX_TRIANGLES = 4_000_000
MAX_COORDINATE = 1e6

# The first two bytes of every statement that a polygonal OBJ file may hold; those that carry no geometry are skipped.
_VERTEX, _FACE = b"v ", b"f "
_SKIPPED = frozenset({b"vn", b"vt", b"vp", b"o ", b"g ", b"s ", b"us", b"mt", b"l ", b"p ", b"o", b"g", b"s", b""})


def parse_obj(data: bytes, name: str) -> Mesh:
    """The triangles of a Wavefront OBJ file; polygons become fans, negative indices count from the end.

    Args:
        data: the whole file.
        name: what messages call it.

    Raises:
        ObjectError: the file is too large, truncated, malformed, not finite, or holds no face.
    """
    if len(data) > MAX_OBJ_BYTES:
        raise ObjectError(f"{name}: {len(data)} bytes; at most {MAX_OBJ_BYTES} are allowed")
    lines = [line.strip() for line in data.replace(b"\t", b" ").split(b"\n")]
    vertex_lines = [line[2:] for line in lines if line[:2] == _VERTEX]
    face_lines = [line[2:] for line in lines if line[:2] == _FACE]
    _check_statements(lines, vertex_lines, face_lines, name)
    vertices = _vertices(vertex_lines, name)
    if any(b"-" in line for line in face_lines):
        # A negative index counts back from the vertices that stand above its face.
        above = np.cumsum([line[:2] == _VERTEX for line in lines])[[line[:2] == _FACE for line in lines]]
    else:
        above = np.zeros(len(face_lines), dtype=np.int64)
    return Mesh(vertices, _faces(face_lines, len(vertices), above, name))


def _check_statements(
    lines: Sequence[bytes], vertex_lines: Sequence[bytes], face_lines: Sequence[bytes], name: str
) -> None:
    """Refuse statements that are none of OBJ's, files without faces, and those with too many."""
    for prefix in {line[:2] for line in lines} - _SKIPPED - {_VERTEX, _FACE}:
        if prefix[:1] != b"#":
            line = next(line for line in lines if line[:2] == prefix)
            raise ObjectError(f"{name}: not a Wavefront OBJ statement: {line[:40].decode('ascii', 'replace')!r}")
    if not face_lines:
        raise ObjectError(f"{name}: no faces; the file is empty or truncated")
    if len(vertex_lines) > MAX_VERTICES or len(face_lines) > MAX_TRIANGLES:
        raise ObjectError(f"{name}: more than {MAX_VERTICES} vertices or {MAX_TRIANGLES} faces")


def _vertices(lines: Sequence[bytes], name: str) -> Float:
    """[V, 3], from lines of x y z, which a weight or a colour may follow."""
    rows = [line.split() for line in lines]
    if not {len(row) for row in rows} <= {3, 4, 6, 7}:
        number = next(n for n, row in enumerate(rows, start=1) if len(row) not in {3, 4, 6, 7})
        raise ObjectError(f"{name}: vertex {number} has {len(rows[number - 1])} numbers instead of 3; truncated?")
    try:
        vertices = np.array([float(number) for row in rows for number in row[:3]]).reshape(-1, 3)
    except ValueError as error:
        raise ObjectError(f"{name}: a vertex is not a number ({str(error)[-60:]!r})") from None
    if not (np.abs(vertices) <= MAX_COORDINATE).all():
        raise ObjectError(f"{name}: a vertex is not finite, or beyond {MAX_COORDINATE:g}")
    return vertices


def _faces(lines: Sequence[bytes], vertex_count: int, above: NDArray[np.int64], name: str) -> NDArray[np.int32]:
    """[F, 3], zero-based; `above` says how many vertices stand above each line."""
    rows = [line.split() for line in lines]
    corners = np.array([len(row) for row in rows])
    if corners.min() < 3:
        number = int(np.argmin(corners)) + 1
        raise ObjectError(f"{name}: face {number} has {corners.min()} corners; at least 3 are needed; truncated?")
    if corners.sum() - 2 * len(corners) > MAX_TRIANGLES:
        raise ObjectError(f"{name}: more than {MAX_TRIANGLES} triangles")
    tokens = [token for row in rows for token in row]
    _check_corner_forms(lines, tokens, name)
    try:
        index = np.array([int(token.partition(b"/")[0]) for token in tokens], dtype=np.int64)
    except (ValueError, OverflowError):
        raise ObjectError(f"{name}: a face's corner is not a vertex number") from None
    index = np.where(index < 0, index + np.repeat(above, corners), index - 1)
    if index.min() < 0 or index.max() >= vertex_count:
        raise ObjectError(f"{name}: a face names a vertex that is not among the {vertex_count} there are; truncated?")
    if corners.max() == 3:
        return index.reshape(-1, 3).astype(np.int32)
    return _fans(index, corners)


def _check_corner_forms(lines: Sequence[bytes], tokens: Sequence[bytes], name: str) -> None:
    """Refuse a face whose corners are not all of one form (v, v/t, v//n or v/t/n), as a cut line's are."""
    slashes = sum(line.count(b"/") for line in lines)
    uniform = slashes in (0, len(tokens), 2 * len(tokens))
    for line in lines[-1:] if uniform else lines:
        if len({token.count(b"/") for token in line.split()}) != 1:
            raise ObjectError(f"{name}: a face mixes forms of corners ({line[:40].decode('ascii', 'replace')!r})")
    if any(line.endswith(b"/") for line in lines):
        raise ObjectError(f"{name}: a face's last corner is incomplete; truncated?")


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
