"""Scans: point clouds of a real object from a file or an array, converted to observations.

A scan has a frame of its own, in metres: a camera's, or a robot's. `ScanFrame` says where that frame's *up* points
(against gravity), where the camera stood in it, and which of its points is the object's middle; the world frame of
`shared.types` has that point as its origin and z up. All scans of one object share one frame.

Files are hostile until checked: bounded in size, finite, never pickled.

Shapes: M points of a scan, N points that are kept of it.
"""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator
from scipy.spatial import cKDTree

from adaafford.columns import MAX_SCAN_BYTES, shown, without_mark
from adaafford.npz import read_npz
from adaafford.pcd import read_pcd
from adaafford.ply import read_ply
from adaafford.recordings import WHOLE, Selection, is_recording, take_scan
from shared import seeds
from shared.config import CameraConfig, StrictModel, parse
from shared.errors import UsageError
from shared.geometry import camera_pose, estimated_normals, facing, furthest_first, gripper_rotation
from shared.io.files import read_bounded
from shared.types import Action, Float, Float32, Observation, round_normals, round_points

MIN_POINTS, MAX_POINTS = 64, 1920 * 1080
MAX_ROWS = 1 << 23
"""Of a cloud with the points that were not measured: an image in 4K."""
POINTS, CANDIDATES = CameraConfig().points, CameraConfig().candidates
"""Kept of a scan, and drawn before that, as in training unless that was told otherwise."""
MAX_EXTENT_M, MAX_ROOM_M = 10.0, 50.0
"""No object that a hand opens, and no raw scan of one, is larger; clouds in millimetres are."""
MAX_OFF_CLOUD_M = 0.05
"""How far from the kept points an action's point may lie; they are a few centimetres apart at the most."""
READERS = {".ply": read_ply, ".npz": read_npz, ".pcd": read_pcd}
DEPTH_SUFFIXES = (".png", ".npy", ".npz")
"""Of depth images (see `adaafford.depth_images`)."""
_MIN_NORMAL = 1e-9
_MISSING_SHARE = 0.1
"""What a depth camera misses without anybody being told."""
_DENSE_NEIGHBOUR, _DENSE_M, _DENSE_SAMPLE = 4, 0.02, 256
"""A scan is dense if half of some points have so many others within so many metres."""
_STEEP_DEG = 80.0
"""Training saw objects from 30 to 60 deg above."""
_OFF_LEVEL_DEG = 30.0
"""A camera sees what lies within 60 deg of the axis that it looks along."""

_SILENT = np.errstate(invalid="ignore", over="ignore")
"""NumPy warns where it meets certain bits of NaN, and where a number is infinite as a double."""

MAX_COORDINATE = 1e4
"""Of places, metres, and of the numbers of a normal."""
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
DEFAULT_UP: Vector = (0.0, 0.0, 1.0)
"""Of the frame of a robot's base."""


@dataclass(frozen=True, slots=True)
class Scan:
    """A scanned cloud without unmeasured points.

    Attributes:
        points: [M, 3], metres, in the scan's frame.
        normals: [M, 3], of any length and sign; 0 0 0 for a normal that is estimated; None: all are estimated.
        movable: [M], whether the policy may act on the point; None: everywhere.
        camera: camera position, if the file has it.
        up: against gravity, if the file or the kind of the camera says it.
        rows: [M], where the points stand in the file or array; None: there are no others.
        missing: how many points were not measured.
    """

    points: Float
    normals: Float | None = None
    movable: NDArray[np.bool_] | None = None
    camera: Vector | None = None
    up: Vector | None = None
    rows: NDArray[np.int64] | None = None
    missing: int = 0


class ScanFrame(StrictModel):
    """The transformation between the scans of one object and the world."""

    up: Vector = DEFAULT_UP
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
    def around(cls, scan: Scan, up: Vector | None = None, camera: Vector | None = None) -> "ScanFrame":
        """The frame of a first scan: the object's middle is that of its bounding box, as in training.

        Args:
            scan: the first of an object.
            up: against gravity; default: the scan's, otherwise 0 0 1.
            camera: its position; default: the scan's, otherwise 0 0 0.

        Raises:
            UsageError: `up` is no direction, or a number is not finite or too large.
        """
        low, high = scan.points.min(axis=0), scan.points.max(axis=0)
        origin = tuple(float(value) for value in (low + high) / 2)
        up, camera = up or scan.up or DEFAULT_UP, camera or scan.camera or (0.0, 0.0, 0.0)
        told = {"up": up, "camera": camera, "origin": origin}
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
            raise UsageError("the camera is in the middle of the cloud; give its position in the cloud's frame")
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


