"""Files that survive a kill: durable atomic writing, bounded reading, hashing, locks, and who left a temporary file.

A temporary name says which process made it (host, process id, start time), so that remnants of dead writers can be
told from the work of live ones.
"""

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import signal
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from shared.errors import StoreError, UsageError

TEMPORARY_PREFIX = ".tmp-"
_PROCESS_NAME = re.compile(r"(?P<space>[^~/]*)~(?P<pid>\d{1,10})~(?P<start>\d{1,20})")
_TEMPORARY_NAME = re.compile(r"\.tmp-[^~]*~(?P<process>[^~]*~\d+~\d+)~[0-9a-f]+")
_LOCK_POLL_S = 0.01


def write_durably(path: Path, data: bytes) -> None:
    """Write a new file and force it to the disk; not atomic, so for places that nobody reads yet.

    Raises:
        OSError: the file exists already, or cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        _write_all(descriptor, data)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_all(descriptor: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        # The system may take less than it is given, and says so by the count alone.
        taken = os.write(descriptor, left)
        if taken == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        left = left[taken:]


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it; one that is there will do.

    Raises:
        UsageError: something else has its name, or it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: no folder can be made of this name ({error.strerror}); name another") from None


def sync_folder(path: Path) -> None:
    """Force a folder's entries (creations, renames) to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Put `data` at `path`, replacing what was there: a reader finds the old bytes or the new, after any crash."""
    temporary = path.parent / temporary_name(path.name)
    try:
        write_durably(temporary, data)
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def create_exclusively(path: Path, data: bytes) -> bool:
    """Put `data` at `path` unless something is there: whole or not at all, and by one of several writers only.

    Returns:
        Whether this call made the file.
    """
    temporary = path.parent / temporary_name(path.name)
    try:
        write_durably(temporary, data)
        # A hard link fails where the name exists, which rename would silently replace.
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)
    return True


def read_bounded(path: Path, limit: int) -> bytes:
    """The bytes of a regular file of at most `limit` bytes.

    Raises:
        StoreError: it is missing, no regular file (a link or a pipe, say), or larger.
    """
    try:
        # A link could lead anywhere.
        data = _read_regular(path, limit, os.O_NOFOLLOW)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error.strerror}); restore the file from a copy") from None
    if data is None:
        raise StoreError(f"{path}: not a regular file; restore it from a copy")
    if len(data) > limit:
        raise StoreError(f"{path}: larger than the {limit} bytes that it may have; the file is foreign or damaged")
    return data


def read_named(path: Path, limit: int, advice: str) -> bytes:
    """The bytes of a regular file that a user names, and that links may lead to.

    Args:
        path: the file.
        limit: the most bytes that it may have.
        advice: what a message tells the user to do.

    Raises:
        UsageError: it is missing, no regular file (a pipe, say), or larger.
    """
    try:
        data = _read_regular(path, limit, 0)
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); {advice}") from None
    if data is None:
        raise UsageError(f"{path}: not a regular file; {advice}")
    if len(data) > limit:
        raise UsageError(f"{path}: larger than {limit} bytes; {advice}")
    return data


def _read_regular(path: Path, limit: int, flags: int) -> bytes | None:
    """At most one byte more than `limit`; None of what is no regular file, which could be endless."""
    # To open a pipe would wait for a writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | flags)
    try:
        return _read_all(descriptor, limit + 1) if stat.S_ISREG(os.fstat(descriptor).st_mode) else None
    finally:
        os.close(descriptor)


def _read_all(descriptor: int, limit: int) -> bytes:
    pieces = []
    while limit > 0 and (piece := os.read(descriptor, min(limit, 1 << 24))):
        pieces.append(piece)
        limit -= len(piece)
    return b"".join(pieces)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def exclusive_lock(path: Path, wait_seconds: float = 0.0) -> Iterator[None]:
    """Hold a file's lock; the kernel gives it back when the holder dies, however it dies.

    Args:
        path: the lock file; it is made where missing, and stays.
        wait_seconds: how long to wait for another holder.

    Raises:
        UsageError: another process holds it; the message names that process.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        _acquire(descriptor, path, time.monotonic() + wait_seconds)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()} on {host_name()}".encode(), 0)
        yield
    finally:
        # Closing gives the lock back. The file stays: unlinking it would let two processes lock two files of one name.
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, deadline: float) -> None:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
        if time.monotonic() >= deadline:
            holder = os.pread(descriptor, 200, 0).decode(errors="replace") or "unknown"
            raise UsageError(f"{path.parent} is in use by process {holder}; wait for it or stop it")
        time.sleep(_LOCK_POLL_S)


def host_name() -> str:
    """This machine's name, in characters that a file name may hold."""
    return re.sub(r"[^A-Za-z0-9.-]", "_", socket.gethostname())[:64]


@cache
def _process_space() -> str:
    """What process ids are unique within: the host, and the namespace, since containers may share a host's name."""
    try:
        namespace = re.sub(r"\D", "", Path("/proc/self/ns/pid").readlink().name)
    except OSError:
        namespace = "0"
    return f"{host_name()}-{namespace}"


def process_name() -> str:
    """This process, as no other is called, on any host: what its files can be named by."""
    process = os.getpid()
    return f"{_process_space()}~{process}~{_start_ticks(process)}"


def is_gone(process: str) -> bool:
    """Whether the process of this `process_name` has ended for certain; one on another host may be alive."""
    match = _PROCESS_NAME.fullmatch(process)
    if match is None or match["space"] != _process_space():
        return False
    return not _is_running(int(match["pid"]), int(match["start"]))


def end_if_here(process: str) -> None:
    """Kill the process of this `process_name` if it is one of this host's."""
    match = _PROCESS_NAME.fullmatch(process)
    if match is not None and match["space"] == _process_space() and not is_gone(process):
        os.kill(int(match["pid"]), signal.SIGKILL)


def temporary_name(name: str) -> str:
    """A unique name for a temporary file or folder that will become `name`, and that says who made it."""
    return f"{TEMPORARY_PREFIX}{name}~{process_name()}~{secrets.token_hex(6)}"


def remove_if_abandoned(path: Path) -> bool:
    """Remove a temporary file or folder whose writer is dead; leave one that is, or may be, still written.

    A writer on another host or in another container may be alive, so its remnants stay.

    Returns:
        Whether it was removed.
    """
    match = _TEMPORARY_NAME.fullmatch(path.name)
    if match is None or not is_gone(match["process"]):
        return False
    remove_tree(path)
    return True


def remove_tree(path: Path) -> None:
    """Remove a file, a link (not what it points at) or a folder; it is no error if another process was faster."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _is_running(process: int, start_ticks: int) -> bool:
    # The start time tells a live writer from a stranger that was given the same number later.
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return _start_ticks(process) in (start_ticks, 0)


def _start_ticks(process: int) -> int:
    """When a process started, in clock ticks since boot; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 0
    # The second field is the program's name in parentheses and may hold blanks; the 22nd field is the start time.
    return int(fields.rpartition(")")[2].split()[19])
