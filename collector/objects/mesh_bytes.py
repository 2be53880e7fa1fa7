"""Lists of meshes as bytes, for pipes and caches: checked when they are read, since either may be cut or forged.

count, then for each mesh: vertices, faces (unsigned 32 bits each), coordinates (64 bits), indices (32 bits);
the SHA-256 of all this at the end.
"""

import hashlib
import struct
from collections.abc import Sequence

import numpy as np

from collector.objects.articulation import Mesh

MAX_ENCODED_BYTES = 256 << 20
_COUNT, _SIZES = struct.Struct("<I"), struct.Struct("<II")
_CHECKSUM_BYTES = 32


def encode(meshes: Sequence[Mesh]) -> bytes:
    """The bytes of `meshes`: the same for the same meshes."""
    body = [_COUNT.pack(len(meshes))]
    for mesh in meshes:
        body += [
            _SIZES.pack(len(mesh.vertices), len(mesh.faces)),
            np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes(),
            np.ascontiguousarray(mesh.faces, dtype="<i4").tobytes(),
        ]
    data = b"".join(body)
    return data + hashlib.sha256(data).digest()


def decode(data: bytes) -> tuple[Mesh, ...]:
    """The meshes that `data` holds.

    Raises:
        ValueError: it is cut, damaged or none of ours, or a mesh is not finite or names vertices that are not there.
    """
    body = memoryview(data)[:-_CHECKSUM_BYTES]
    if len(data) < _COUNT.size + _CHECKSUM_BYTES or hashlib.sha256(body).digest() != data[-_CHECKSUM_BYTES:]:
        raise ValueError("the checksum does not fit")
    (count,), place, meshes = _COUNT.unpack_from(body), _COUNT.size, []
    for _ in range(count):
        if len(body) < place + _SIZES.size:
            raise ValueError("a mesh is missing")
        vertex_count, face_count = _SIZES.unpack_from(body, place)
        place += _SIZES.size
        middle, end = place + 24 * vertex_count, place + 24 * vertex_count + 12 * face_count
        if len(body) < end:
            raise ValueError("a mesh is cut")
        vertices = np.frombuffer(body[place:middle], dtype="<f8").reshape(-1, 3).astype(np.float64)
        faces = np.frombuffer(body[middle:end], dtype="<i4").reshape(-1, 3).astype(np.int32)
        if not np.isfinite(vertices).all() or (len(faces) and not 0 <= faces.min() <= faces.max() < vertex_count):
            raise ValueError("a mesh is not finite, or names vertices that are not there")
        meshes.append(Mesh(vertices, faces))
        place = end
    if place != len(body):
        raise ValueError("there is more than the meshes")
    return tuple(meshes)
