"""Scans: point clouds of a real object from a file or an array, as observations that a policy understands.

A scan has a frame of its own, in metres: a camera's, or a robot's. `ScanFrame` says where that frame's *up* points
(against gravity), where the camera stood in it, and which of its points is the object's middle; the world frame of
`shared.vocabulary` has that point as its origin and z up. All scans of one object share one frame.

Files are hostile until checked: bounded in size, finite, never pickled.

Shapes: M points of a scan, N points that are kept of it.
"""

import io
import os
import re
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator
from scipy.spatial import cKDTree

from adaafford.pcd import read_pcd
from shared import seeds
from shared.configuration import CameraConfig, StrictModel, parse
from shared.errors import UsageError
from shared.files import read_bounded
from shared.geometry import camera_pose, gripper_rotation
from shared.observation import furthest_first, round_normals, round_points
from shared.vocabulary import Action, Float, Observation

MAX_SCAN_BYTES = 128 << 20
MIN_POINTS, MAX_POINTS = 64, 1920 * 1080
POINTS, CANDIDATES = CameraConfig().points, CameraConfig().candidates
"""Kept of a scan, and drawn before that, as in training unless that was told otherwise."""
MAX_EXTENT_M = 10.0
"""No object that a hand opens is larger; clouds in millimetres are."""
MAX_OFF_CLOUD_M = 0.05
"""How far from the kept points an action's point may lie; they are a few centimetres apart at the most."""
FORMATS = (".ply", ".npz", ".pcd")
UNREADABLE: tuple[type[Exception], ...] = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, OSError, EOFError),
    *(RuntimeError, NameError, zipfile.BadZipFile, zlib.error),
)
"""What parsers raise when bytes are not what they pretend to be."""
_NORMAL_NEIGHBOURS = 16
_LINE_ENDS = (*b"\n\r\x0b\x0c\x1c\x1d\x1e\x85", b"\xe2\x80\xa8", b"\xe2\x80\xa9")
"""What `str.splitlines` takes for the end of a line, as bytes."""
_MAX_HEADER_BYTES = 1 << 16

MAX_COORDINATE = 1e4
"""Of places, metres, and of the numbers of a normal."""
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True, slots=True)
class Scan:
    """A cloud as it was taken.

    Attributes:
        points: [M, 3], metres, in the scan's frame.
        normals: [M, 3], of any length and sign; None: to be estimated.
        movable: [M], whether the policy may act on the point; None: everywhere.
        camera: where the camera stood, if the file says.
    """

    points: Float
    normals: Float | None = None
    movable: NDArray[np.bool_] | None = None
    camera: Vector | None = None


class ScanFrame(StrictModel):
    """How scans of one object lie in the world."""

    up: Vector = (0.0, 0.0, 1.0)
    """Against gravity, of any length."""
    camera: Vector = (0.0, 0.0, 0.0)
    """Where the camera stood, metres."""
    origin: Vector
    """The object's middle, which the camera is taken to look at, metres."""

    @field_validator("up")
    @classmethod
    def _points_somewhere(cls, up: Vector) -> Vector:
        if not 1e-6 < float(np.linalg.norm(up)) < 1e6:
            raise ValueError("needs a direction, such as 0 0 1")
        return up

    @classmethod
    def around(cls, scan: Scan, up: Vector = (0.0, 0.0, 1.0), camera: Vector | None = None) -> "ScanFrame":
        """The frame of a first scan: the object's middle is that of its bounding box, as in training.

        Raises:
            UsageError: `up` is no direction, or a number is not finite or too large.
        """
        low, high = scan.points.min(axis=0), scan.points.max(axis=0)
        origin = tuple(float(value) for value in (low + high) / 2)
        told = {"up": up, "camera": camera or scan.camera or (0.0, 0.0, 0.0), "origin": origin}
        return parse(cls, told, "the frame of the scans")

    @property
    def world_from_scan(self) -> Float:
        """Rotation, [3, 3]; any turn about z will do, since networks forget it."""
        up = np.array(self.up) / np.linalg.norm(self.up)
        aside = np.eye(3)[np.abs(up).argmin()]
        return gripper_rotation(up, aside).T

    @property
    def world_from_camera(self) -> Float:
        """Pose of the camera, [4, 4], looking at the origin as in training.

        Raises:
            UsageError: it stands in the middle of the object.
        """
        place = self.to_world([self.camera])[0]
        distance = float(np.linalg.norm(place))
        if distance < 1e-3:
            raise UsageError("the camera stands in the middle of the cloud; say where it stood in the cloud's frame")
        elevation = np.clip(np.rad2deg(np.arcsin(place[2] / distance)), -89.9, 89.9)
        return camera_pose(float(np.rad2deg(np.arctan2(place[1], place[0]))), float(elevation), distance)

    def to_world(self, points: ArrayLike) -> Float:
        """Points of the scan's frame, [..., 3], in the world."""
        world: Float = (np.asarray(points, dtype=np.float64) - self.origin) @ self.world_from_scan.T
        return world

    def point_to_scan(self, point: Float) -> Float:
        """Points of the world, [..., 3], in the scan's frame."""
        found: Float = point @ self.world_from_scan + self.origin
        return found

    def direction_to_scan(self, direction: Float) -> Float:
        """Directions of the world, [..., 3], in the scan's frame."""
        found: Float = direction @ self.world_from_scan
        return found


