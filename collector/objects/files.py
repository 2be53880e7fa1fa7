"""Reading of untrusted files of an object: only regular files of bounded size within the folder of objects."""

import hashlib
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from shared.errors import ObjectError
from shared.io.text import short

_GITFILE = b"gitdir: "
_MOST_GITFILE = 4096
# What stands in a file whose contents were not downloaded, and the command that gets them. Where links cannot be made,
# git-annex writes the path that the link would have.
_POINTERS = (
    (re.compile(rb"version https://git-lfs\.github\.com/spec/"), "Git LFS", "git lfs pull"),
    (re.compile(rb"(?:[./]*\.git\S*)?/annex/objects/"), "git-annex", "git annex get"),
)


def add_framed(digest: Any, *parts: bytes) -> None:
    """Add parts to a hash with their lengths, so that the hash depends on their boundaries."""
    for part in parts:
        digest.update(len(part).to_bytes(8, "big"))
        digest.update(part)


class ObjectFiles:
    """The files below one object's folder.

    Files may be links, but only to files below the object's folder, below the tree of objects that the user named, or
    in the cache of a download that this tree is part of (`_caches`), because the folder is untrusted and must not give
    access to other files of this machine.

    Args:
        folder: of the object, or a link to it.
        tree: the folder of objects that the user named; default: the object's folder.

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
        # What an object brings along is not trusted to be a cache.
        within = top.parents if top == own else (top, *top.parents)
        self._read_so_far: dict[str, bytes] = {}
        self.asked: set[str] = set()
        """Names that anything was asked of: what the object is depends on these files, and on their being there."""
        self._roots = (own, top, *(cache for above in within for cache in _caches(above, top)))

    def exists(self, name: str) -> bool:
        """Whether an entry `name` exists, also if it is a dangling link."""
        return os.path.lexists(self._path(name))

    def is_file(self, name: str) -> bool:
        """Whether `name` is a plain path to a regular file, or a link to any regular file."""
        try:
            return self._path(name).is_file()
        except (OSError, ObjectError):
            return False

    def read(self, name: str, most_bytes: int) -> bytes:
        """The bytes of the file called `name`, a path relative to the folder.

        Raises:
            ObjectError: it is missing, not a regular file, outside of the folder, unreadable, larger than `most_bytes`,
                or a pointer to contents that were not downloaded.
        """
        path = self._path(name)
        try:
            resolved = path.resolve(strict=True)
            if not any(resolved.is_relative_to(root) for root in self._roots):
                raise ObjectError(
                    f"{self.folder}: {short(name)} is a link that leads out of the folder of objects, so it is not "
                    "followed; if you trust it, copy the objects with their links followed (`cp -rL FROM TO`)"
                )
            data = self._read(resolved, name, most_bytes)
        except FileNotFoundError:
            what = "is missing; docs/objects.md has the layout"
            if path.is_symlink():
                what = (
                    "is a link to a file that is not there, so the download is not complete; get its contents "
                    "(`git annex get`, `dvc pull`)"
                )
            raise ObjectError(f"{self.folder}: {short(name)} {what}") from None
        except (OSError, RuntimeError) as error:
            # Of a link that leads to itself, Python before 3.13 raises a RuntimeError.
            reason = getattr(error, "strerror", None) or "Too many levels of symbolic links"
            raise ObjectError(f"{self.folder}: {short(name)} cannot be read ({reason})") from None
        for pattern, system, command in _POINTERS:
            if pattern.match(data):
                raise ObjectError(
                    f"{self.folder}: {short(name)} is a pointer of {system} instead of the file, so the download is "
                    f"not complete; get the contents of all files (`{command}`)"
                )
        self._read_so_far[name] = hashlib.sha256(data).digest()
        return data

    def digest(self) -> str:
        """SHA-256 of the names and contents of all files that were read."""
        digest = hashlib.sha256()
        for name, content in sorted(self._read_so_far.items()):
            add_framed(digest, name.encode("utf-8", "surrogatepass"), content)
        return digest.hexdigest()

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
        self.asked.add(name)
        return self.folder / relative


def _caches(above: Path, top: Path) -> Iterator[Path]:
    """Where git-annex, DVC and a model hub's client keep what they show as links in the tree at `top`, below `above`.

    None of them is around the tree. One that is a link itself, as to a larger disk, counts only as far as it leads into
    the `.git` of a repository around the tree, as that of a submodule does: the link came with the objects, and could
    make any folder of this machine a cache.
    """
    caches = [_git_folder(above) / "annex/objects", above / ".dvc/cache"]
    # A hub's client has its links below `snapshots`, beside `blobs`; the others have theirs anywhere in a repository.
    if top.is_relative_to(above / "snapshots"):
        caches.append(above / "blobs")
    for cache in caches:
        try:
            resolved = cache.resolve(strict=True)
        except (OSError, RuntimeError, ValueError):
            continue
        inside = resolved.is_relative_to(above) or any(resolved.is_relative_to(p / ".git") for p in above.parents)
        if inside and not top.is_relative_to(resolved):
            yield resolved


def _git_folder(repository: Path) -> Path:
    """Where Git keeps its own files of a repository: of a submodule or a worktree, `.git` is a file that names it."""
    folder = repository / ".git"
    try:
        if folder.is_file():
            with folder.open("rb") as file:
                named = file.read(_MOST_GITFILE)
            if named.startswith(_GITFILE):
                return repository / os.fsdecode(named.removeprefix(_GITFILE).rstrip(b"\r\n"))
    except OSError:
        pass
    return folder