def read_scan(path: Path, selection: Selection = WHOLE) -> Scan:
    """Read a cloud from a PLY, NPZ or PCD file, or a scan out of a recording of ROS 2.

    PLY and PCD: x y z, and optionally normals (nx ny nz or normal_x ...) and `movable`. NPZ: `points`, and
    optionally `normals`, `movable`, `camera` and `up`. Points that are 0 0 0 or not finite were not measured: they are
    left out. Normals of this kind are estimated.

    Args:
        path: of the file, or of the folder of a recording.
        selection: which scan of a recording.

    Raises:
        UsageError: the file has another format, or no cloud of finite points in metres.
        StoreError: the file cannot be read, or is too large.
    """
    if is_recording(path):
        return parse_scan(take_scan(path, selection)[0], path, kind=".npz")
    if selection != WHOLE:
        raise UsageError(f"{path}: is no recording; leave out --topic, --at and --frame")
    return parse_scan(read_scan_file(path), path)


def read_scan_file(path: Path) -> bytes:
    """The bytes of a cloud's file; raises as `read_scan` does."""
    if path.suffix.lower() not in {*READERS, *DEPTH_SUFFIXES}:
        raise UsageError(f"{path}: not a kind of cloud that is read; allowed: {', '.join(READERS)}")
    if not os.path.exists(path):  # noqa: PTH110 - a name too long for the disk is one that is not there.
        raise UsageError(f"{path}: there is no such file; name a cloud ({', '.join(READERS)})")
    if not path.is_file():
        raise UsageError(f"{path}: a folder, pipe or device, and no file; name a cloud ({', '.join(READERS)})")
    return read_bounded(path.resolve(), MAX_SCAN_BYTES)


@_SILENT
def parse_scan(data: bytes, path: Path, *, raw: bool = False, kind: str | None = None) -> Scan:
    """A cloud from the bytes of its file; raises as `read_scan` does.

    Args:
        data: of the file.
        path: its name.
        raw: whether the surroundings of the object are in it.
        kind: of `READERS`; None: as the name ends.
    """
    kind = kind or path.suffix.lower()
    if not data:
        raise UsageError(f"{path}: is empty; export it again")
    if kind not in READERS:
        raise UsageError(
            f"{path}: a depth image needs the camera's --intrinsics FX FY CX CY; clouds are {', '.join(READERS)}"
        )
    try:
        columns = READERS[kind](without_mark(data))
    except ValueError as error:
        raise UsageError(f"{path}: not readable as {kind[1:].upper()} ({error}); export it again") from None
    return checked_scan(
        columns.get("points"),
        columns.get("normals"),
        columns.get("movable"),
        columns.get("camera"),
        str(path),
        raw=raw,
        up=columns.get("up"),
    )


@_SILENT
def checked_scan(
    points: ArrayLike | None,
    normals: ArrayLike | None = None,
    movable: ArrayLike | None = None,
    camera: ArrayLike | None = None,
    source: str = "the cloud",
    *,
    raw: bool = False,
    up: ArrayLike | None = None,
) -> Scan:
    """A scan from untrusted arrays.

    Args:
        points: [M, 3]; those that are 0 0 0 or not finite are left out, as depth cameras mark what they miss.
        normals: [M, 3]; those that are 0 0 0 or not finite are to be estimated.
        movable: [M], of 0 and 1, or false and true.
        camera: [3].
        source: its name in messages.
        raw: whether the surroundings of the object are in it.
        up: [3], against gravity.

    Raises:
        UsageError: shapes do not agree, a value is not allowed, there are too few or too many measured points, or they
            are too far apart.
    """
    places = _array(points, "points", source)
    facing = None if normals is None else _array(normals, "normals", source)
    allowed = None if movable is None else _array(movable, "movable", source)
    stood, against = (_vector(value, name, source) for name, value in (("a camera", camera), ("a direction up", up)))
    if places.ndim != 2 or places.shape[1] != 3:
        raise UsageError(f"{source}: needs points of shape [M, 3]; given {places.shape}")
    for name, value, shape in (("normals", facing, places.shape), ("movable", allowed, places.shape[:1])):
        if value is not None and value.shape != shape:
            raise UsageError(f"{source}: needs {name} of shape {shape}, like its points; given {value.shape}")
    if len(places) > MAX_ROWS:
        raise UsageError(f"{source}: holds {len(places)} points; give at most {MAX_ROWS}, measured or not")
    rows = np.flatnonzero(_reasonable(places) & places.any(axis=1))
    if not MIN_POINTS <= len(rows) <= MAX_POINTS:
        raise UsageError(
            f"{source}: needs {MIN_POINTS} to {MAX_POINTS} finite points other than 0 0 0; given {len(rows)} of "
            f"{len(places)}"
        )
    measured = places[rows].astype(np.float64)
    extent = float(np.ptp(measured, axis=0).max())
    most, what = (MAX_ROOM_M, "a scan") if raw else (MAX_EXTENT_M, "one object, cut out of its surroundings,")
    if not 1e-3 < extent <= most:
        raise UsageError(f"{source}: measures {extent:g}; give {what} in metres (at most {most:g})")
    return Scan(
        measured,
        None if facing is None else _known_normals(facing[rows]),
        None if allowed is None else _mask(allowed[rows], source),
        stood,
        against,
        None if len(rows) == len(places) else rows,
        len(places) - len(rows),
    )


