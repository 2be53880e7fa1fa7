"""A folder of this user alone for what only this machine keeps, where other users may write beside it.

TMP/adaafford-<user id>/         mode 0700
    ray/<session>/               a Ray session's sockets and logs, as long as its driver lives
    underway-<hash>/             crash logs of workers on a bucket's store
    pieces/, numba/              decomposed meshes and compiled functions, where there is no cache folder
"""

import os
import stat
from contextlib import suppress
from pathlib import Path

from shared.errors import UsageError

LONGEST = 32
"""Bytes of the folder's path: those of Ray's sockets may have 107 in all, of which Ray's own names take 64."""

_TEMPORARY = ("/tmp", "/var/tmp", "/dev/shm")  # noqa: S108 -- what is there is checked.


def private_folder(name: str) -> Path:
    """The folder `name` within this user's own, both made where missing; below TMPDIR if that will do, else /tmp.

    The name can be guessed, so another user may have made something there: what is not a folder of this user, or lets
    others in, is passed over.

    Raises:
        UsageError: there is no place for it.
    """
    refusals = []
    for base in dict.fromkeys((os.environ.get("TMPDIR", ""), *_TEMPORARY)):
        own = Path(base, f"adaafford-{os.geteuid()}")
        refusal = _refusal(own)
        if refusal is None:
            with suppress(FileExistsError):
                (own / name).mkdir(0o700)
            return own / name
        if base:
            refusals.append(f"{own}: {refusal}")
    raise UsageError(
        f"there is no place for temporary files of this user alone ({'; '.join(refusals)}); "
        f"set TMPDIR to a folder that you may write to, of at most {LONGEST - len(own.name) - 1} letters"
    )


def cache_folder(name: str) -> Path:
    """The folder `name` of our caches: below $XDG_CACHE_HOME or ~/.cache, or else in this user's temporary folder.

    Raises:
        UsageError: none of them can be written.
    """
    # Without a home this gives "~", a relative path.
    home = Path(os.environ.get("HOME", os.path.expanduser("~")))  # noqa: PTH111
    for base in (Path(os.environ.get("XDG_CACHE_HOME", "")), home / ".cache"):
        folder = base / "adaafford" / name
        # The specification has relative paths ignored.
        if folder.is_absolute() and _can_be_written(folder):
            return folder
    try:
        return private_folder(name)
    except UsageError as error:
        raise UsageError(f"{error}, or XDG_CACHE_HOME to one for caches") from None


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _refusal(own: Path) -> str | None:
    """Why a folder, which is made where missing, is not to be used; None if it is safe."""
    if not own.is_absolute():
        return "not an absolute path"
    if len(os.fsencode(own)) > LONGEST:
        return "too long for sockets"
    try:
        above = own.parent.stat().st_mode
        if above & 0o022 and not above & stat.S_ISVTX:
            # They could put something else in its place at any time.
            return "others may rename it"
        with suppress(FileExistsError):
            own.mkdir(0o700)
        found = own.lstat()
    except OSError as error:
        return error.strerror
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        return "not a folder of this user alone"
    return None if os.access(own, os.W_OK | os.X_OK) else "cannot be written"
