"""The clouds of a shard as a Zarr v3 group: one array a field, few and large chunks, encoded and decoded in memory.

Zarr writes to a dictionary here and the shard writer puts that on the disk, since Zarr itself forces nothing to the
disk. Reading does without Zarr: the manifest says what each file must be, so that no claim of the metadata is followed,
and a chunk's header is checked before the decoder, which believes it, sees the chunk.

Shapes: O observations of a shard, N points of a cloud.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numcodecs.blosc import Blosc  # type: ignore[import-untyped]
from numpy.typing import NDArray
from zarr.codecs import BloscCodec
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from shared.errors import StoreError
from shared.io.documents import parse_object
from shared.io.text import plain
from shared.observation import NORMAL_STEPS, pack_normals, round_normals, round_points, unpack_normals
from shared.types import Float, Float32, Observation

MAX_CHUNK_BYTES = 64 << 20
MAX_METADATA_BYTES = 1 << 16
RIGID = 1e-3
"""How far a camera's axes may be from three perpendicular ones of length 1."""
_GROUP_FILE = "zarr.json"
_BLOSC_HEADER = struct.Struct("<4B3I")
"""Versions of the format and of its compressor, flags, size of an element; bytes unpacked, of a block, and in all."""
_LITTLE = {"endian": "little"}
_CHUNK_KEYS = {"name": "default", "configuration": {"separator": "."}}
"""Chunks lie in "c.0.0.0" beside the metadata, not in "c/0/0/0": three folders an array less to force to the disk."""


@dataclass(frozen=True, slots=True)
class ObservationArrays:
    """All observations of a shard, stacked; fields as in `shared.types.Observation`."""

    points: Float32
    """[O, N, 3], exactly representable in float16."""
    normals: Float32
    """[O, N, 3]."""
    part_ids: NDArray[np.uint8]
    """[O, N]."""
    movable: NDArray[np.bool_]
    """[O, N]."""
    pixels: NDArray[np.uint32]
    """[O, N]."""
    world_from_camera: Float
    """[O, 4, 4]."""

    def __len__(self) -> int:
        return len(self.points)

    def observation(self, index: int) -> Observation:
        """One of them; its arrays are views of these."""
        return Observation(**{array.name: getattr(self, array.name)[index] for array in ARRAYS})


