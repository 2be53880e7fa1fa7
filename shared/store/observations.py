"""The clouds of a shard as a Zarr v3 group: one array a field, few and large chunks, encoded and decoded in memory.

Zarr writes to a dictionary here and the shard writer puts that on the disk, since Zarr itself forces nothing to the
disk. Reading goes the same way, so that only files whose size and checksum the manifest vouches for reach Zarr.

Shapes: O observations of a shard, N points of a cloud.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec
from zarr.core.buffer import Buffer, default_buffer_prototype
from zarr.storage import MemoryStore

from shared.errors import StoreError
from shared.observation import NORMAL_STEPS, pack_normals, round_normals, round_points, unpack_normals
from shared.vocabulary import Float, Float32, Observation

MAX_CHUNK_BYTES = 64 << 20
_GROUP_FILE = "zarr.json"


@dataclass(frozen=True, slots=True)
class ObservationArrays:
    """All observations of a shard, stacked; fields as in `shared.vocabulary.Observation`."""

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


def encode(observations: Sequence[Observation], points: int) -> dict[str, bytes]:
    """The files of the group, by path within it."""
    memory: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(memory), zarr_format=3)
    for kind in ARRAYS:
        data = np.empty((len(observations), *kind.shape(points)), kind.kept)
        for k, observation in enumerate(observations):
            data[k] = kind.pack(getattr(observation, kind.name))
        array = group.create_array(
            kind.name,
            shape=data.shape,
            dtype=data.dtype,
            chunks=kind.chunk(len(observations), points),
            filters=None,
            compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
            # "c.0.0.0" beside the metadata instead of "c/0/0/0": three folders an array less to force to the disk.
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


def file_names(observations: int, points: int) -> Iterator[str]:
    """Paths within the group of all the files that a shard of this size has."""
    yield _GROUP_FILE
    for kind in ARRAYS:
        yield f"{kind.name}/{_GROUP_FILE}"
        chunk = kind.chunk(observations, points)
        rest = ".0" * len(kind.tail)
        yield from (f"{kind.name}/c.{k}{rest}" for k in range(-(-observations // chunk[0])))


def size_limit(observations: int, points: int) -> int:
    """Bytes that no file of the group exceeds; incompressible data grow by a header only."""
    chunks = (math.prod(k.chunk(observations, points)) * np.dtype(k.kept).itemsize for k in ARRAYS)
    return max(chunks) + (1 << 16)


def decode(files: Mapping[str, bytes], observations: int, points: int, source: str) -> ObservationArrays:
    """The arrays of a group from hostile files.

    Raises:
        StoreError: they are not what `encode` makes for as many observations and points.
    """
    for kind in ARRAYS:
        _check_array(files, kind, observations, points, source)
    buffer = default_buffer_prototype().buffer
    memory = MemoryStore({path: buffer.from_bytes(data) for path, data in files.items()}, read_only=True)
    try:
        group = zarr.open_group(memory, mode="r", zarr_format=3)
        arrays = {kind.name: kind.unpack(np.asarray(group[kind.name][...])) for kind in ARRAYS}  # type: ignore[index]
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        line = " ".join(str(error).split())[:100]
        raise StoreError(f"{source}: cannot be decoded ({line}); the file is damaged or foreign") from None
    return ObservationArrays(**arrays)


def _check_array(files: Mapping[str, bytes], kind: ArrayKind, observations: int, points: int, source: str) -> None:
    """Hold an array's metadata and the sizes that its chunks claim to what the manifest implies."""
    where = f"{source}/{kind.name}"
    chunk = kind.chunk(observations, points)
    try:
        metadata = json.loads(files[f"{kind.name}/{_GROUP_FILE}"])
        claims = (
            metadata["node_type"],
            metadata["shape"],
            metadata["data_type"],
            metadata["chunk_grid"]["configuration"]["chunk_shape"],
            [codec["name"] for codec in metadata["codecs"]],
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        raise StoreError(f"{where}: its Zarr metadata are malformed; the file is damaged or foreign") from None
    shape = [observations, *kind.shape(points)]
    expected = ("array", shape, np.dtype(kind.kept).name, list(chunk), ["bytes", "blosc"])
    if claims != expected:
        raise StoreError(f"{where}: Zarr metadata claim {str(claims)[:120]}, the manifest implies {expected}")
    chunk_bytes = math.prod(chunk) * np.dtype(kind.kept).itemsize
    for path, data in files.items():
        # Blosc trusts the unpacked size in its header, and would allocate whatever that says.
        if path.startswith(f"{kind.name}/c.") and int.from_bytes(data[4:8], "little") != chunk_bytes:
            raise StoreError(f"{where}: a chunk claims another size than {chunk_bytes} bytes; it is damaged or foreign")
