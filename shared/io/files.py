"""Files that survive a kill: durable atomic writing, bounded reading, hashing, locks, and who left a temporary file.

A temporary name says which process made it (boot of a machine, process id, start time), so that remnants of dead
writers can be told from the work of live ones. It does not say the machine's name, since stores are published.

Not every file system has file locks, hard links or a way to force a folder to the disk; where one of these is missing,
something slower takes its place.
"""

import errno
import fcntl
import hashlib
import logging
import os
import re
import secrets
import shutil
import signal
import socket
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from shared.errors import MissingError, StoreError, UnreadableError, UsageError
from shared.io.text import plain

TEMPORARY_PREFIX = ".tmp-"
_PROCESS_NAME = re.compile(r"(?P<space>[^~/]*)~(?P<pid>\d{1,10})~(?P<start>\d{1,20})")
_TEMPORARY_NAME = re.compile(r"\.tmp-[^~]*~(?P<process>[^~]*~\d+~\d+)~[0-9a-f]+")
_LOCK_POLL_S = 0.01
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_NOT_SUPPORTED = frozenset({errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL})
"""How file systems refuse what they cannot do."""
_NO_LOCKS = _NOT_SUPPORTED | {errno.ENOLCK}
_NO_LINKS = _NOT_SUPPORTED | {errno.EPERM, errno.EMLINK}
_NOTE_SUFFIX = ".note"
_MOST_HOLDER = 400
"""Bytes that are read of what a lock file says."""
_CREATE_LOCK, _CREATE_WAIT_S = f"{TEMPORARY_PREFIX}create.lock", 60.0

DAY_S = 24 * 3600.0
"""What a process of another machine or boot left counts as abandoned after so long; nothing is written for a day."""

logger = logging.getLogger(__name__)


def write_durably(path: Path, data: bytes, *, forced: bool = True) -> None:
    """Write a new file and force it to the disk; not atomic, so for places that nobody reads yet.

    Args:
        path: the file.
        data: its bytes.
        forced: whether to wait until the disk has it.

    Raises:
        OSError: the file exists already, or cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        _write_all(descriptor, data)
        if forced:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_new_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make a folder with files, by relative path, and force all of it to the disk; not atomic, as `write_durably`."""
    folder.mkdir(parents=True)
    folders = {folder}
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, data)
        folders |= {parent for parent in path.parents if parent.is_relative_to(folder)}
    for parent in sorted(folders, reverse=True):
        sync_folder(parent)


def _write_all(descriptor: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        # The system may take less than it is given, and says so by the count alone.
        taken = os.write(descriptor, left)
        if taken == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        left = left[taken:]


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it; of one that is there, what killed writers left is removed.

    Raises:
        UsageError: something else has its name, or it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: no folder can be made of this name ({error.strerror}); name another") from None
    remove_remnants(path)


@contextmanager
def scratch_folder(purpose: str) -> Iterator[Path]:
    """A folder of this user alone below TMPDIR for as long as the context; what killed processes left is removed first.

    Args:
        purpose: a part of its name.
    """
    place = Path(tempfile.gettempdir())
    remove_remnants(place)
    folder = place / temporary_name(f"adaafford-{purpose}")
    folder.mkdir(0o700)
    try:
        yield folder
    finally:
        remove_tree(folder)


@contextmanager
def writing(path: Path, advice: str = "name another place") -> Iterator[None]:
    """Write what a user named.

    Raises:
        UsageError: the system refuses; the message ends with the advice.
    """
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}); {advice}") from None


def sync_file(path: Path) -> None:
    """Force a file that others wrote to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Force a folder's entries (creations, renames) to the disk, where the file system can do that."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NOT_SUPPORTED:
            raise
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Force what others wrote into a folder to the disk, at every depth."""
    for path in folder.rglob("*"):
        (sync_folder if path.is_dir() else sync_file)(path)
    sync_folder(folder)


def write_atomically(path: Path, data: bytes, *, forced: bool = True) -> None:
    """Put `data` at `path`, replacing what was there: a reader finds the old bytes or the new, after any crash.

    Args:
        path: the file. What killed writers left beside it is removed when a process first writes there.
        data: its bytes.
        forced: whether to wait until the disk has it; otherwise a power cut may lose the new bytes and the old ones.
    """
    remove_remnants_once(path.parent)
    temporary = path.parent / temporary_name(path.name)
    with _naming(path):
        try:
            write_durably(temporary, data, forced=forced)
            temporary.rename(path)
        finally:
            temporary.unlink(missing_ok=True)
        if forced:
            sync_folder(path.parent)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Errors of the system name this file: by themselves they name a temporary one, or none if a disk is full."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