def missing_points(scan: Scan) -> str | None:
    """A warning if a large share of a scan was not measured."""
    total = len(scan.points) + scan.missing
    if scan.missing <= _MISSING_SHARE * total:
        return None
    return f"{scan.missing} of {total} points were not measured (0 0 0 or not finite) and are left out"


def doubtful_up(scan: Scan, frame: ScanFrame) -> str | None:
    """A warning if `frame.up` is probably wrong, for example 0 0 1 in the frame of a camera; otherwise None.

    Call it only if the user did not give `up`, because a camera may look straight down.
    """
    place = frame.to_world([frame.camera])[0]
    elevation = float(np.rad2deg(np.arctan2(place[2], np.hypot(place[0], place[1]))))
    sight = frame.origin[2] - frame.camera[2]
    along_z = bool((scan.points[:, 2] * sight > 0).all())
    camera_frame = frame.camera == (0.0, 0.0, 0.0) and frame.up == (0.0, 0.0, 1.0) and along_z
    if abs(elevation) <= (_OFF_LEVEL_DEG if camera_frame else _STEEP_DEG):
        return None
    side = "above" if elevation > 0 else "below"
    up = " ".join(f"{value:g}" for value in frame.up)
    axes, probable = ("y down, z forward", "0 -1 0") if sight > 0 else ("y up, z backward", "0 1 0")
    return (
        f"with up {up} the camera is {abs(elevation):.0f} deg {side} the object; in a camera's own frame (x right, "
        f"{axes}) up is probably {probable}"
    )


def observation_of(scan: Scan, frame: ScanFrame, seed: int = 0, points: int = POINTS) -> Observation:
    """The observation of a scan, subsampled and rounded as in training.

    Args:
        scan: the scan.
        frame: its transformation to the world.
        seed: of the random subsampling.
        points: N; as many as the policy was trained with.

    Raises:
        UsageError: no point is kept, or none that may be acted upon, or the camera stands in the object.
    """
    if points < 1:
        raise UsageError(f"points={points}: give how many points of the scan are kept, as many as in training")
    world_from_camera, rng = frame.world_from_camera, seeds.generator(seed, "scan")
    kept = furthest_first(scan.points, points, max(CANDIDATES, points), rng)
    places = frame.to_world(scan.points[kept])
    if np.abs(places).max() > 2 * MAX_EXTENT_M:
        raise UsageError("the cloud is far from the origin of its frame; all scans of a history share one frame")
    normals = np.zeros_like(places) if scan.normals is None else scan.normals[kept] @ frame.world_from_scan.T
    unknown = np.linalg.norm(normals, axis=1) <= _MIN_NORMAL
    if unknown.any():
        normals[unknown] = estimated_normals(frame.to_world(scan.points), places[unknown])
    movable = np.ones(len(kept), dtype=bool) if scan.movable is None else scan.movable[kept]
    if not movable.any():
        raise UsageError("the cloud has no movable point; look from another side, or mark the points to act on")
    return Observation(
        points=round_points(places),
        normals=round_normals(facing(normals, places, world_from_camera[:3, 3])),
        part_ids=movable.astype(np.uint8),
        movable=movable,
        pixels=(kept if scan.rows is None else scan.rows[kept]).astype(np.uint32),
        world_from_camera=world_from_camera,
        dense=ScannedSurface(scan, frame),
    )


