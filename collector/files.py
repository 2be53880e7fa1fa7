"""Reading the files of an object's folder, which came from outside: regular, small enough, and in their place."""

import os
import stat
from pathlib import Path

from shared.errors import ObjectError

CACHES = ("blobs", ".git/annex/objects", ".dvc/cache")
"""Where a model hub's client, git-annex and DVC keep the contents of files that they show as links."""


def short(text: object, length: int = 80) -> str:
    """`text` as it may stand in a one-line message: quoted, without control characters, not too long."""
    quoted = repr(str(text)[: length + 1])
    return quoted if len(quoted) <= length + 2 else quoted[:length] + "...'"


class ObjectFiles:
    """The files below one object's folder.

    Files may be links, as in the cache of a download, but only to files below the object's folder, below the tree of
    objects that the user named, or in the cache that this tree is part of (`CACHES`): the folder may come from anybody,
    and no file elsewhere on this machine is any of its business.

    Args:
        folder: of the object, or a link to it.
        tree: the folder of objects that the user named; the object's own where none is given.

    Example:
        >>> files = ObjectFiles(Path("objects/149"), Path("objects"))
        >>> urdf = files.read("mobility.urdf", 2 << 20)
    """

    def __init__(self, folder: Path, tree: Path | None = None) -> None:
        if not folder.is_dir():
            raise ObjectError(f"{folder}: no such folder; name an object's folder that holds mobility.urdf")
        self.folder = folder
        own = folder.resolve()
        top = own if tree is None else tree.resolve()
        caches = [above / name for above in top.parents for name in CACHES if _keeps(above, name, top)]
        self._roots = (own, top, *caches)

    def exists(self, name: str) -> bool:
        """Whether there is something called `name`, if only a link that leads nowhere."""
        return os.path.lexists(self._path(name))

    def is_file(self, name: str) -> bool:
        """Whether `name` is a plain path to a regular file, or a link to one, wherever that may lead."""
        try:
            return self._path(name).is_file()
        except (OSError, ObjectError):
            return False

    def read(self, name: str, most_bytes: int) -> bytes:
        """The bytes of the file called `name`, a path relative to the folder.

        Raises:
            ObjectError: it is missing, no regular file, out of its place, unreadable or over `most_bytes`.
        """
        path = self._path(name)
        try:
            resolved = path.resolve(strict=True)
            if not any(resolved.is_relative_to(root) for root in self._roots):
                raise ObjectError(
                    f"{self.folder}: {short(name)} is a link that leads out of the folder of objects, so it is not "
                    "followed; if you trust it, copy the objects with their links followed (`cp -rL FROM TO`)"
                )
            return self._read(resolved, name, most_bytes)
        except FileNotFoundError:
            what = "is a link to a file that is not there" if path.is_symlink() else "is missing"
            raise ObjectError(f"{self.folder}: {short(name)} {what}; docs/objects.md has the layout") from None
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or type(error).__name__
            raise ObjectError(f"{self.folder}: {short(name)} cannot be read ({reason})") from None

    def _read(self, resolved: Path, name: str, most_bytes: int) -> bytes:
        # A link that was put there since is not followed, and a pipe does not block.
        descriptor = os.open(resolved, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise ObjectError(f"{self.folder}: {short(name)} is not a regular file")
            if status.st_size > most_bytes:
                raise ObjectError(f"{self.folder}: {short(name)} has {status.st_size} bytes; at most {most_bytes}")
            return file.read(most_bytes)

    def _path(self, name: str) -> Path:
        relative = Path(name)
        if not name or "\0" in name or "\\" in name or relative.is_absolute() or ".." in relative.parts:
            raise ObjectError(f"{self.folder}: {short(name)} is not a plain path below the object's folder")
        return self.folder / relative


def _keeps(above: Path, cache: str, top: Path) -> bool:
    """Whether a folder of contents that is called `cache` is that of the tree at `top`, somewhere below `above`."""
    # A hub's client has its links below `snapshots`, beside `blobs`; the others have theirs anywhere in a repository.
    return (cache != "blobs" or top.is_relative_to(above / "snapshots")) and (above / cache).is_dir()