def read_scan(path: Path) -> Scan:
    """Read a cloud from a PLY, NPZ or PCD file.

    PLY and PCD: x y z, and, where they are there, normals (nx ny nz, or normal_x ...) and `movable`. NPZ: `points`, and
    optionally `normals`, `movable` and `camera`.

    Raises:
        UsageError: it is no such file, or holds no cloud of finite points in metres.
        StoreError: it is no regular file, or too large.
    """
    return parse_scan(read_scan_file(path), path)


def read_scan_file(path: Path) -> bytes:
    """The bytes of a cloud's file; raises as `read_scan` does."""
    if path.suffix.lower() not in FORMATS:
        raise UsageError(f"{path}: not a kind of cloud that is read; allowed: {', '.join(FORMATS)}")
    if not os.path.exists(path):  # noqa: PTH110 - a name too long for the disk is one that is not there.
        raise UsageError(f"{path}: there is no such file; name a cloud ({', '.join(FORMATS)})")
    return read_bounded(path.resolve(), MAX_SCAN_BYTES)


def parse_scan(data: bytes, path: Path) -> Scan:
    """A cloud from the bytes of its file; raises as `read_scan` does."""
    readers = {".ply": _from_ply, ".npz": _from_npz, ".pcd": read_pcd}
    try:
        columns = readers[path.suffix.lower()](data)
    except UNREADABLE as error:
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise UsageError(f"{path}: not readable as {path.suffix[1:].upper()} ({reason}); export it again") from None
    return checked_scan(
        columns.get("points"), columns.get("normals"), columns.get("movable"), columns.get("camera"), str(path)
    )


