"""Recordings of ROS 2 (MCAP, SQLite, or a folder of these): one scan is taken out of them, as an NPZ.

Needs `pip install 'adaafford[ros]'`. Recordings are untrusted, so another process with bounds opens them
(`adaafford.recording_process`).
"""

import os
import signal
import subprocess
from pathlib import Path

from pydantic import Field

from shared.config import StrictModel
from shared.errors import UsageError
from shared.extras import require
from shared.io.interpreter import PYTHON, own_environment
from shared.io.text import plain

SUFFIXES, PACKED = (".mcap", ".db3"), ".zstd"
"""Of the files of a recording, and what follows where a file is compressed as a whole."""
METADATA = "metadata.yaml"
"""What makes a folder a recording; one that was not closed has files alone."""
MAX_CPU_S, MAX_WAIT_S = 120, 600
"""For one scan. A reader that takes longer has met a file that is made to be slow, or one without an index."""
MAX_AT = 1e9
"""The largest --at, s."""
_MOST_SAID = 1000
"""Characters of a reason."""


class Selection(StrictModel):
    """Which scan of a recording is wanted."""

    topic: str | None = None
    """Of a recording: the cloud or the depth images; default: the only cloud, or where there is none, the only depth
    image."""
    at: float | None = Field(None, ge=0, le=MAX_AT)
    """Of a recording: the last scan until so many seconds after the beginning; default: the last of all."""
    frame: str | None = None
    """Of a recording: the frame of the scan and of the answers, such as base_link, by the transformations that were
    recorded (tf); default: the sensor's."""


WHOLE = Selection()
"""Of a recording with one topic: its last scan, in the frame of the sensor."""


def is_recording(path: Path) -> bool:
    """Whether a path is that of a recording, by its name, or of a folder by the names in it."""
    if is_storage(path.name):
        return True
    try:
        return any(name == METADATA or is_storage(name) for name in os.listdir(path))  # noqa: PTH208 - of a name too long pathlib raises.
    except (OSError, ValueError):  # The latter of a name with a zero byte.
        return False


def is_storage(name: str) -> bool:
    """Whether a file is of a recording, by its name."""
    return name.removesuffix(PACKED).endswith(SUFFIXES)


def take_scan(path: Path, selection: Selection) -> tuple[bytes, str]:
    """One scan of a recording as an NPZ for `adaafford.scans`, and a line that says which.

    Raises:
        UsageError: it cannot be read, or holds no such scan, or several.
    """
    require("a recording of ROS 2", "ros")
    if not os.path.exists(path):  # noqa: PTH110 - of a name too long pathlib raises.
        raise UsageError(f"{path}: there is no such recording")
    command = [*PYTHON, "-m", "adaafford.recording_process", os.path.abspath(path), selection.model_dump_json()]  # noqa: PTH100
    environment = {**own_environment(), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, capture_output=True, env=environment, timeout=MAX_WAIT_S, check=False)
    except subprocess.TimeoutExpired:
        raise UsageError(f"{path}: took more than {MAX_WAIT_S} s to read; record less at a time") from None
    if done.returncode == -signal.SIGXCPU:
        raise UsageError(f"{path}: took more than {MAX_CPU_S} s of processor time to read; record less at a time")
    said = plain(done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2], _MOST_SAID)
    if done.returncode != 0:
        raise UsageError(f"{path}: {said or f'its reader ended with {done.returncode}'}")
    return done.stdout, said
