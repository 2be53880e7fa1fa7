"""MCAP files that were cut off, such as by a loss of power: what is whole of them, closed as the format wants it.

A recorder writes the index and the end of a file last. Without them a reader refuses the file, although all chunks but
the last are whole. `mended` reads the file once and gives a file that ends with an index; nothing is written to disk.
"""

import io
import os
import struct
import sys
from binascii import crc32
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, BinaryIO

from lz4.frame import LZ4FrameDecompressor

if TYPE_CHECKING:
    from typing import Any

    zstd: Any
elif sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 1 << 30
"""Of a chunk that is unpacked; recorders make chunks of a megabyte, or of one message."""
_FOOTER_BYTES = 37
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _DATA_END = 1, 2, 3, 4, 5, 6, 8, 15
_KNOWN = range(_HEADER, _DATA_END + 1)
_PRIVATE = 0x80
"""From here on, records that others have defined."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, time of the recording, time of the publication."""


def is_cut(file: BinaryIO) -> bool:
    """Whether a file begins as an MCAP does, and does not end as one."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return False
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - len(MAGIC), 0))
    return size < len(MAGIC) + _FOOTER_BYTES or file.read() != MAGIC


@dataclass
class _Found:
    """What is known of a file, or of one of its chunks.

    Attributes:
        described: schema and channel records, each once, by opcode and content.
        counts: messages by channel.
        start: time of the first message, ns.
        end: of the last.
    """

    described: dict[tuple[int, bytes], None] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    start: int = (1 << 63) - 1
    end: int = 0

    def add(self, kind: int, content: memoryview) -> None:
        """Take account of a record."""
        if kind in (_SCHEMA, _CHANNEL):
            self.described[kind, bytes(content)] = None
        elif kind == _MESSAGE and len(content) >= _MESSAGE_HEAD.size:
            channel, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
            self.counts[channel] += 1
            self.start, self.end = min(self.start, time), max(self.end, time)

    def add_all(self, content: bytes) -> int:
        """Take account of the whole records in the content of a chunk; returns how many bytes these are."""
        view, place = memoryview(content), 0
        while place + 9 <= len(content):
            kind, length = struct.unpack_from("<BQ", content, place)
            end = place + 9 + length
            if kind not in (_SCHEMA, _CHANNEL, _MESSAGE) or end > len(content):
                break
            self.add(kind, view[place + 9 : end])
            place = end
        return place


def mended(file: BinaryIO) -> BinaryIO:
    """A file with all whole records of one that was cut off, and with an index of its chunks.

    Of the last chunk, the messages are kept whose bytes are there.
    """
    size = file.seek(0, os.SEEK_END)
    end, found, rebuilt, index = len(MAGIC), _Found(), b"", bytearray()
    while end + 9 <= size:
        file.seek(end)
        kind, length = struct.unpack("<BQ", file.read(9))
        if kind in (_FOOTER, _DATA_END) or not (kind in _KNOWN or kind >= _PRIVATE):
            break  # The end of the data, or bytes that were never written.
        whole = end + 9 + length <= size
        if kind == _CHUNK:
            packed = file.read(min(length, size - end - 9))
            content, intact = _unpacked(packed, whole)
            chunk = _Found(described=found.described)
            kept = chunk.add_all(content)
            if not (whole and intact):
                if chunk.counts:
                    rebuilt = _plain_chunk(content[:kept], chunk)
                    index += _indexed(end, rebuilt, chunk)
                break
            index += _indexed(end, struct.pack("<BQ", kind, length) + packed, chunk)
        elif not whole:
            break
        elif kind in (_SCHEMA, _CHANNEL):
            found.add(kind, memoryview(file.read(length)))
        end += 9 + length
    summary = b"".join(_record(kind, content) for kind, content in found.described) + bytes(index)
    start = end + len(rebuilt) if summary else 0
    tail = rebuilt + summary + _record(_FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC
    return io.BufferedReader(_Continued(file, end, tail))


def _unpacked(chunk: bytes, whole: bool) -> tuple[bytes, bool]:
    """The records of a chunk, as far as they are there; and whether they are all."""
    if len(chunk) < 32:
        return b"", False
    size, checksum, name_length = struct.unpack_from("<QII", chunk, 16)
    compression, begin = chunk[32 : 32 + name_length], 32 + name_length + 8
    if size > MAX_CHUNK_BYTES:
        raise MemoryError
    data = chunk[begin:]
    try:
        if compression == b"zstd":
            data = zstd.ZstdDecompressor().decompress(data, size)
        elif compression == b"lz4":
            data = LZ4FrameDecompressor().decompress(data, size)
        elif compression:
            raise ValueError(f"has chunks that are compressed by '{compression[:20].decode('latin-1')}'")
    except (zstd.ZstdError, RuntimeError, EOFError):
        return b"", False
    return data, whole and len(data) == size and checksum in (0, crc32(data))


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _plain_chunk(content: bytes, chunk: _Found) -> bytes:
    """A chunk that is not compressed, as a record."""
    head = struct.pack("<QQQIIQ", chunk.start, chunk.end, len(content), 0, 0, len(content))
    return _record(_CHUNK, head + content)


def _indexed(place: int, record: bytes, chunk: _Found) -> bytes:
    """The index record of a chunk that begins at a place.

    Readers count its messages by the lengths of the message indexes behind it, so these are told as they would be.
    """
    if not chunk.counts:
        return b""
    (name_length,) = struct.unpack_from("<I", record, 9 + 28)
    compression = record[9 + 32 : 9 + 32 + name_length]
    size, packed = struct.unpack_from("<Q", record, 9 + 16)[0], len(record) - 9 - 40 - name_length
    offsets, behind = b"", 0
    for channel, count in sorted(chunk.counts.items()):
        offsets += struct.pack("<HQ", channel, place + len(record) + behind)
        behind += 15 + 16 * count
    content = struct.pack("<QQQQI", chunk.start, chunk.end, place, len(record), len(offsets)) + offsets
    content += struct.pack("<QI", behind, name_length) + compression + struct.pack("<QQ", packed, size)
    return _record(_CHUNK_INDEX, content)


class _Continued(io.RawIOBase):
    """The first bytes of a file, and others behind them."""

    def __init__(self, file: BinaryIO, end: int, tail: bytes) -> None:
        self._file, self._end, self._tail, self._place = file, end, tail, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._end + len(self._tail)}[whence]
        self._place = max(base + offset, 0)
        return self._place

    def readinto(self, buffer: "bytearray | memoryview") -> int:  # type: ignore[override]
        wanted = len(buffer)
        if self._place < self._end:
            self._file.seek(self._place)
            data = self._file.read(min(wanted, self._end - self._place))
        else:
            data = self._tail[self._place - self._end :][:wanted]
        buffer[: len(data)] = data
        self._place += len(data)
        return len(data)

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()