def create_exclusively(path: Path, data: bytes) -> bool:
    """Put `data` at `path` unless something is there: whole or not at all, and by one of several writers only.

    What killed writers left beside it is removed when a process first writes there.

    Returns:
        Whether this call made the file.
    """
    remove_remnants_once(path.parent)
    temporary = path.parent / temporary_name(path.name)
    with _naming(path):
        try:
            write_durably(temporary, data)
            made = _take_name(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        if made:
            sync_folder(path.parent)
    return made


def _take_name(temporary: Path, path: Path) -> bool:
    """Give a finished file its name, if that is free."""
    try:
        # A hard link fails where the name exists, which rename would silently replace.
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        with exclusive_lock(path.parent / _CREATE_LOCK, _CREATE_WAIT_S):
            if path.exists():
                return False
            temporary.rename(path)
    return True


def read_bounded(path: Path, limit: int) -> bytes:
    """The bytes of a regular file of at most `limit` bytes.

    Raises:
        MissingError: there is no such file.
        StoreError: it is no regular file (a link or a pipe, say), or larger.
        UnreadableError: the system refuses to read it.
    """
    try:
        # A link could lead anywhere.
        data = _read_regular(path, limit, os.O_NOFOLLOW)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingError(f"{path}: cannot be read (it is missing); restore the file from a copy") from None
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise StoreError(f"{path}: cannot be read ({error.strerror}); restore the file from a copy") from None
        raise unreadable(path, error) from None
    if data is None:
        raise StoreError(f"{path}: not a regular file; restore it from a copy")
    if len(data) > limit:
        raise StoreError(f"{path}: larger than the {limit} bytes that it may have; the file is foreign or damaged")
    return data


def unreadable(path: Path, error: OSError) -> UnreadableError:
    """What to say when the system refuses to read a file or a folder."""
    advice = (
        "ask its owner for read permission"
        if isinstance(error, PermissionError)
        else "check the disk or the network, then repeat the command"
    )
    return UnreadableError(f"{path}: cannot be read ({error.strerror or error}); {advice}")


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
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            return None
        # No larger pieces than the file needs: as much memory is taken as is asked for.
        return _read_all(descriptor, limit + 1, min(found.st_size + 1, 1 << 24))
    finally:
        os.close(descriptor)


def _read_all(descriptor: int, limit: int, most: int) -> bytes:
    pieces = []
    while limit > 0 and (piece := os.read(descriptor, min(limit, most))):
        pieces.append(piece)
        limit -= len(piece)
    return b"".join(pieces)


DRIVER_LOCK = ".lock-driver"
"""What a driver holds of its run or learner's folder: two of them would do everything twice."""


@contextmanager
def exclusive_lock(path: Path, wait_seconds: float = 0.0) -> Iterator[None]:
    """Hold a file's lock; the kernel gives it back when the holder dies, however it dies.

    Where the file system knows no locks, a second file, which only one process can create, takes the lock's place. It
    names its holder and is taken over once that process has ended on this machine; of a holder on another machine that
    cannot be told, so the user is asked.

    Args:
        path: the lock file; it is made where missing, and stays.
        wait_seconds: how long to wait for another holder.

    Raises:
        UsageError: another process holds it; the message names that process.
    """
    deadline = time.monotonic() + wait_seconds
    note = path.with_name(f"{path.name}{_NOTE_SUFFIX}")
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        if _acquire(descriptor, path, deadline):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, _holder().encode(), 0)
            try:
                # Of another machine, say, for which the same file system has no locks.
                _wait_for_note(note, deadline)
                yield
            finally:
                os.ftruncate(descriptor, 0)
        else:
            logger.info("%s: this file system knows no locks; the file %s takes their place", path.parent, note.name)
            own = _write_note(note, deadline)
            try:
                _refuse_if_held(path, os.pread(descriptor, _MOST_HOLDER, 0).decode(errors="replace"))
                yield
            finally:
                if _read_note(note) == own:
                    note.unlink(missing_ok=True)
    finally:
        # Closing gives the lock back. The file stays: unlinking it would let two processes lock two files of one name.
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, deadline: float) -> bool:
    """Take the kernel's lock; False where the file system has none."""
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return False
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
        if time.monotonic() >= deadline:
            raise _in_use(path, os.pread(descriptor, _MOST_HOLDER, 0).decode(errors="replace"))
        time.sleep(_LOCK_POLL_S)


def _write_note(note: Path, deadline: float) -> str:
    """Create the file that stands for a lock, or wait for it; returns its content."""
    own = f"{_holder()}\n{secrets.token_hex(8)}"
    while True:
        try:
            descriptor = os.open(note, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        except FileExistsError:
            _wait_for_note(note, deadline)
            continue
        try:
            _write_all(descriptor, own.encode())
        except OSError:
            note.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)
        return own


def _wait_for_note(note: Path, deadline: float) -> None:
    """Wait until no live process holds a lock by this file; one that is left of a dead process is removed."""
    while (held := _read_note(note)) is not None:
        if is_gone(_process_of(held)):
            _remove_note(note, held)
        elif time.monotonic() >= deadline:
            raise _in_use(note, held, f", or remove {note} if you know that it has ended")
        time.sleep(_LOCK_POLL_S)


