"""Depth images of a calibrated camera without distortion, as scans: PNG of 16 bits in millimetres, or NPY and NPZ.

Arrays of floating-point numbers are in metres, and of whole numbers in millimetres. Files are hostile until checked.
"""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from adaafford.npz import read_npy, read_npz
from adaafford.scans import DEPTH_SUFFIXES, MAX_COORDINATE, MAX_ROWS, Coordinate, Scan, Vector, checked_scan
from shared.config import StrictModel
from shared.errors import UsageError
from shared.types import Float

CAMERA_UP: Vector = (0.0, -1.0, 0.0)
"""Against gravity in the frame of a level camera: x right, y down, z forward."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAX_CHUNKS = 1 << 16
_MOST_NIBBLES = 10
"""Of a number of 32 bits in RVL."""


class Lens(StrictModel):
    """How a depth camera maps places to pixels, and where it stands.

    Attributes:
        intrinsics: fx, fy, cx, cy, pixels; the middle of the first pixel is 0, 0.
        pose: frame of the scans from camera (x right, y down, z forward): its position x, y, z, m, and its rotation as
            a quaternion x, y, z, w; None: scans are in the camera's own frame.
    """

    intrinsics: tuple[float, float, float, float]
    pose: tuple[Coordinate, Coordinate, Coordinate, float, float, float, float] | None = Field(
        None, exclude_if=lambda pose: pose is None
    )

    @field_validator("intrinsics")
    @classmethod
    def _focal(cls, intrinsics: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        if not (min(intrinsics[:2]) > 0 and max(abs(value) for value in intrinsics) <= MAX_COORDINATE):
            raise ValueError(f"needs fx, fy, cx and cy in pixels, such as 600 600 320 240; given {intrinsics}")
        return intrinsics

    @field_validator("pose")
    @classmethod
    def _rotation(cls, pose: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if pose is not None and not 0.9 < float(np.linalg.norm(pose[3:])) < 1.1:
            raise ValueError("needs x y z in metres and a quaternion x y z w of length 1")
        return pose

    @property
    def up(self) -> Vector | None:
        """Against gravity, where the camera's own frame suggests it."""
        return CAMERA_UP if self.pose is None else None

    def points(self, image: NDArray[np.generic]) -> Float:
        """The places that a depth image shows, [H * W, 3], row by row; 0 0 0 where nothing was measured.

        Args:
            image: [H, W], along the optical axis: floating-point numbers are metres, whole numbers millimetres.
        """
        fx, fy, cx, cy = self.intrinsics
        with np.errstate(invalid="ignore", over="ignore"):
            depths = image.astype(np.float64) * (1.0 if image.dtype.kind == "f" else 0.001)
            depths[~((depths > 0) & (depths < MAX_COORDINATE))] = 0.0
        rows, columns = np.indices(depths.shape)
        places = np.stack([(columns - cx) / fx * depths, (rows - cy) / fy * depths, depths], axis=-1).reshape(-1, 3)
        measured = depths.ravel() > 0
        if self.pose is not None:
            places = Rotation.from_quat(self.pose[3:]).apply(places) + np.array(self.pose[:3])
        places[~measured] = 0.0
        return places

    @property
    def camera(self) -> Vector:
        """Its position, in the frame of the scans."""
        return (0.0, 0.0, 0.0) if self.pose is None else self.pose[:3]


def parse_depth(data: bytes, path: Path, lens: Lens, *, raw: bool) -> Scan:
    """A scan from the bytes of a depth image.

    Args:
        data: of the file.
        path: its name, whose suffix says what it is.
        lens: of the camera.
        raw: whether the surroundings of the object are in it.

    Raises:
        UsageError: it is no depth image, or too large, or shows too little.
    """
    try:
        depths = _READERS[path.suffix.lower()](data)
        if depths.ndim != 2 or depths.size > MAX_ROWS:
            raise ValueError(f"has the shape {depths.shape}; needs rows by columns, of at most {MAX_ROWS} pixels")
    except KeyError:
        raise UsageError(f"{path}: --intrinsics is for depth images ({', '.join(DEPTH_SUFFIXES)})") from None
    except ValueError as error:
        raise UsageError(f"{path}: not readable as a depth image ({error}); export it again") from None
    return checked_scan(lens.points(depths), camera=lens.camera, source=str(path), raw=raw, up=lens.up)


