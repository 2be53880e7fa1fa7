"""Heartbeats of workers, and their crash logs.

    STORE/underway/<process>.json    the heartbeat: the rollout that this process executes now
    STORE/underway/<process>.fault   the traceback of a crash or a hang; empty otherwise

These files are in the store, because the store is the only place that workers and driver are sure to share. A file is
named after its process, so it cannot be mistaken for that of another worker on the same rollout. The files are not
synced, because a heartbeat matters after the end of a process, not after the end of a machine.

The heartbeats of a store in a bucket are in the bucket. The crash logs are not, because a signal handler can only write
to a local file: they stay on the worker's machine in a private folder (`shared.io.private`), and a driver on another
machine treats a crash as a loss.
"""

import hashlib
import os
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import StoreError
from shared.heartbeat import is_recent
from shared.io.files import DAY_S, is_abandoned, is_gone, process_name, read_bounded
from shared.io.private import private_folder

if TYPE_CHECKING:
    from shared.store.backends.base import StorageBackend

CRASH_LOG_FOLDER = "underway"

_ABANDONED_S = 30 * DAY_S
"""A worker on another machine may wait for its next job for days while a policy is trained."""
_WORKER_SILENT_S = 600.0
"""A worker writes a heartbeat before each rollout, and hardly any rollout takes longer."""
_HEARTBEAT, _FAULT = ".json", ".fault"
_HEARTBEAT_BYTES = 256
_MAX_BYTES = 1 << 16
_FRAMES = 2
"""Frames of a traceback in a reason, from the innermost outwards."""
_FRAME = re.compile(r'  File "(?P<file>[^"]*)", line (?P<line>\d+) in (?P<function>.*)')
_TIMEOUT = re.compile(r"Timeout \((?P<limit>[\d:.]+)\)!")


class Heartbeat(StrictModel):
    """The job and the rollout that a process executes."""

    shard_id: str = Field(max_length=100)
    """Of the job."""
    rollout: int | None = Field(ge=0)
    """The running rollout; None while the shard is written, and until the next job."""
    written: float = Field(0.0, ge=0)
    """Seconds since 1970."""


@dataclass(frozen=True, slots=True)
class CrashLog:
    """The heartbeats and crash logs of one store.

    Attributes:
        folder: of these files; None for a store in a bucket, whose crash logs are in a private folder of each machine.
        url: of a store in a bucket.

    Example:
        crash_log.leave(Heartbeat(shard_id=job.shard_id, rollout=17))    # the worker's process
        crash_log.heartbeat_of(process), crash_log.fault_of(process)   # the driver, once that process has ended
    """

    folder: Path | None
    url: str = ""

    def leave(self, heartbeat: Heartbeat) -> None:
        """Write the heartbeat of this process.

        Raises:
            StoreError: the bucket cannot be reached.
            OSError: the file cannot be written; the older one, which has the wrong rollout, is removed.
        """
        if self.url:
            _place(self.url).replace(_key(process_name()), heartbeat.model_dump_json().encode())
            return
        file = self._file(process_name(), _HEARTBEAT)
        try:
            _overwrite(file, heartbeat.model_dump_json().encode())
        except FileNotFoundError:
            file.parent.mkdir(exist_ok=True)
            _overwrite(file, heartbeat.model_dump_json().encode())
        except OSError:
            file.unlink(missing_ok=True)
            raise

    def open_fault_log(self) -> IO[bytes]:
        """Open the crash log of this process for `faulthandler`.

        Raises:
            UsageError: the store is in a bucket, and this machine has no private folder.
            OSError: the file cannot be written.
        """
        file = self._file(process_name(), _FAULT)
        file.parent.mkdir(exist_ok=True)
        return os.fdopen(_open(file, os.O_TRUNC), "wb", buffering=0)

    def heartbeat_of(self, process: str) -> Heartbeat | None:
        """The last heartbeat of a process; None if it is missing or incomplete."""
        try:
            return Heartbeat.model_validate_json(self._read_heartbeat(process))
        except ValidationError:
            return None

    def heartbeats(self) -> dict[str, Heartbeat]:
        """The heartbeats of all processes, by name."""
        names = _place(self.url).names(CRASH_LOG_FOLDER) if self.url else sorted(file.name for file in self._files())
        processes = [name.removesuffix(_HEARTBEAT) for name in names if name.endswith(_HEARTBEAT)]
        found = {process: self.heartbeat_of(process) for process in processes}
        return {process: heartbeat for process, heartbeat in found.items() if heartbeat is not None}

    def fault_of(self, process: str) -> str:
        """The cause of a process's crash in one line; "" if the process did not cause its own end."""
        return summary_of(self._read(process, _FAULT).decode(errors="replace"))

    def forget(self, process: str) -> None:
        """Remove the heartbeat and the crash log of a process."""
        if self.url:
            _place(self.url).remove(_key(process))
        for suffix in (_HEARTBEAT, _FAULT):
            self._file(process, suffix).unlink(missing_ok=True)

    def sweep(self) -> int:
        """Remove the files of processes that are known to have ended; returns how many files that was."""
        heartbeats = [process for process in self.heartbeats() if is_gone(process)] if self.url else []
        files = [file for file in self._files() if is_abandoned(file, file.stem, _ABANDONED_S)]
        for process in heartbeats:
            _place(self.url).remove(_key(process))
        for file in files:
            file.unlink(missing_ok=True)
        return len(heartbeats) + len(files)

    def _home(self) -> Path:
        """The folder of this machine's files."""
        if self.folder is not None:
            return self.folder
        return private_folder(f"{CRASH_LOG_FOLDER}-{hashlib.sha256(self.url.encode()).hexdigest()[:16]}")

    def _files(self) -> list[Path]:
        home = self._home()
        return list(home.iterdir()) if home.is_dir() else []

    def _file(self, process: str, suffix: str) -> Path:
        # Not `with_suffix`: a host's name may hold dots.
        return self._home() / f"{process}{suffix}"

    def _read_heartbeat(self, process: str) -> bytes:
        if not self.url:
            return self._read(process, _HEARTBEAT)
        try:
            return _place(self.url).read(_key(process), _MAX_BYTES)
        except StoreError:
            return b""

    def _read(self, process: str, suffix: str) -> bytes:
        try:
            return read_bounded(self._file(process, suffix), _MAX_BYTES)
        except StoreError:
            return b""


