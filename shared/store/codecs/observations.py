"""The clouds of a shard as a Zarr v3 group: one array a field, few and large chunks, encoded and decoded in memory.

Zarr writes to a dictionary here and the shard writer puts that on the disk, since Zarr itself forces nothing to the
disk. Reading does without Zarr: the manifest says what each file must be, so that no claim of the metadata is followed,
and a chunk's header is checked before the decoder, which believes it, sees the chunk.

Shapes: O observations of a shard, N points of a cloud, S pixels of a row and of a column of a depth image. S is 0 in a
shard without depth images, which lacks the arrays that describe them.
"""

import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numcodecs.blosc import Blosc  # type: ignore[import-untyped]
from numpy.typing import NDArray

from shared.depth import DepthMap, pack_steps, unpack_steps
from shared.errors import StoreError
from shared.io.documents import parse_object
from shared.io.text import plain
from shared.types import (
    NORMAL_STEPS,
    Float,
    Float32,
    Observation,
    pack_normals,
    round_normals,
    round_points,
    unpack_normals,
)

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
    depth: NDArray[np.uint16] | None = None
    """[O, S, S], the steps of depth maps (see `shared.depth.DepthMap`)."""
    focal: Float | None = None
    """[O, 1], of the depth maps."""

    def __len__(self) -> int:
        return len(self.points)

    def observation(self, index: int) -> Observation:
        """One of them; its arrays are views of these."""
        dense = None
        if self.depth is not None and self.focal is not None:
            dense = DepthMap(self.depth[index], self.focal[index], self.world_from_camera[index])
        return Observation(**{array.name: getattr(self, array.name)[index] for array in ARRAYS}, dense=dense)