def checked_scan(
    points: ArrayLike | None,
    normals: ArrayLike | None = None,
    movable: ArrayLike | None = None,
    camera: ArrayLike | None = None,
    source: str = "the cloud",
) -> Scan:
    """A scan of arrays from anywhere; points that are not finite are left out, as depth cameras mark what they miss.

    Raises:
        UsageError: shapes do not agree, or too few or too many points are left, or they lie too far apart.
    """
    try:
        places = np.asarray(points, dtype=np.float64)
        facing = None if normals is None else np.asarray(normals, dtype=np.float64)
        allowed = None if movable is None else np.asarray(movable).astype(bool)
        stood = None if camera is None else np.asarray(camera, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{source}: holds something that is no number; give arrays of numbers") from None
    if places.ndim != 2 or places.shape[1] != 3:
        raise UsageError(f"{source}: needs points of shape [M, 3]; given {places.shape}")
    for name, value, shape in (("normals", facing, places.shape), ("movable", allowed, places.shape[:1])):
        if value is not None and value.shape != shape:
            raise UsageError(f"{source}: needs {name} of shape {shape}, like its points; given {value.shape}")
    if stood is not None and (stood.shape != (3,) or not (np.abs(stood) < MAX_COORDINATE).all()):
        raise UsageError(f"{source}: needs a camera of three numbers, metres")
    # Not a number compares as false; and what is far beyond any room is as good as infinite.
    finite = (np.abs(places) < MAX_COORDINATE).all(axis=1)
    if facing is not None:
        finite &= (np.abs(facing) < MAX_COORDINATE).all(axis=1)
    count = int(finite.sum())
    if not MIN_POINTS <= count <= MAX_POINTS:
        raise UsageError(f"{source}: needs {MIN_POINTS} to {MAX_POINTS} finite points; given {count}")
    places = places[finite]
    extent = float(np.ptp(places, axis=0).max())
    if not 1e-3 < extent <= MAX_EXTENT_M:
        raise UsageError(
            f"{source}: measures {extent:g}; give one object, cut out of its surroundings, in metres (at most "
            f"{MAX_EXTENT_M:g})"
        )
    return Scan(
        places,
        None if facing is None else facing[finite],
        None if allowed is None else allowed[finite],
        None if stood is None else (float(stood[0]), float(stood[1]), float(stood[2])),
    )


def observation_of(scan: Scan, frame: ScanFrame, seed: int = 0, points: int = POINTS) -> Observation:
    """What a policy is shown of a scan, thinned and rounded as in training.

    Args:
        scan: as it was taken.
        frame: how it lies in the world.
        seed: of what is drawn where there are many points.
        points: N; as many as the policy was trained with.

    Raises:
        UsageError: no point that is kept may be acted upon, or the camera stands in the object.
    """
    world_from_camera, rng = frame.world_from_camera, seeds.generator(seed, "scan")
    kept = furthest_first(scan.points, points, max(CANDIDATES, points), rng)
    places = frame.to_world(scan.points[kept])
    if np.abs(places).max() > 2 * MAX_EXTENT_M:
        raise UsageError("the cloud lies far from the origin of its frame; all scans of a history share one frame")
    if scan.normals is not None:
        normals = scan.normals[kept] @ frame.world_from_scan.T
    else:
        normals = _estimated_normals(frame.to_world(scan.points), places)
    movable = np.ones(len(kept), dtype=bool) if scan.movable is None else scan.movable[kept]
    if not movable.any():
        raise UsageError("the cloud has no movable point; look from another side, or mark the points to act on")
    return Observation(
        points=round_points(places),
        normals=round_normals(_facing(normals, places, world_from_camera[:3, 3])),
        part_ids=movable.astype(np.uint8),
        movable=movable,
        pixels=kept.astype(np.uint32),
        world_from_camera=world_from_camera,
    )


def action_at(observation: Observation, frame: ScanFrame, point: Vector, approach: Vector, forward: Vector) -> Action:
    """The action at the kept point nearest to `point`; all in the scan's frame.

    Raises:
        UsageError: no kept point is near, or the directions are none, or parallel.
    """
    place = frame.to_world([point])[0]
    distances = np.linalg.norm(observation.points - place, axis=1)
    nearest = int(distances.argmin())
    if not distances[nearest] <= MAX_OFF_CLOUD_M:
        raise UsageError(
            f"the point {point} lies {distances[nearest]:.2f} m off the cloud; give it in the cloud's frame, in metres"
        )
    up, ahead = (frame.world_from_scan @ np.array(vector) for vector in (approach, forward))
    if np.linalg.norm(up) < 1e-6 or np.linalg.norm(np.cross(up, ahead)) < 1e-6:
        raise UsageError("an action needs an approach and a forward direction that are not parallel")
    rotation = gripper_rotation(up / np.linalg.norm(up), ahead)
    return Action(nearest, observation.points[nearest].astype(np.float64), rotation)


def _estimated_normals(cloud: Float, points: Float) -> Float:
    """Normals of local planes, [N, 3], of either sign."""
    _, near = cKDTree(cloud).query(points, k=min(_NORMAL_NEIGHBOURS, len(cloud)))
    local = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    normals: Float = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    return normals


def _facing(normals: Float, points: Float, camera: Float) -> Float:
    """Unit normals that face the camera; where a normal is nothing, the way to the camera stands in."""
    to_camera = camera - points
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > 1e-9, normals, to_camera)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    facing: Float = np.where((normals * to_camera).sum(axis=1, keepdims=True) < 0, -normals, normals)
    return facing


def _from_ply(data: bytes) -> dict[str, NDArray[np.generic]]:
    from trimesh.exchange.ply import load_ply

    # Every element that a header names becomes an object of its own, though it has no data.
    if not re.search(rb"\nend_header\s", data[:_MAX_HEADER_BYTES]):
        raise ValueError(f"has no header, or one of more than {_MAX_HEADER_BYTES} bytes")
    # In text every line becomes one, whatever the header announces. Bytes would be lowered otherwise than the text is.
    is_text = "ascii" in data.split(b"\n", 2)[1].decode(errors="replace").lower()
    if is_text and sum(map(data.count, _LINE_ENDS)) - data.count(b"\r\n") > 2 * MAX_POINTS:
        raise ValueError("holds too many lines")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns of words among the numbers; what is wrong shows below.
        loaded = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
    vertex = loaded["metadata"]["_ply_raw"]["vertex"]["data"]
    names = set(vertex.dtype.names if isinstance(vertex, np.ndarray) else vertex)
    found: dict[str, NDArray[np.generic]] = {}
    for name, fields in (("points", ("x", "y", "z")), ("normals", ("nx", "ny", "nz"))):
        if set(fields) <= names:
            found[name] = np.column_stack([np.ravel(vertex[field]) for field in fields])
    if "movable" in names:
        found["movable"] = np.ravel(vertex["movable"])
    return found


def _from_npz(data: bytes) -> dict[str, NDArray[np.generic]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        # What is small in the archive may be huge outside of it.
        if sum(entry.file_size for entry in archive.infolist()) > MAX_SCAN_BYTES:
            raise ValueError(f"unpacks to more than {MAX_SCAN_BYTES} bytes")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in ("points", "normals", "movable", "camera") if name in arrays.files}
