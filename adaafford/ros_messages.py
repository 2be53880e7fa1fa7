"""Messages of ROS 2 as clouds and depth images, and proposals as poses: pure functions, without a package of ROS.

A message is any object with the fields of its definition, whether rclpy or a reader of recordings made it. Messages are
untrusted. Every function raises `ValueError` with a reason that a user understands.
"""

import struct
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adaafford.columns import Columns, cloud_of, shown
from adaafford.depth_images import CAMERA_UP, Lens, read_png, read_rvl
from adaafford.scans import MAX_ROWS
from shared.config import parse
from shared.geometry import gripper_rotation
from shared.types import Float

MAX_APART_S = 0.5
"""Between a scan and a transformation that is not static."""
CLOUD, CAMERA_INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_DEPTH_TYPES = {"16UC1": "u2", "32FC1": "f4"}
"""By the encoding of depth images (REP 118): millimetres, and metres."""
_DEPTH_TRANSPORT = "compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")
"""What it puts before the image: its kind, and two numbers of which metres are made."""
_SILENT = np.errstate(invalid="ignore", over="ignore")
"""NumPy warns where it meets certain bits of NaN, and where a number becomes infinite."""
_POINT_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Of the fields of a cloud, in the order of their numbers."""

Data: TypeAlias = "bytes | array[int] | NDArray[np.uint8]"
"""Bytes, as rclpy and readers of recordings have them."""


class Stamp(Protocol):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class PointField(Protocol):
    """sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2(Protocol):
    """sensor_msgs/PointCloud2."""

    header: Header
    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Data


class Image(Protocol):
    """sensor_msgs/Image."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Data


class CompressedImage(Protocol):
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: Data


@dataclass(frozen=True, slots=True)
class DepthImage:
    """A depth image as `Image` is, unpacked.

    Attributes:
        header: of the packed one.
        depths: [H, W], whole numbers in millimetres, or floating-point numbers in metres.
    """

    header: Header
    depths: NDArray[np.generic]

    @property
    def height(self) -> int:
        """Rows."""
        return len(self.depths)

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.depths.shape[1])


class CameraInfo(Protocol):
    """sensor_msgs/CameraInfo."""

    height: int
    width: int
    d: Sequence[float]
    k: Sequence[float]
    p: Sequence[float]


class Vector3(Protocol):
    """geometry_msgs/Vector3."""

    x: float
    y: float
    z: float


class Quaternion(Vector3, Protocol):
    """geometry_msgs/Quaternion."""

    w: float


class Transform(Protocol):
    """geometry_msgs/Transform."""

    translation: Vector3
    rotation: Quaternion


class TransformStamped(Protocol):
    """geometry_msgs/TransformStamped."""

    header: Header
    child_frame_id: str
    transform: Transform


def seconds(stamp: Stamp) -> float:
    """A stamp in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


@_SILENT
def cloud_scan(message: PointCloud2, frame: str | None = None, pose: Float | None = None) -> Columns:
    """The points of a cloud, with its normals and marks where it has them, and what is known of its camera.

    Args:
        message: the cloud.
        frame: name of the frame that the points are wanted in; None: their own.
        pose: of their own frame in the wanted one, [4, 4].
    """
    fields, step = list(message.fields), message.point_step
    buffer = np.frombuffer(message.data, np.uint8)
    _check_layout(message.height, message.width, step, message.row_step, len(buffer))

    def column(place: int) -> NDArray[np.generic]:
        field = fields[place]
        name = shown([field.name])
        if not 0 < field.datatype < len(_POINT_TYPES) or field.count > 1:
            raise ValueError(f"its field '{name}' has datatype {field.datatype} and count {field.count}")
        dtype = np.dtype((">" if message.is_bigendian else "<") + _POINT_TYPES[field.datatype])
        if not 0 <= field.offset <= step - dtype.itemsize:
            raise ValueError(f"its field '{name}' at byte {field.offset} is outside of a point of {step} bytes")
        return _cells(buffer, message.height, message.width, dtype, field.offset, (message.row_step, step)).ravel()

    columns = cloud_of([field.name for field in fields], column)
    return _placed(columns, frame or message.header.frame_id, pose)