def npz_of(scan: Scan) -> bytes:
    """A scan as NPZ. Points that were not measured are 0 0 0, so that all others keep their rows."""
    rows = np.arange(len(scan.points)) if scan.rows is None else scan.rows
    total = len(scan.points) + scan.missing

    def in_rows(values: NDArray[np.generic]) -> NDArray[np.generic]:
        every = np.zeros((total, *values.shape[1:]), values.dtype)
        every[rows] = values
        return every

    arrays = {"points": in_rows(_narrow(scan.points))}
    if scan.normals is not None:
        arrays["normals"] = in_rows(_narrow(scan.normals))
    if scan.movable is not None:
        arrays["movable"] = in_rows(scan.movable)
    for name, vector in (("camera", scan.camera), ("up", scan.up)):
        if vector is not None:
            arrays[name] = np.array(vector)
    held = io.BytesIO()
    np.savez_compressed(held, allow_pickle=False, **arrays)
    return held.getvalue()


@dataclass(frozen=True, slots=True)
class ScannedSurface:
    """A scan before it was thinned; implements `shared.types.DenseGeometry`.

    Attributes:
        scan: as it was taken.
        frame: how it lies in the world.
    """

    scan: Scan
    frame: ScanFrame

    def points(self) -> Float32:
        """All points of the scan, [M, 3], world frame, rounded as clouds are.

        Raises:
            UsageError: they are too far apart to show what lies between fingers.
        """
        points = self.scan.points
        asked = points[np.linspace(0, len(points) - 1, min(_DENSE_SAMPLE, len(points))).astype(int)]
        # The nearest point to each is itself.
        apart = float(np.median(cKDTree(points).query(asked, k=[_DENSE_NEIGHBOUR + 1])[0]))
        if not apart <= _DENSE_M:
            raise UsageError(
                f"the policy uses the surface between the fingers, and the points are {apart:.3f} m apart; "
                "give the scan before it is thinned, with a point every centimetre or closer, or take a policy that "
                "does not use it; names of such bundled policies end in -sparse"
            )
        return round_points(self.frame.to_world(points))


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


def _array(given: ArrayLike | None, name: str, source: str) -> NDArray[np.generic]:
    """An array of numbers."""
    try:
        array = np.asarray(given)
    except ValueError:
        raise UsageError(f"{source}: needs {name} of numbers; given rows of several lengths") from None
    if array.dtype.kind not in "biuf":
        raise UsageError(f"{source}: needs {name} of numbers; given {shown([str(array.dtype)])}")
    return array


def _vector(given: ArrayLike | None, name: str, source: str) -> Vector | None:
    """Three numbers, if they are given."""
    if given is None:
        return None
    vector = _array(given, name, source)
    if vector.shape != (3,) or not _reasonable(vector[None])[0]:
        raise UsageError(f"{source}: needs {name} of three numbers")
    return float(vector[0]), float(vector[1]), float(vector[2])


def _reasonable(vectors: NDArray[np.generic]) -> NDArray[np.bool_]:
    """[M], whether a vector's numbers are finite; what lies far beyond any room is as good as infinite."""
    found = np.ones(len(vectors), dtype=bool)
    for column in vectors.T:
        found &= (column > -MAX_COORDINATE) & (column < MAX_COORDINATE)
    return found


def _known_normals(normals: NDArray[np.generic]) -> Float | None:
    """Normals, [M, 3], with 0 0 0 for each that is not finite; None where nothing else is left."""
    known = np.where(_reasonable(normals)[:, None], normals, 0).astype(np.float64)
    return known if (np.linalg.norm(known, axis=1) > _MIN_NORMAL).any() else None


def _mask(values: NDArray[np.generic], source: str) -> NDArray[np.bool_]:
    """[M], of 0 and 1 as any kind of number."""
    wrong = values[(values != 0) & (values != 1)]
    if len(wrong):
        raise UsageError(
            f"{source}: movable holds {float(wrong[0]):g}; allowed are 0, 1, false and true; write 1 for the points to "
            "act on and 0 for all others"
        )
    return values.astype(bool)


def _narrow(values: Float) -> NDArray[np.generic]:
    """The same numbers in single precision where that loses nothing."""
    short = values.astype(np.float32)
    return short if (short == values).all() else values