@dataclass(frozen=True, slots=True)
class ArrayKind:
    """One array of the group.

    Attributes:
        name: of the array, and of the field of `Observation`.
        seen: numpy type that an observation has.
        kept: numpy type that is stored.
        tail: shape after [O]; 0 stands for N.
        description: for the array's attributes.
    """

    name: str
    seen: str
    kept: str
    tail: tuple[int, ...]
    description: str

    def shape(self, points: int) -> tuple[int, ...]:
        """Shape of one observation's field, for clouds of `points`."""
        return tuple(size or points for size in self.tail)

    def chunk(self, observations: int, points: int) -> tuple[int, ...]:
        """Shape of a chunk: everything, unless that were too large."""
        shape = self.shape(points)
        most = MAX_CHUNK_BYTES // (math.prod(shape) * np.dtype(self.kept).itemsize)
        return (max(1, min(observations, most)), *shape)

    def chunk_bytes(self, observations: int, points: int) -> int:
        """Size of a chunk, unpacked; the last one is as large as the others."""
        return math.prod(self.chunk(observations, points)) * np.dtype(self.kept).itemsize

    def chunk_files(self, observations: int, points: int) -> list[str]:
        """Paths within the group of all chunks, in order."""
        count = -(-observations // self.chunk(observations, points)[0])
        return [f"{self.name}/c.{number}{'.0' * len(self.tail)}" for number in range(count)]

    def pack(self, seen: NDArray[Any]) -> NDArray[Any]:
        """What is stored, for a field as an observation has it."""
        return pack_normals(seen) if self.name == "normals" else seen.astype(self.kept)

    def unpack(self, kept: NDArray[Any]) -> NDArray[Any]:
        """The field as an observation has it."""
        return unpack_normals(kept) if self.name == "normals" else kept.astype(self.seen)


ARRAYS = (
    ArrayKind("points", "<f4", "<f2", (0, 3), "world frame, furthest-point order"),
    ArrayKind("normals", "<f4", "|i1", (0, 3), f"world frame, times {NORMAL_STEPS}"),
    ArrayKind("part_ids", "|u1", "|u1", (0,), "0: static body; k: k-th movable part"),
    ArrayKind("movable", "|b1", "|b1", (0,), "whether the task may act on the point"),
    ArrayKind("pixels", "<u4", "<u4", (0,), "row * image width + column"),
    ArrayKind("world_from_camera", "<f8", "<f8", (4, 4), "pose of the camera: x forward, y left, z up"),
)


def check_observation(observation: Observation, points: int) -> None:
    """Hold an observation to what the store can keep bit for bit.

    Raises:
        ValueError: a wrong shape or type, a number that is not finite, or a cloud that was not rounded.
    """
    for array in ARRAYS:
        field = getattr(observation, array.name)
        if field.dtype != np.dtype(array.seen) or field.shape != array.shape(points):
            given = f"{field.dtype} {field.shape}"
            raise ValueError(f"observation's {array.name} is {given}, needs {array.seen} {array.shape(points)}")
        if field.dtype.kind == "f" and not np.isfinite(field).all():
            raise ValueError(f"observation's {array.name} holds a number that is not finite")
    if not np.array_equal(observation.points, round_points(observation.points)):
        raise ValueError("observation's points are not rounded to float16 (see shared.observation)")
    if not np.array_equal(observation.normals, round_normals(observation.normals)):
        raise ValueError("observation's normals are not rounded (see shared.observation)")


Packed = Mapping[str, NDArray[Any]]
"""One observation as it is stored, by the name of the array."""


def pack(observation: Observation) -> Packed:
    """An observation as it is stored: for the arrays of the group, and for the content digest."""
    return {kind.name: kind.pack(getattr(observation, kind.name)) for kind in ARRAYS}


def encode(observations: Sequence[Packed], points: int) -> dict[str, bytes]:
    """The files of the group, by path within it."""
    memory: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(memory), zarr_format=3)
    for kind in ARRAYS:
        data = np.empty((len(observations), *kind.shape(points)), kind.kept)
        for k, observation in enumerate(observations):
            data[k] = observation[kind.name]
        array = group.create_array(
            kind.name,
            shape=data.shape,
            dtype=data.dtype,
            chunks=kind.chunk(len(observations), points),
            filters=None,
            compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
            chunk_key_encoding={"name": "default", "separator": "."},
            attributes={"description": kind.description},
            # Otherwise a chunk of zeros would have no file, and a lost file would read as zeros.
            config={"write_empty_chunks": True},
        )
        if len(observations):
            array[...] = data
    files = {path: buffer.to_bytes() for path, buffer in memory.items()}
    # Zarr indents its metadata, which would be half of their size, and a shard has seven such files.
    metadata = {path: json.loads(data) for path, data in files.items() if path.endswith(_GROUP_FILE)}
    return files | {path: json.dumps(one, separators=(",", ":")).encode() for path, one in metadata.items()}


def file_limits(observations: int, points: int) -> Iterator[tuple[str, int]]:
    """Paths within the group of all the files that a shard of this size has, and the most bytes that each may have."""
    yield _GROUP_FILE, MAX_METADATA_BYTES
    for kind in ARRAYS:
        yield f"{kind.name}/{_GROUP_FILE}", MAX_METADATA_BYTES
        # Data that cannot be compressed grow by a header.
        most = kind.chunk_bytes(observations, points) + _BLOSC_HEADER.size
        yield from ((path, most) for path in kind.chunk_files(observations, points))