@_SILENT
def depth_scan(
    message: Image | DepthImage, info: CameraInfo, rectified: bool, frame: str | None = None, pose: Float | None = None
) -> Columns:
    """The places that a depth image shows, row by row, and what is known of its camera.

    Args:
        message: the image.
        info: of its camera.
        rectified: whether the distortion of the lens was taken out of the image.
        frame: as in `cloud_scan`.
        pose: likewise.
    """
    if isinstance(message, DepthImage):
        depths = message.depths
    elif message.encoding in _DEPTH_TYPES:
        dtype = np.dtype((">" if message.is_bigendian else "<") + _DEPTH_TYPES[message.encoding])
        buffer = np.frombuffer(message.data, np.uint8)
        _check_layout(message.height, message.width, dtype.itemsize, message.step, len(buffer))
        depths = _cells(buffer, message.height, message.width, dtype, 0, (message.step, dtype.itemsize))
    else:
        raise ValueError(f"its encoding is '{shown([message.encoding])}'; depths are {' or '.join(_DEPTH_TYPES)}")
    # The frame of an image is optical by definition, whatever its name.
    return _placed({"points": lens_of(info, message, rectified).points(depths)}, frame or "_optical", pose)


def is_depth(message: Image | CompressedImage) -> bool:
    """Whether an image holds depths."""
    form: str | None = getattr(message, "format", None)
    if form is None:
        return message.encoding in _DEPTH_TYPES  # type: ignore[union-attr]
    return (
        _DEPTH_TRANSPORT in form or form.partition(";")[0].strip() in _DEPTH_TYPES or _is_grey_png(message.data, form)
    )


def unpacked_depth(message: CompressedImage) -> DepthImage:
    """A depth image that was sent as a PNG or by RVL.

    The transport `compressedDepth` puts 12 bytes before it, and sends metres as 16-bit numbers a / depth + b, of which
    these bytes have a and b. `compressed` sends the PNG alone.
    """
    encoding, _, packing = message.format.partition(";")
    data, encoding = bytes(message.data), encoding.strip()
    if not is_depth(message):
        raise ValueError(
            f"its format is '{shown([message.format])}'; depths are PNG or RVL of {' or '.join(_DEPTH_TYPES)}"
        )
    inverse = None
    if _DEPTH_TRANSPORT in message.format:
        if len(data) < _DEPTH_HEADER.size:
            raise ValueError(f"its {len(data)} bytes are fewer than its header")
        _, *inverse = _DEPTH_HEADER.unpack_from(data)
        data = data[_DEPTH_HEADER.size :]
    depths: NDArray[np.generic] = read_rvl(data) if "rvl" in packing else read_png(data)
    if encoding == "32FC1":
        if inverse is None:
            raise ValueError("its metres were sent as a plain image, which rounds them; record compressedDepth")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depths = np.where(depths == 0, np.nan, inverse[0] / (depths.astype(np.float64) - inverse[1]))
    return DepthImage(message.header, depths)


def _is_grey_png(data: Data, form: str) -> bool:
    """Whether an image whose format names no encoding is a PNG of 16 bits of grey."""
    head = bytes(data[:26])
    return form.strip().lower() in ("png", "") and head.startswith(b"\x89PNG") and head[24:26] == b"\x10\0"


def lens_of(info: CameraInfo, image: Image | DepthImage, rectified: bool) -> Lens:
    """The camera of an image; arguments as in `depth_scan`."""
    if (info.width, info.height) != (image.width, image.height):
        raise ValueError(
            f"its camera info is of {info.width} x {info.height} pixels, the image of {image.width} x {image.height}"
        )
    if any(info.d) and not rectified:
        raise ValueError("its lens has distortion; record the rectified image, whose topic ends with image_rect")
    numbers = info.p if any(info.d) else info.k
    matrix = np.asarray(numbers, np.float64).reshape(3, -1)
    return parse(Lens, {"intrinsics": (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])}, "the camera info")


