"""The files of a recording: one, or those of a folder; as they are, packed as a whole, or cut off.

A folder needs no `metadata.yaml`, which a recorder writes last. Only `adaafford.recording_process` imports this module,
because files are untrusted and the library that opens them has no bounds.
"""

import heapq
import io
import os
import re
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, BinaryIO, cast

from rosbags.rosbag2 import Reader

from adaafford.columns import MAX_SCAN_BYTES, shown
from adaafford.cut_mcap import is_cut, mended, zstd
from adaafford.recordings import PACKED, is_storage
from shared.errors import UsageError

if TYPE_CHECKING:
    from typing import Self

    from rosbags.interfaces import Connection
    from rosbags.interfaces.typing import RPath

MAX_FILES = 1000
MAX_UNPACKED = 1 << 30
"""Bytes of a file that is packed as a whole."""
_PIECE = 1 << 20
_ZSTD = b"\x28\xb5\x2f\xfd"
"""What a message begins with that is compressed by itself; other messages begin with 0."""
_WAL_HEAD, _WAL_FRAME = struct.Struct(">8I"), struct.Struct(">6I")
_WAL_MAGIC = (0x377F0682, 0x377F0683)


@dataclass(frozen=True, slots=True)
class _Held:
    """A file that is not on disk as it is read; the part of `pathlib.Path` that the library uses.

    Attributes:
        name: of the file.
        data: how it is opened: its bytes, or a file.
    """

    name: str
    data: "bytes | BinaryIO"

    @property
    def suffix(self) -> str:
        return os.path.splitext(self.name)[1]  # noqa: PTH122 - it is no path.

    def exists(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def open(self, mode: str = "rb") -> BinaryIO:
        assert mode == "rb"
        return io.BytesIO(self.data) if isinstance(self.data, bytes) else self.data

    def stat(self) -> SimpleNamespace:
        assert isinstance(self.data, bytes), "only a file of SQLite is asked"
        return SimpleNamespace(st_size=len(self.data))

    def __str__(self) -> str:
        return self.name


class RecordingFiles:
    """The messages of a recording, in the order of time.

    Args:
        path: a file, or a folder of them.

    Attributes:
        cut: names of the files that were cut off.
        start: time of the first message, ns.
        end: of the last, and 1.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._stack = path, ExitStack()
        self._readers: list[Reader] = []
        self.cut: list[str] = []
        self.start = self.end = 0

    def __enter__(self) -> "Self":
        with self._stack:
            for file in _files_of(self._path):
                opened = self._opened(file)
                if opened is None:
                    continue
                reader = Reader(cast("RPath", opened))
                self._stack.enter_context(reader)
                if reader.message_count:
                    self._readers.append(reader)
            if not self._readers:
                raise UsageError("holds no message" + "; it was cut off" * bool(self.cut))
            self._readers.sort(key=lambda reader: int(reader.start_time))
            self.start = min(int(reader.start_time) for reader in self._readers)
            self.end = max(int(reader.end_time) for reader in self._readers)
            self._stack = self._stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def kinds(self, most: int) -> dict[str, str]:
        """Types of messages by topic, of topics that have any."""
        found: dict[str, str] = {}
        for reader in self._readers:
            for each in reader.connections:
                if each.msgcount and len(found) < most:
                    found.setdefault(each.topic, each.msgtype)
        return found

    def messages(self, topic: str, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
        """The messages of a topic from a time on and before another one, with their times."""
        streams = [
            _of_reader(reader, topic, start, stop)
            for reader in self._readers
            if reader.start_time < stop and start < reader.end_time
        ]
        return heapq.merge(*streams, key=lambda message: message[0])

    def _opened(self, path: Path) -> "Path | _Held | None":
        """What the library reads of a file; None of one that is empty."""
        name = path.name
        data: bytes | None = None
        if name.endswith(PACKED):
            name, data = name.removesuffix(PACKED), _whole(path)
        if not (path.stat().st_size if data is None else data):
            self.cut.append(name)
            return None
        if name.endswith(".db3"):
            log = path.with_name(f"{path.name}-wal")
            if data is None and log.is_file() and log.stat().st_size > _WAL_HEAD.size:
                data = _with_log(_bounded(path), _bounded(log))
                self.cut.append(name)
            if data is None and set("?#%") & set(str(path)):
                raise UsageError("the path of an SQLite file must not have ?, # or %; move or rename it")
            return path if data is None else _Held(name, data)
        file: BinaryIO = path.open("rb") if data is None else io.BytesIO(data)
        self._stack.callback(file.close)
        if is_cut(file):
            self.cut.append(name)
            return _Held(name, mended(file))
        return path if data is None else _Held(name, data)


def _files_of(path: Path) -> list[Path]:
    """The files of a recording, in the order of their numbers."""
    if not path.is_dir():
        return [path]
    names = {file.name for file in path.iterdir() if is_storage(file.name)}
    # Of a file that was unpacked beside the packed one, the former counts.
    names -= {name for name in names if name.endswith(PACKED) and name.removesuffix(PACKED) in names}
    if not names:
        raise UsageError("is a folder without a file of a recording (.mcap, .db3)")
    if len(names) > MAX_FILES:
        raise UsageError(f"has {len(names)} files; allowed are {MAX_FILES}; name one of them")
    return [path / name for name in sorted(names, key=lambda name: [int(n) for n in re.findall(r"[0-9]{1,18}", name)])]


def _of_reader(reader: Reader, topic: str, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
    wanted: list[Connection] = [each for each in reader.connections if each.topic == topic]
    if not wanted:
        return
    for _, time, data in reader.messages(wanted, start, stop):
        yield time, _unpacked(data) if data.startswith(_ZSTD) else data


def _unpacked(message: bytes) -> bytes:
    """A message that was compressed by itself."""
    data: bytes = zstd.ZstdDecompressor().decompress(message, MAX_SCAN_BYTES + 1)
    if len(data) > MAX_SCAN_BYTES:
        raise UsageError(f"has a message of more than {MAX_SCAN_BYTES} bytes; record smaller ones")
    return data


def _whole(path: Path) -> bytes:
    """A file that was compressed as a whole; of one that was cut off, what there is."""
    decompressor, held, size = zstd.ZstdDecompressor(), [], 0
    with path.open("rb") as file:
        while not decompressor.eof:
            piece = file.read(_PIECE) if decompressor.needs_input else b""
            if decompressor.needs_input and not piece:
                break
            held.append(decompressor.decompress(piece, _PIECE))
            size += len(held[-1])
            if size > MAX_UNPACKED:
                raise UsageError(
                    f"{shown([path.name])} unpacks to more than {MAX_UNPACKED >> 20} MB; unpack it by `zstd -d`, and "
                    "name that file"
                )
    return b"".join(held)


def _bounded(path: Path) -> bytes:
    """The bytes of a file that another one belongs to."""
    if path.stat().st_size > MAX_UNPACKED:
        raise UsageError(
            f"{shown([path.name])} is larger than {MAX_UNPACKED >> 20} MB and was not closed by its recorder; open it "
            "once by sqlite3"
        )
    return path.read_bytes()


def _with_log(data: bytes, log: bytes) -> bytes:
    """An SQLite file with what its write-ahead log has committed, which a recorder that was killed has left there."""
    magic, _, page, _, salt, other_salt, *_ = _WAL_HEAD.unpack_from(log)
    if magic not in _WAL_MAGIC or not 512 <= page <= 1 << 16:
        return data
    pages: dict[int, int] = {}
    waiting: dict[int, int] = {}
    count = 0
    sums = _checksum(log[:24], (0, 0), magic)
    for place in range(_WAL_HEAD.size, len(log) - _WAL_FRAME.size - page + 1, _WAL_FRAME.size + page):
        number, committed, *salts, first, second = _WAL_FRAME.unpack_from(log, place)
        content = place + _WAL_FRAME.size
        sums = _checksum(log[content : content + page], _checksum(log[place : place + 8], sums, magic), magic)
        if salts != [salt, other_salt] or sums != (first, second) or not 0 < number <= MAX_UNPACKED // page:
            break
        waiting[number] = content
        if committed:
            pages |= waiting
            waiting, count = {}, committed
    if not count or count * page > MAX_UNPACKED:
        return data
    whole = bytearray(data[: count * page].ljust(count * page, b"\0"))
    for number, content in pages.items():
        if number <= count:
            whole[(number - 1) * page : number * page] = log[content : content + page]
    return bytes(whole)


def _checksum(data: bytes, sums: tuple[int, int], magic: int) -> tuple[int, int]:
    """The running checksums of a write-ahead log after some more of its bytes."""
    first, second = sums
    words = struct.unpack(f"{'>' if magic & 1 else '<'}{len(data) // 4}I", data)
    for one, other in zip(words[::2], words[1::2], strict=True):
        first = (first + one + second) & 0xFFFFFFFF
        second = (second + other + first) & 0xFFFFFFFF
    return first, second