def read_png(data: bytes) -> NDArray[np.generic]:
    """The grey values of a PNG of 16 bits, [H, W].

    Raises:
        ValueError: it is something else, or damaged.
    """
    if not data.startswith(_SIGNATURE):
        raise ValueError("is no PNG")
    header, packed, place = b"", [], len(_SIGNATURE)
    for _ in range(_MAX_CHUNKS):
        if place + 12 > len(data):
            raise ValueError("is cut off")
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        content, check = data[place + 8 : place + 8 + size], data[place + 8 + size : place + 12 + size]
        if len(check) < 4 or struct.unpack(">I", check)[0] != zlib.crc32(kind + content):
            raise ValueError("is damaged or cut off")
        if kind == b"IHDR":
            header = content
        elif kind == b"IDAT":
            packed.append(content)
        elif kind == b"IEND":
            break
        place += 12 + size
    if len(header) != 13:
        raise ValueError("has no header")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    if (depth, colour, interlaced) != (16, 0, 0):
        raise ValueError("needs 16 bits of grey, not interlaced; colours or 8 bits are no depths")
    if not 0 < width * height <= MAX_ROWS:
        raise ValueError(f"has {width} x {height} pixels; allowed are {MAX_ROWS}")
    wanted = height * (1 + 2 * width)
    try:
        rows = zlib.decompressobj().decompress(b"".join(packed), wanted)
    except zlib.error:
        raise ValueError("is damaged") from None
    if len(rows) != wanted:
        raise ValueError("holds fewer pixels than its header says")
    lines = np.frombuffer(rows, np.uint8).reshape(height, 1 + 2 * width)
    return _unfiltered(lines[:, 0], lines[:, 1:]).view(">u2")


def read_rvl(data: bytes) -> NDArray[np.uint16]:
    """Depths that were compressed by RVL (Wilson 2017), behind their width and height, [H, W].

    Of each four bits, three are of a number, the lowest first, and the fourth says that more follow. Counts of zeros
    and of other depths alternate; the other depths follow, each as the difference to the one before.

    Raises:
        ValueError: it is damaged, or too large.
    """
    if len(data) < 8:
        raise ValueError("is cut off")
    width, height = struct.unpack_from("<ii", data)
    if min(width, height) < 1 or width * height > MAX_ROWS:
        raise ValueError(f"has {width} x {height} pixels; allowed are {MAX_ROWS}")
    words = np.frombuffer(data, "<u4", (len(data) - 8) // 4, 8)
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    starts = np.concatenate([[0], ends + 1])[: len(ends)]
    lengths = ends - starts + 1
    if len(ends) == 0 or lengths.max() > _MOST_NIBBLES:
        raise ValueError("is damaged")
    places = np.arange(lengths.sum()) - np.repeat(starts, lengths)
    numbers = np.add.reduceat((nibbles[: len(places)] & 7) << (3 * places), starts)
    measured, is_depth = np.zeros(width * height, bool), np.zeros(len(numbers), bool)
    pixel = place = 0
    while pixel < len(measured):
        if place + 2 > len(numbers):
            raise ValueError("is cut off")
        zeros, others = numbers[place : place + 2].tolist()
        pixel, place = pixel + zeros, place + 2
        if pixel + others > len(measured) or place + others > len(numbers) or not zeros + others:
            raise ValueError("is damaged or cut off")
        measured[pixel : pixel + others], is_depth[place : place + others] = True, True
        pixel, place = pixel + others, place + others
    told = numbers[is_depth]
    depths = np.zeros(width * height, np.uint16)
    depths[measured] = np.cumsum((told >> 1) ^ -(told & 1)).astype(np.uint16)
    return depths.reshape(height, width)


def _unfiltered(filters: NDArray[np.uint8], lines: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The bytes of an image, [H, 2 * W], whose lines were filtered as PNG does, with two bytes a pixel."""
    image = np.zeros((len(lines) + 1, lines.shape[1]), np.uint8)
    for row, (kind, line) in enumerate(zip(filters.tolist(), lines, strict=True), start=1):
        above = image[row - 1]
        if kind == 0:
            image[row] = line
        elif kind == 1:
            image[row] = np.cumsum(line.reshape(-1, 2), axis=0, dtype=np.uint8).ravel()
        elif kind == 2:
            image[row] = line + above
        elif kind in (3, 4):
            image[row] = np.frombuffer(_by_both(kind, line.tobytes(), above.tobytes()), np.uint8)
        else:
            raise ValueError(f"has a filter {kind}, which PNG does not know")
    return np.ascontiguousarray(image[1:])


def _by_both(kind: int, line: bytes, above: bytes) -> bytearray:
    """A line of which each byte was told from that on its left and that above: by their mean (3), or by Paeth (4)."""
    done = bytearray(len(line))
    for place, value in enumerate(line):
        left, up = (done[place - 2] if place > 1 else 0), above[place]
        if kind == 3:
            told = (left + up) >> 1
        else:
            corner = above[place - 2] if place > 1 else 0
            by_left, by_up, by_corner = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
            told = left if by_left <= by_up and by_left <= by_corner else up if by_up <= by_corner else corner
        done[place] = (value + told) & 255
    return done


def _npz(data: bytes) -> NDArray[np.generic]:
    return read_npz(data, ("depth",))["depth"]


def _npy(data: bytes) -> NDArray[np.generic]:
    return read_npy(io.BytesIO(data), "depth", len(data))


_READERS = {".png": read_png, ".npy": _npy, ".npz": _npz}
assert tuple(_READERS) == DEPTH_SUFFIXES