def sensor_pose(
    fixed: Iterable[TransformStamped], moving: Iterable[TransformStamped], wanted: str, sensor: str, at: float
) -> Float:
    """The pose of a sensor's frame in another frame, [4, 4].

    Args:
        fixed: the transformations of /tf_static.
        moving: those of /tf; of each frame the one nearest in time counts, without interpolation.
        wanted: name of the other frame.
        sensor: name of the sensor's frame.
        at: the time of the scan, s.
    """
    nearest: dict[str, tuple[float, TransformStamped]] = {}
    for each in moving:
        name, apart = _name(each.child_frame_id), abs(seconds(each.header.stamp) - at)
        if name not in nearest or apart < nearest[name][0]:
            nearest[name] = apart, each
    for each in fixed:
        nearest[_name(each.child_frame_id)] = 0.0, each

    def from_root(frame: str) -> tuple[str, Float]:
        """The root above a frame, and the frame's pose in it."""
        pose: Float = np.eye(4)
        for _ in range(len(nearest) + 1):
            if frame not in nearest:
                return frame, pose
            apart, above = nearest[frame]
            if apart > MAX_APART_S:
                raise ValueError(
                    f"the transformation of '{shown([frame])}' nearest to the scan is {apart:.2f} s away, and "
                    f"{MAX_APART_S} s are allowed"
                )
            pose, frame = _matrix(above.transform) @ pose, _name(above.header.frame_id)
        raise ValueError(f"its transformations go round in a circle at '{shown([frame])}'")

    (root, pose), (other, base) = from_root(_name(sensor)), from_root(_name(wanted))
    if root != other:
        frames = {_name(each.header.frame_id) for _, each in nearest.values()} | set(nearest)
        raise ValueError(
            f"its transformations do not connect '{shown([sensor])}' with '{shown([wanted])}'; frames: "
            f"{shown(sorted(frames))}"
        )
    found: Float = np.linalg.inv(base) @ pose
    return found


def hand_orientation(approach: Sequence[float], forward: Sequence[float]) -> tuple[float, float, float, float]:
    """The orientation of the hand as a quaternion x, y, z, w: its z axis is the approach direction, its x axis forward.

    Args:
        approach: of a proposal, a unit vector.
        forward: likewise.
    """
    x, y, z, w = Rotation.from_matrix(gripper_rotation(np.array(approach), np.array(forward))).as_quat().tolist()
    return x, y, z, w


def _placed(columns: Columns, frame: str, pose: Float | None) -> Columns:
    """A cloud in a frame, with the camera if it is known, and with up if the frame's name says it (REP 103)."""
    found = dict(columns)
    if pose is not None:
        points = np.asarray(columns["points"], np.float64)
        # Points that were not measured stay 0 0 0.
        found["points"] = (points @ pose[:3, :3].T + pose[:3, 3]) * points.any(axis=1, keepdims=True)
        if "normals" in columns:
            found["normals"] = np.asarray(columns["normals"], np.float64) @ pose[:3, :3].T
        found["camera"] = pose[:3, 3]
    if frame.endswith(("_optical", "_optical_frame")):
        found["up"] = np.array(CAMERA_UP)
    return found


def _check_layout(height: int, width: int, cell: int, row: int, held: int) -> None:
    """Check that rows of cells, of so many bytes, are what was sent."""
    if not 0 < height * width <= MAX_ROWS:
        raise ValueError(f"has {width} x {height} points; allowed are 1 to {MAX_ROWS}")
    if cell < 1 or (height > 1 and row < width * cell) or (height - 1) * row + width * cell > held:
        raise ValueError(
            f"announces {height} rows of {row} bytes with {width} points of {cell} bytes, and holds {held} bytes"
        )


def _cells(
    buffer: NDArray[np.uint8], height: int, width: int, dtype: np.dtype[np.generic], offset: int, steps: tuple[int, int]
) -> NDArray[np.generic]:
    """One number of each cell, [H, W]."""
    return np.ndarray((height, width), dtype, buffer, offset, steps).astype(dtype.newbyteorder("="))


def _name(frame: str) -> str:
    """A frame's name as tf2 has it; ROS 1 had a slash before it."""
    return frame.removeprefix("/")


def _matrix(transform: Transform) -> Float:
    """[4, 4]."""
    place, turn = transform.translation, transform.rotation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not 0.9 < float(np.linalg.norm(quaternion)) < 1.1:
        raise ValueError("a transformation has a quaternion whose length is not 1")
    pose: Float = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), (place.x, place.y, place.z)
    return pose