@dataclass(frozen=True, slots=True)
class ArrayKind:
    """One array of the group.

    Attributes:
        name: of the array, and of the field of `Observation`.
        seen: numpy type that an observation has.
        kept: numpy type that is stored.
        tail: shape after [O]; `_POINTS` stands for N and `_PIXELS` for S.
        description: for the array's attributes.
    """

    name: str
    seen: str
    kept: str
    tail: tuple[int, ...]
    description: str

    def shape(self, points: int, pixels: int) -> tuple[int, ...]:
        """Shape of one observation's field, for clouds of `points` and depth images of `pixels` a row."""
        return tuple({_POINTS: points, _PIXELS: pixels}.get(size, size) for size in self.tail)

    def chunk(self, observations: int, points: int, pixels: int) -> tuple[int, ...]:
        """Shape of a chunk: everything, unless that were too large."""
        shape = self.shape(points, pixels)
        most = MAX_CHUNK_BYTES // (math.prod(shape) * np.dtype(self.kept).itemsize)
        return (max(1, min(observations, most)), *shape)

    def chunk_bytes(self, observations: int, points: int, pixels: int) -> int:
        """Size of a chunk, unpacked; the last one is as large as the others."""
        return math.prod(self.chunk(observations, points, pixels)) * np.dtype(self.kept).itemsize

    def chunk_files(self, observations: int, points: int, pixels: int) -> list[str]:
        """Paths within the group of all chunks, in order."""
        count = -(-observations // self.chunk(observations, points, pixels)[0])
        return [f"{self.name}/c.{number}{'.0' * len(self.tail)}" for number in range(count)]

    def pack(self, seen: NDArray[Any]) -> NDArray[Any]:
        """What is stored, for a field as an observation has it."""
        match self.name:
            case "normals":
                return pack_normals(seen)
            case "depth":
                return pack_steps(seen)
            case _:
                return seen.astype(self.kept)

    def unpack(self, kept: NDArray[Any]) -> NDArray[Any]:
        """The field as an observation has it."""
        match self.name:
            case "normals":
                return unpack_normals(kept)
            case "depth":
                return unpack_steps(kept)
            case _:
                return kept.astype(self.seen)


_POINTS, _PIXELS = 0, -1
ARRAYS = (
    ArrayKind("points", "<f4", "<f2", (_POINTS, 3), "world frame, furthest-point order"),
    ArrayKind("normals", "<f4", "|i1", (_POINTS, 3), f"world frame, times {NORMAL_STEPS}"),
    ArrayKind("part_ids", "|u1", "|u1", (_POINTS,), "0: static body; k: k-th movable part"),
    ArrayKind("movable", "|b1", "|b1", (_POINTS,), "whether the task may act on the point"),
    ArrayKind("pixels", "<u4", "<u4", (_POINTS,), "row * image width + column"),
    ArrayKind("world_from_camera", "<f8", "<f8", (4, 4), "pose of the camera: x forward, y left, z up"),
)
DEPTH_ARRAYS = (
    ArrayKind("depth", "<u2", "<u2", (_PIXELS, _PIXELS), "depth image as shared.depth.pack_steps writes it"),
    ArrayKind("focal", "<f8", "<f8", (1,), "focal length of the depth image, pixels"),
)
"""Of shards with depth images alone."""


def kinds(pixels: int) -> tuple[ArrayKind, ...]:
    """The arrays of a shard with depth images of `pixels` a row; 0: without."""
    return (*ARRAYS, *DEPTH_ARRAYS) if pixels else ARRAYS


def depth_size(observations: Iterable[Observation]) -> int:
    """S of the depth images that observations keep; 0: none keeps one.

    Raises:
        ValueError: only some keep one, or not all are of one size.
    """
    sizes = {0 if each.dense is None else len(_depth_map(each).steps) for each in observations}
    if len(sizes) > 1:
        raise ValueError(f"observations keep depth images of several sizes, {sorted(sizes)}; 0 is none")
    return sizes.pop() if sizes else 0


def _depth_map(observation: Observation) -> DepthMap:
    if not isinstance(observation.dense, DepthMap):
        raise ValueError(f"observation's dense geometry is a {type(observation.dense).__name__}, not a depth map")
    return observation.dense


def check_observation(observation: Observation, points: int) -> None:
    """Hold an observation to what the store can keep bit for bit.

    Raises:
        ValueError: a wrong shape or type, a number that is not finite, or a cloud that was not rounded.
    """
    fields = fields_of(observation)
    pixels = len(fields["depth"]) if "depth" in fields else 0
    for array in kinds(pixels):
        field, shape = fields[array.name], array.shape(points, pixels)
        if field.dtype != np.dtype(array.seen) or field.shape != shape:
            raise ValueError(f"observation's {array.name} is {field.dtype} {field.shape}, needs {array.seen} {shape}")
        if field.dtype.kind == "f" and not np.isfinite(field).all():
            raise ValueError(f"observation's {array.name} holds a number that is not finite")
    if not np.array_equal(observation.points, round_points(observation.points)):
        raise ValueError("observation's points are not rounded to float16 (see shared.types)")
    if not np.array_equal(observation.normals, round_normals(observation.normals)):
        raise ValueError("observation's normals are not rounded (see shared.types)")
    if pixels and not fields["focal"] > 0:
        raise ValueError(f"observation's focal length is {fields['focal']}; it is positive")
    if pixels and not np.array_equal(_depth_map(observation).world_from_camera, observation.world_from_camera):
        raise ValueError("observation's depth image is of another camera than its cloud")


def fields_of(observation: Observation) -> dict[str, NDArray[Any]]:
    """What is stored of an observation, by the name of the array."""
    fields = {kind.name: getattr(observation, kind.name) for kind in ARRAYS}
    if observation.dense is not None:
        dense = _depth_map(observation)
        fields |= {"depth": dense.steps, "focal": dense.focal}
    return fields


Packed = Mapping[str, NDArray[Any]]
"""One observation as it is stored, by the name of the array."""


def pack(observation: Observation) -> Packed:
    """An observation as it is stored: for the arrays of the group, and for the content digest."""
    fields = fields_of(observation)
    return {kind.name: kind.pack(fields[kind.name]) for kind in (*ARRAYS, *DEPTH_ARRAYS) if kind.name in fields}


def encode(observations: Sequence[Packed], points: int, pixels: int) -> dict[str, bytes]:
    """The files of the group, by path within it."""
    # Imported here, since most processes only read, and this takes a quarter of a second.
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.core.buffer import Buffer
    from zarr.storage import MemoryStore

    memory: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(memory), zarr_format=3)
    for kind in kinds(pixels):
        data = np.empty((len(observations), *kind.shape(points, pixels)), kind.kept)
        for k, observation in enumerate(observations):
            data[k] = observation[kind.name]
        array = group.create_array(
            kind.name,
            shape=data.shape,
            dtype=data.dtype,
            chunks=kind.chunk(len(observations), points, pixels),
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


def file_limits(observations: int, points: int, pixels: int) -> Iterator[tuple[str, int]]:
    """Paths within the group of all the files that a shard of this size has, and the most bytes that each may have."""
    yield _GROUP_FILE, MAX_METADATA_BYTES
    for kind in kinds(pixels):
        yield f"{kind.name}/{_GROUP_FILE}", MAX_METADATA_BYTES
        # Data that cannot be compressed grow by a header.
        most = kind.chunk_bytes(observations, points, pixels) + _BLOSC_HEADER.size
        yield from ((path, most) for path in kind.chunk_files(observations, points, pixels))


def decode(files: Mapping[str, bytes], observations: int, points: int, pixels: int, source: str) -> ObservationArrays:
    """The arrays of a group from hostile files.

    Args:
        files: those that `file_limits` names, by path within the group.
        observations: O.
        points: N.
        pixels: S.
        source: what messages call the group.

    Raises:
        StoreError: they are not what `encode` makes for as many observations and points.
    """
    group = parse_object(files[_GROUP_FILE], f"{source}/{_GROUP_FILE}")
    if group.get("node_type") != "group" or group.get("consolidated_metadata") is not None:
        raise StoreError(f"{source}: its Zarr metadata are not a plain group's; the file is damaged or foreign")
    arrays = ObservationArrays(
        **{kind.name: _decode_array(files, kind, observations, points, pixels, source) for kind in kinds(pixels)}
    )
    axes = arrays.world_from_camera[:, :3, :3]
    if not np.isfinite(arrays.points).all() or not np.isfinite(arrays.world_from_camera).all():
        raise StoreError(f"{source}: holds numbers that are not finite; the file is damaged or foreign")
    if arrays.focal is not None and not (np.isfinite(arrays.focal) & (arrays.focal > 0)).all():
        raise StoreError(f"{source}/focal: holds numbers that are no focal lengths; the file is damaged or foreign")
    if (np.abs(axes @ axes.transpose(0, 2, 1) - np.eye(3)) > RIGID).any():
        raise StoreError(f"{source}/world_from_camera: is no pose of a camera; the file is damaged or foreign")
    return arrays


def _decode_array(
    files: Mapping[str, bytes], kind: ArrayKind, observations: int, points: int, pixels: int, source: str
) -> NDArray[Any]:
    where = f"{source}/{kind.name}"
    _check_metadata(files[f"{kind.name}/{_GROUP_FILE}"], kind, observations, points, pixels, where)
    size = kind.chunk_bytes(observations, points, pixels)
    kept = np.empty((observations, *kind.shape(points, pixels)), kind.kept)
    rows = kind.chunk(observations, points, pixels)[0]
    for number, path in enumerate(kind.chunk_files(observations, points, pixels)):
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


def _check_metadata(data: bytes, kind: ArrayKind, observations: int, points: int, pixels: int, where: str) -> None:
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
        "shape": [observations, *kind.shape(points, pixels)],
        "data_type": np.dtype(kind.kept).name,
        "chunk_grid": {"chunk_shape": list(kind.chunk(observations, points, pixels))},
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
