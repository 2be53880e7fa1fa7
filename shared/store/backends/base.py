"""Where a store lies: a folder of a disk, or a prefix of a bucket; files are named by key, such as "shards/x/y".

backend = backend_of("s3://bucket/prefix")   # or a folder
place.read("store.json", limit=1 << 20)
backend.publish(Transaction(...))           # a folder of files: wholly or not at all, and once
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from shared.errors import UsageError

URL_SCHEME = "s3://"


@dataclass(frozen=True, slots=True)
class Transaction:
    """A folder that comes to be there as a whole, by one file of it, the mark, that is written last.

    Attributes:
        folder: its key.
        files: by path within it, all but the mark.
        mark: path of the mark within the folder.
        describe: the mark's content, for the files as they lie there: those given, or, where another writer was faster
            with some of them in a place that has no rename, that writer's. Raises StoreError where these will not do.
        check: raises StoreError if the folder may not be published after all.
        lock: writers of the same name take turns for the last step, where a place has locks.
    """

    folder: str
    files: Mapping[str, bytes]
    mark: str
    describe: Callable[[Mapping[str, bytes]], bytes]
    check: Callable[[], None]
    lock: str


class StorageBackend(Protocol):
    """Files by key.

    No data that are there are ever overwritten, and nothing is deleted but remnants of dead writers; what tells of the
    moment (`replace`, `remove`) lies in a folder of its own.
    """

    where: str
    """What people call it: a folder or a URL."""
    writes_in_place: bool
    """Whether a folder without its mark may be one that a live writer is about to finish."""

    def is_there(self) -> bool:
        """Whether the place itself is, as far as that can be told."""
        ...

    def read(self, key: str, limit: int) -> bytes:
        """A file of at most `limit` bytes.

        Raises:
            MissingError: there is none.
            StoreError: it is larger, or no regular file.
            UnreadableError: the disk, the network or the server refuses; so may all that follows here.
        """
        ...

    def read_all(self, wanted: Sequence[tuple[str, int]]) -> Iterator[bytes]:
        """Several files, each given as key and limit, in order; at once where that is faster. Raises as `read` does."""
        ...

    def exists(self, key: str) -> bool:
        """Whether there is such a file."""
        ...

    def exist(self, keys: Sequence[str]) -> Iterator[bool]:
        """Whether there are such files, in order; at once where that is faster."""
        ...

    def names(self, folder: str) -> list[str]:
        """What lies directly in a folder ("" is the store itself), in order; nothing if the folder is not there."""
        ...

    def names_from(self, folder: str, first: str) -> Iterator[str]:
        """What lies directly in a folder and is not before `first`, in order, asked for as it is consumed."""
        ...

    def leaves(self, folder: str) -> list[str]:
        """Keys of everything below a folder that holds nothing itself, in order."""
        ...

    def create(self, key: str, data: bytes) -> bool:
        """Put a file there, wholly or not at all, unless there is one; returns whether this call made it."""
        ...

    def replace(self, key: str, data: bytes) -> None:
        """Put a file there, wholly or not at all, over what was there; for what tells of the moment, never for data.

        Raises:
            StoreError: the place is out of reach.
            OSError: the file cannot be written.
        """
        ...

    def remove(self, key: str) -> None:
        """Remove such a file; it is no error if there is none."""
        ...

    def publish(self, transaction: Transaction) -> bool:
        """Put a folder there unless it is there, with its mark; returns whether this call did it.

        Raises:
            StoreError: it may not be published, or the place is out of reach.
        """
        ...

    def move(self, key: str, new: str) -> None:
        """Give a file or folder another key, which nothing has; for what is broken. Called again, it goes on."""
        ...

    def sweep(self, folders: Sequence[str]) -> int:
        """Remove what dead writers left unfinished directly in some folders; returns how many."""
        ...

    def only_one(self, name: str, *, alone: bool = False) -> AbstractContextManager[Any]:
        """Hold the place against other holders of the same name.

        Args:
            name: what is held.
            alone: whether there must be no other at all; a place without locks takes several holders otherwise.

        Raises:
            UsageError: another process holds it; the message names that process.
        """
        ...


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder of a place; as text, what messages call it."""

    backend: StorageBackend
    key: str

    @property
    def name(self) -> str:
        """The last part of its key."""
        return self.key.rpartition("/")[2]

    def __str__(self) -> str:
        return f"{self.backend.where}/{self.key}"

    def has(self, name: str) -> bool:
        """Whether it holds a file."""
        return self.backend.exists(f"{self.key}/{name}")

    def read(self, name: str, limit: int) -> bytes:
        """One of its files; see `StorageBackend.read`."""
        return self.backend.read(f"{self.key}/{name}", limit)

    def read_all(self, wanted: Sequence[tuple[str, int]]) -> Iterator[bytes]:
        """Several of its files; see `StorageBackend.read_all`."""
        return self.backend.read_all([(f"{self.key}/{name}", limit) for name, limit in wanted])

    def sub(self, name: str) -> "Folder":
        """A folder in it."""
        return Folder(self.backend, f"{self.key}/{name}")


def is_url(where: str | Path) -> bool:
    """Whether this names an object store, or tries to, and not a folder."""
    return isinstance(where, str) and "://" in where


def backend_of(where: str | Path) -> StorageBackend:
    """The place that a folder's path or an "s3://bucket/prefix" names.

    Raises:
        UsageError: a URL that is not allowed, or credentials that are missing.
    """
    if is_url(where):
        from shared.store.backends.s3 import BucketPlace

        return BucketPlace.of(str(where))
    if isinstance(where, Path) and where.parts[:1] == ("s3:",):
        raise UsageError(f"{where}: a path cannot hold the two slashes of a URL; give s3://BUCKET/PREFIX as text")
    from shared.store.backends.local import DiskPlace

    return DiskPlace(Path(where))


def folder_beside(where: str, suffix: str) -> Path:
    """A folder for what belongs to a store: beside it, or in the working folder if the store is in a bucket."""
    if is_url(where):
        return Path.cwd() / f"{where.rstrip('/').rpartition('/')[2]}-{suffix}"
    return Path(f"{where}-{suffix}")


def absolute(where: str) -> str:
    """A folder's path made absolute, for processes that work elsewhere; URLs stay."""
    return where if is_url(where) else str(Path(where).resolve())
