"""The process that takes a scan out of a recording: `python -m adaafford.recording_process PATH SELECTION`.

Recordings come from anybody, and the library that opens them has no bounds of its own: chunks may unpack to any size.
So it runs in a process that has bounds: on memory, processor time, and files, of which it writes none. It prints the
scan as an NPZ; a line on standard error says which scan it is, or what is wrong. Messages are read by our own
definitions of their types, not by those that a recording brings.
"""

import io
import math
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from adaafford.columns import MAX_SCAN_BYTES, Columns, shown
from adaafford.recording_files import RecordingFiles
from adaafford.recordings import MAX_CPU_S, Selection
from adaafford.ros_messages import (
    CAMERA_INFO,
    CLOUD,
    COMPRESSED,
    IMAGE,
    MAX_APART_S,
    TRANSFORMS,
    TransformStamped,
    cloud_scan,
    depth_scan,
    is_depth,
    seconds,
    sensor_pose,
    unpacked_depth,
)
from shared.errors import UsageError
from shared.io.text import plain

MAX_MEMORY = 2 << 30
"""Bytes of address space beyond what the libraries take."""
MAX_TOPICS, MAX_IMAGES = 1000, 32
"""Topics, and topics of images whose encoding is looked at."""
_IMAGES = (IMAGE, COMPRESSED)
_EVER = (1 << 63) - 1
SECOND = 10**9
"""Recordings count nanoseconds."""
_GROWTH = 8
"""Of the time that is looked through, backwards from its end, until a message is found."""


class _Recording:
    """An open recording.

    Args:
        files: of it, open.
        selection: what is wanted of it.
    """

    def __init__(self, files: RecordingFiles, selection: Selection) -> None:
        self._files, self._wanted = files, selection
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        self._until = files.end
        if selection.at is not None:
            self._until = min(self._until, files.start + math.floor(selection.at * SECOND) + 1)
        self._kinds = files.kinds(MAX_TOPICS)

    def scan(self) -> tuple[Columns, str]:
        """The wanted scan, and a line that says which it is."""
        topic = self._wanted.topic or self._only_topic()
        kind = self._kinds.get(topic)
        if kind is None or kind not in (CLOUD, *_IMAGES):
            raise UsageError(f"has no cloud or image of the topic {shown([topic])}; {self._listed()}")
        time, message = self._last(topic, kind, self._until)
        pose, frame = None, self._wanted.frame
        if frame is not None:
            around = (time - int(2 * MAX_APART_S * SECOND), time + int(2 * MAX_APART_S * SECOND))
            fixed, moving = self._transforms("/tf_static"), self._transforms("/tf", *around)
            pose = sensor_pose(fixed, moving, frame, message.header.frame_id, seconds(message.header.stamp))
        if kind == CLOUD:
            found = cloud_scan(message, frame, pose)
        else:
            # A transport adds its own name to that of the image.
            image = topic.removesuffix("/compressedDepth").removesuffix("/compressed")
            depths = unpacked_depth(message) if kind == COMPRESSED else message
            found = depth_scan(depths, self._camera_info(image), "rect" in image.rpartition("/")[2], frame, pose)
        after = (time - self._files.start) / SECOND
        given = shown([frame or message.header.frame_id])
        names = shown(self._files.cut)
        cut = f" ({names}, not closed by its recorder, is read as far as it is whole)" * bool(self._files.cut)
        return found, f"its {shown([topic])} {after:.3f} s after the beginning, in the frame {given}{cut}"

    def _only_topic(self) -> str:
        """The one topic of a cloud, or of depth where there are no clouds."""
        found = self._of_kind(CLOUD) or [t for t in self._of_kind(*_IMAGES)[:MAX_IMAGES] if self._is_depth(t)]
        if len(found) == 1:
            return found[0]
        raise UsageError(f"holds scans of {len(found)} topics; {self._listed()}{'; name one by --topic' * bool(found)}")

    def _of_kind(self, *kinds: str) -> list[str]:
        return sorted(topic for topic, kind in self._kinds.items() if kind in kinds)

    def _is_depth(self, topic: str) -> bool:
        try:
            return is_depth(self._last(topic, self._kinds[topic], self._until)[1])
        except UsageError:
            return False

    def _camera_info(self, topic: str) -> Any:
        """What the camera of an image says of itself: beside the image, or the only one. It does not change."""
        beside, known = f"{topic.rpartition('/')[0]}/camera_info", self._of_kind(CAMERA_INFO)
        if beside not in known and len(known) != 1:
            raise UsageError(f"needs the topic {shown([beside])} with the intrinsics; of this kind are {shown(known)}")
        return self._last(beside if beside in known else known[0], CAMERA_INFO, self._files.end)[1]

    def _transforms(self, topic: str, start: int = 0, stop: int = _EVER) -> Iterator[TransformStamped]:
        if topic in self._of_kind(TRANSFORMS):
            for _, data in self._files.messages(topic, start, stop):
                yield from self._read(data, TRANSFORMS).transforms

    def _last(self, topic: str, kind: str, until: int) -> tuple[int, Any]:
        """The last message of a topic before a time, and its time; recordings are long, so it is looked for there."""
        found, span, begin = None, SECOND, self._files.start
        while found is None:
            start = max(begin, until - span)
            for found in self._files.messages(topic, start, until):  # noqa: B007 - the last one is wanted.
                pass
            if start <= begin:
                break
            span *= _GROWTH
        if found is None:
            raise UsageError(f"has no message of {shown([topic])} until then")
        return found[0], self._read(found[1], kind)

    def _read(self, data: bytes, kind: str) -> Any:
        if len(data) > MAX_SCAN_BYTES:
            raise UsageError(f"has a message of {len(data)} bytes; allowed are {MAX_SCAN_BYTES}")
        return self._types.deserialize_cdr(data, kind)

    def _listed(self) -> str:
        return f"clouds: {shown(self._of_kind(CLOUD))}; images: {shown(self._of_kind(*_IMAGES))}"


