"""Messages of ROS 2, and recordings of them that `rosbags` writes."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

OPTICAL = "camera_depth_optical_frame"
Said = tuple[str, float, Any]
"""A topic, seconds, and a message."""


class Messages:
    """Makes the messages of one release of ROS 2."""

    def __init__(self, store: Stores = Stores.ROS2_HUMBLE) -> None:
        self.store = get_typestore(store)

    def make(self, name: str, *fields: Any) -> Any:
        return self.store.types[name](*fields)

    def header(self, frame: str, stamp: float) -> Any:
        time = self.make("builtin_interfaces/msg/Time", int(stamp), round(stamp % 1 * 1e9))
        return self.make("std_msgs/msg/Header", time, frame)

    def cloud(
        self,
        points: ArrayLike,
        frame: str = OPTICAL,
        stamp: float = 0.0,
        dtype: Any = None,
        rows: int = 1,
        gap: int = 0,
    ) -> Any:
        """A cloud whose points are records of a structured type, in rows with a gap of so many bytes after each."""
        dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]) if dtype is None else np.dtype(dtype)
        given = np.asarray(points, np.float64)
        records = np.zeros(len(given), dtype)
        for name, values in zip("xyz", given.T, strict=True):
            records[name] = values
        return self.cloud_of(records.reshape(rows, -1), frame, stamp, gap)

    def cloud_of(self, records: NDArray[Any], frame: str = OPTICAL, stamp: float = 0.0, gap: int = 0) -> Any:
        dtype = records.dtype
        assert dtype.fields is not None
        numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make("sensor_msgs/msg/PointField", name, offset, numbers[kind.str[1:]], 1)
            for name, (kind, offset, *_) in dtype.fields.items()
        ]
        big = any(kind.str[0] == ">" for kind, *_ in dtype.fields.values())
        data = padded(records, gap)
        step = dtype.itemsize
        header, (height, width) = self.header(frame, stamp), records.shape
        row = width * step + gap
        return self.make("sensor_msgs/msg/PointCloud2", header, height, width, fields, big, step, row, data, False)

    def image(
        self, pixels: NDArray[Any], encoding: str = "16UC1", frame: str = OPTICAL, stamp: float = 0.0, gap: int = 0
    ) -> Any:
        height, width = pixels.shape
        big, step = int(pixels.dtype.str[0] == ">"), width * pixels.dtype.itemsize + gap
        header, data = self.header(frame, stamp), padded(pixels, gap)
        return self.make("sensor_msgs/msg/Image", header, height, width, encoding, big, step, data)

    def compressed(self, form: str, data: bytes, frame: str = OPTICAL) -> Any:
        array = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/msg/CompressedImage", self.header(frame, 0.0), form, array)

    def camera_info(
        self, shape: tuple[int, int], intrinsics: Sequence[float], distortion: Sequence[float] = (0.0,) * 5
    ) -> Any:
        fx, fy, cx, cy = intrinsics
        k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        p = np.array([fx / 2, 0, cx, 0, 0, fy / 2, cy, 0, 0, 0, 1.0, 0])
        whole = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        return self.make(
            *("sensor_msgs/msg/CameraInfo", self.header(OPTICAL, 0.0), *shape, "plumb_bob"),
            *(np.array(distortion), k, np.eye(3).ravel(), p, 0, 0, whole),
        )

    def transform(
        self, parent: str, child: str, place: Sequence[float], turn: Sequence[float] = (0, 0, 0, 1), stamp: float = 0.0
    ) -> Any:
        where = self.make("geometry_msgs/msg/Vector3", *map(float, place))
        rotation = self.make("geometry_msgs/msg/Quaternion", *map(float, turn))
        transform = self.make("geometry_msgs/msg/Transform", where, rotation)
        return self.make("geometry_msgs/msg/TransformStamped", self.header(parent, stamp), child, transform)

    def transforms(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", list(transforms))

    def write(self, folder: Path, said: Sequence[Said], storage: str = "mcap", packing: str = "") -> Path:
        """Write a recording; returns its folder. Its times begin at 1,000 s."""
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(folder, version=9, storage_plugin=plugin)
        if packing in ("file", "message"):
            writer.set_compression(CompressionMode[packing.upper()], CompressionFormat.ZSTD)
        elif packing in ("zstd", "bomb"):
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            held: Any = writer.storage
            if packing == "lz4":
                held.compression, held.compressor = "lz4", lz4.frame.compress
            elif packing == "bomb":
                # A frame of zeros that follows itself again and again.
                packed = held.compressor(bytes(64 << 20))
                held.compressor = lambda data: packed * 100
            connections = {}
            for topic, seconds, message in said:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                data = self.store.serialize_cdr(message, kind)
                writer.write(connections[topic], round((1000 + seconds) * 1e9), data)
        if packing == "none":
            (file,) = folder.glob("*.mcap")
            file.write_bytes(_without_chunks(file.read_bytes()))
        return folder


def _without_chunks(data: bytes) -> bytes:
    """An MCAP whose messages are in no chunks, and which has no index."""
    kept, place, kind = data[:8], 8, 0
    while kind != 15:
        kind, length = struct.unpack_from("<BQ", data, place)
        content = data[place : place + 9 + length]
        if kind == 6:
            kept += content[9 + 40 :]
        elif kind in (1, 15):
            kept += content
        place += 9 + length
    return kept + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + data[:8]


def png(pixels: NDArray[Any], colour: int = 0) -> bytes:
    """A PNG of 16 bits of grey."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    height, width = pixels.shape
    lines = pixels.astype(">u2").view(np.uint8).reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    packed = zlib.compress(np.pad(lines, ((0, 0), (1, 0))).tobytes())
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def rvl(pixels: NDArray[Any]) -> bytes:
    """An image as RVL packs it, after the program in the paper (Wilson 2017)."""
    flat, nibbles, place, previous = pixels.ravel().tolist(), list[int](), 0, 0

    def write(number: int) -> None:
        while True:
            nibble, number = number & 7, number >> 3
            nibbles.append(nibble | (8 if number else 0))
            if not number:
                return

    def run(zero: bool) -> int:
        end = place
        while end < len(flat) and (flat[end] == 0) is zero:
            end += 1
        return end - place

    while place < len(flat):
        write(zeros := run(True))
        place += zeros
        write(others := run(False))
        for value in flat[place : place + others]:
            delta, previous = value - previous, value
            write(2 * delta if delta >= 0 else -2 * delta - 1)
        place += others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<ii{len(words)}I", pixels.shape[1], pixels.shape[0], *words)


def padded(cells: NDArray[Any], gap: int) -> NDArray[np.uint8]:
    """The bytes of an array [H, W], with a gap after each row."""
    rows = np.ascontiguousarray(cells).view(np.uint8).reshape(len(cells), -1)
    return np.pad(rows, ((0, 0), (0, gap)), constant_values=255).ravel()