def _remove_note(note: Path, held: str) -> None:
    """Remove what a dead process left; of several that would do so, one does, and none removes another's new file."""
    guard = note.with_name(f"{note.name}.clearing")
    try:
        os.close(os.open(guard, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except FileExistsError:
        if time.time() - guard.lstat().st_mtime > DAY_S:
            raise UsageError(f"{guard}: left by a process that was killed; remove it and try again") from None
        return
    try:
        if _read_note(note) == held:
            note.unlink(missing_ok=True)
    finally:
        guard.unlink(missing_ok=True)


def _read_note(note: Path) -> str | None:
    try:
        descriptor = os.open(note, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return None
    try:
        return os.read(descriptor, _MOST_HOLDER).decode(errors="replace")
    finally:
        os.close(descriptor)


def _refuse_if_held(path: Path, held: str) -> None:
    """Refuse a lock whose file names a process that may hold it by the kernel's lock, on another machine."""
    if held and not is_gone(_process_of(held)):
        raise _in_use(path, held, f", or empty {path} if you know that it has ended")


def _holder() -> str:
    """What a lock file says of its holder: a line for people, and the process's name."""
    return f"{os.getpid()} on {host_name()}\n{process_name()}"


def _process_of(held: str) -> str:
    lines = held.splitlines()
    return lines[1] if len(lines) > 1 else ""


def _in_use(path: Path, held: str, otherwise: str = "") -> UsageError:
    holder = plain((held.splitlines() or [""])[0]) or "unknown"
    return UsageError(f"{path.parent} is in use by process {holder}; wait for it or stop it{otherwise}")


def host_name() -> str:
    """This machine's name, in characters that a file name may hold."""
    return re.sub(r"[^A-Za-z0-9.-]", "_", socket.gethostname())[:64]


@cache
def machine_name() -> str:
    """This machine since its last start, as no other is called and without telling its name; for files.

    Two machines may have one name, and both the same disk; the boot id is a random number of each start of each.
    """
    try:
        boot = _BOOT_ID.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        boot = host_name()
    return hashlib.sha256(f"adaafford {boot}".encode()).hexdigest()[:16]


@cache
def _process_space() -> str:
    """What process ids are unique within: the machine's boot, and the namespace, of which each container has one."""
    try:
        namespace = re.sub(r"\D", "", Path("/proc/self/ns/pid").readlink().name)
    except OSError:
        namespace = "0"
    return f"{machine_name()}-{namespace}"


def process_name() -> str:
    """This process, as no other is called, on any machine: what its files can be named by."""
    process = os.getpid()
    return f"{_process_space()}~{process}~{_start_ticks(process)}"


def is_gone(process: str) -> bool:
    """Whether the process of this `process_name` has ended for certain; one on another machine may be alive."""
    match = _PROCESS_NAME.fullmatch(process)
    if match is None or match["space"] != _process_space():
        return False
    return not _is_running(int(match["pid"]), int(match["start"]))


def end_if_here(process: str) -> None:
    """Kill the process of this `process_name` if it is one of this machine's."""
    match = _PROCESS_NAME.fullmatch(process)
    if match is not None and match["space"] == _process_space() and not is_gone(process):
        os.kill(int(match["pid"]), signal.SIGKILL)


def temporary_name(name: str) -> str:
    """A unique name for a temporary file or folder that will become `name`, and that says who made it."""
    return f"{TEMPORARY_PREFIX}{name}~{process_name()}~{secrets.token_hex(6)}"


def remove_if_abandoned(path: Path) -> bool:
    """Remove a temporary file or folder whose writer is dead; leave one that is, or may be, still written.

    A writer on another machine or in another container may be alive, so its remnants stay for a day.

    Returns:
        Whether it was removed.
    """
    match = _TEMPORARY_NAME.fullmatch(path.name)
    if match is None or not is_abandoned(path, match["process"], DAY_S):
        return False
    remove_tree(path)
    return True


def remove_remnants(folder: Path) -> None:
    """Remove the temporary files and folders in `folder` whose writers are dead (see `remove_if_abandoned`)."""
    for remnant in folder.glob(f"{TEMPORARY_PREFIX}*"):
        # Those of other users may not be removable, which is no reason not to work here.
        with suppress(OSError):
            remove_if_abandoned(remnant)


@cache
def remove_remnants_once(folder: Path) -> None:
    """`remove_remnants`, for those who write many files: to list a large folder for each takes long."""
    remove_remnants(folder)


def is_abandoned(path: Path, process: str, after_s: float) -> bool:
    """Whether the process that made a file has ended, or may only be judged by the file, which is older than that."""
    match = _PROCESS_NAME.fullmatch(process)
    if match is None or match["space"] == _process_space():
        return is_gone(process)
    try:
        return time.time() - path.lstat().st_mtime > after_s
    except OSError:
        return False


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