def scan_of(path: Path, selection: Selection) -> tuple[bytes, str]:
    """A scan of a recording as an NPZ, and a line that says which it is.

    Raises:
        UsageError: there is no such scan, with the reason.
        Exception: of the library, where a recording is damaged.
    """
    with RecordingFiles(path) as files:
        columns, line = _Recording(files, selection).scan()
    held = io.BytesIO()
    with np.errstate(invalid="ignore", over="ignore"):
        narrow = {name: np.asarray(values, np.float32) for name, values in columns.items()}
    np.savez(held, allow_pickle=False, **narrow)
    return held.getvalue(), line


def _limit() -> None:
    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123 - no regular file.
        taken = int(file.read().split()[0]) * resource.getpagesize()
    for kind, most in (
        (resource.RLIMIT_AS, taken + MAX_MEMORY),
        (resource.RLIMIT_CPU, MAX_CPU_S),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard < 0 else min(most, hard), hard))


def main() -> int:
    """Print the scan; 1 where there is none."""
    path, selection = Path(sys.argv[1]), Selection.model_validate_json(sys.argv[2])
    _limit()
    data = b""
    try:
        data, line = scan_of(path, selection)
    except MemoryError:
        line = f"needs more than {MAX_MEMORY >> 20} MB to unpack; record smaller messages"
    except (UsageError, ValueError) as error:
        line = str(error)
    except OSError as error:
        line = f"cannot be read ({error.strerror})"
    except Exception as error:  # noqa: BLE001 - whatever a reader makes of a file from outside.
        line = f"is damaged, cut off, or no recording of ROS 2 ({error or type(error).__name__}); record it again"
    sys.stdout.buffer.write(data)
    print(plain(line), file=sys.stderr)
    return 0 if data else 1


if __name__ == "__main__":
    sys.exit(main())