def workers_at_work(url: str, now: float) -> list[str]:
    """Processes that leave heartbeats in a bucket and have not ended, as far as that can be told from here.

    Args:
        url: of the store.
        now: seconds since 1970.
    """
    heartbeats = CrashLog(Path(), url).heartbeats()
    return [
        name
        for name, heartbeat in heartbeats.items()
        if not is_gone(name) and is_recent(heartbeat.written, now, _WORKER_SILENT_S)
    ]


@cache
def _place(url: str) -> "StorageBackend":
    """A bucket, whose client cannot travel between processes."""
    from shared.store.backends.base import backend_of

    return backend_of(url)


def _key(process: str) -> str:
    """Of a heartbeat, in a bucket."""
    return f"{CRASH_LOG_FOLDER}/{process}{_HEARTBEAT}"


def _overwrite(file: Path, data: bytes) -> None:
    """Put a heartbeat in the place of the last one."""
    # Neither truncated nor renamed over: file systems take either for a wish to have it on the disk at once, which
    # costs milliseconds. Blanks cover what was there before, and JSON ignores them.
    assert len(data) <= _HEARTBEAT_BYTES
    descriptor = _open(file)
    try:
        os.write(descriptor, data.ljust(_HEARTBEAT_BYTES))
    finally:
        os.close(descriptor)


def _open(file: Path, flags: int = 0) -> int:
    """Open a file of this process to write: others may write to a store, and a link could lead anywhere."""
    # A pipe in its place would block for ever.
    flags |= os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    return os.open(file, flags, 0o644)


def summary_of(words: str) -> str:
    """What `faulthandler` wrote, in one line of bounded length: what happened, and the innermost frames."""
    if not words.strip():
        return ""
    first = " ".join(words.strip().splitlines()[0].split())[:200]
    timeout = _TIMEOUT.fullmatch(first)
    what = f"took more than {timeout['limit']}" if timeout else first.removeprefix("Fatal Python error: ")
    # After a timeout every thread has a section; the main thread's, which executes jobs, comes last.
    section = words.rpartition("(most recent call first):")[2]
    frames = [match for line in section.splitlines() if (match := _FRAME.fullmatch(line))][:_FRAMES]
    places = [f"{frame['function'][:60]} ({Path(frame['file']).name[:60]}:{frame['line']})" for frame in frames]
    return f"{what}, in {' of '.join(places)}" if places else what