def decode(files: Mapping[str, bytes], observations: int, points: int, source: str) -> ObservationArrays:
    """The arrays of a group from hostile files.

    Args:
        files: those that `file_limits` names, by path within the group.
        observations: O.
        points: N.
        source: what messages call the group.

    Raises:
        StoreError: they are not what `encode` makes for as many observations and points.
    """
    group = parse_object(files[_GROUP_FILE], f"{source}/{_GROUP_FILE}")
    if group.get("node_type") != "group" or group.get("consolidated_metadata") is not None:
        raise StoreError(f"{source}: its Zarr metadata are not a plain group's; the file is damaged or foreign")
    arrays = ObservationArrays(
        **{kind.name: _decode_array(files, kind, observations, points, source) for kind in ARRAYS}
    )
    axes = arrays.world_from_camera[:, :3, :3]
    if not np.isfinite(arrays.points).all() or not np.isfinite(arrays.world_from_camera).all():
        raise StoreError(f"{source}: holds numbers that are not finite; the file is damaged or foreign")
    if (np.abs(axes @ axes.transpose(0, 2, 1) - np.eye(3)) > RIGID).any():
        raise StoreError(f"{source}/world_from_camera: is no pose of a camera; the file is damaged or foreign")
    return arrays


def _decode_array(
    files: Mapping[str, bytes], kind: ArrayKind, observations: int, points: int, source: str
) -> NDArray[Any]:
    where = f"{source}/{kind.name}"
    _check_metadata(files[f"{kind.name}/{_GROUP_FILE}"], kind, observations, points, where)
    size = kind.chunk_bytes(observations, points)
    kept = np.empty((observations, *kind.shape(points)), kind.kept)
    rows = kind.chunk(observations, points)[0]
    for number, path in enumerate(kind.chunk_files(observations, points)):
        part = kept[number * rows : (number + 1) * rows]
        unpacked = np.frombuffer(_decode_chunk(files[path], size, f"{source}/{path}"), kind.kept)
        part[:] = unpacked[: part.size].reshape(part.shape)
    if kind.kept == "|b1" and (kept.view(np.uint8) > 1).any():
        raise StoreError(f"{where}: holds bytes that are neither true nor false; the file is damaged or foreign")
    return kind.unpack(kept)


def _decode_chunk(data: bytes, size: int, where: str) -> bytes:
    """What a chunk holds, `size` bytes."""
    # The decoder reads and writes as many bytes as the header says.
    claimed = _BLOSC_HEADER.unpack_from(data)[4::2] if len(data) >= _BLOSC_HEADER.size else ()
    if claimed != (size, len(data)):
        raise StoreError(
            f"{where}: claims another size than {size} bytes in {len(data)}; the chunk is damaged or foreign"
        )
    try:
        unpacked: bytes = Blosc().decode(data)
    except (RuntimeError, ValueError) as error:
        line = " ".join(str(error).split())[:100]
        raise StoreError(f"{where}: cannot be decoded ({line}); the chunk is damaged or foreign") from None
    return unpacked


def _check_metadata(data: bytes, kind: ArrayKind, observations: int, points: int, where: str) -> None:
    """Hold an array's metadata, which others read it by, to what the manifest implies."""
    metadata = parse_object(data, f"{where}/{_GROUP_FILE}")
    codecs, grid = metadata.get("codecs"), metadata.get("chunk_grid")
    claims = {
        "node_type": metadata.get("node_type"),
        "shape": metadata.get("shape"),
        "data_type": metadata.get("data_type"),
        "chunk_grid": grid.get("configuration") if isinstance(grid, dict) else grid,
        "chunk_key_encoding": metadata.get("chunk_key_encoding"),
        "codecs": [_codec(each) for each in codecs] if isinstance(codecs, list) else codecs,
        "storage_transformers": metadata.get("storage_transformers") or [],
    }
    implied = {
        "node_type": "array",
        "shape": [observations, *kind.shape(points)],
        "data_type": np.dtype(kind.kept).name,
        "chunk_grid": {"chunk_shape": list(kind.chunk(observations, points))},
        "chunk_key_encoding": _CHUNK_KEYS,
        "codecs": ["bytes", "blosc"],
        "storage_transformers": [],
    }
    for name, value in implied.items():
        if claims[name] != value:
            raise StoreError(
                f"{where}: Zarr metadata claim {name} {plain(str(claims[name]), 120)}, not {value}; it is foreign"
            )


def _codec(told: Any) -> Any:
    """The name of a codec, if its configuration is one that is decoded here."""
    if not isinstance(told, dict) or (told.get("name") == "bytes" and told.get("configuration", _LITTLE) != _LITTLE):
        return told
    return told.get("name")
