"""Storage backends: a folder of a disk, or a prefix of a bucket; files are named by key, such as "shards/x/y".

backend = backend_of("s3://bucket/prefix")   # or a folder
backend.read("store.json", limit=1 << 20)
backend.publish(Transaction(...))            # a folder of files: all or nothing, and once
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
    """The publication of a folder, which becomes complete when its last file, the mark, is written.

    Attributes:
        folder: key of the folder.
        files: all files but the mark, by path within the folder.
        mark: path of the mark within the folder.
        describe: makes the content of the mark from the files that are stored. These are `files`, or, in a backend
            without rename, files that another writer stored first. Raises StoreError if they cannot be used.
        check: raises StoreError if the folder may not be published.
        lock: writers with the same lock take turns for the last step, in a backend with locks.
    """

    folder: str
    files: Mapping[str, bytes]
    mark: str
    describe: Callable[[Mapping[str, bytes]], bytes]
    check: Callable[[], None]
    lock: str


class StorageBackend(Protocol):
    """Reads and writes files by key.

    Data are never overwritten, and only leftovers of dead writers are deleted. Files about the present state
    (`replace`, `remove`), which are no data, have a separate folder.
    """

    where: str
    """Its name in messages: a folder or a URL."""
    writes_in_place: bool
    """Whether a live writer may still complete a folder that has no mark."""

    def is_there(self) -> bool:
        """Whether the folder or the bucket exists, as far as this is known."""
        ...

    def read(self, key: str, limit: int) -> bytes:
        """A file of at most `limit` bytes.

        Raises:
            MissingError: it does not exist.
            StoreError: it is larger, or not a regular file.
            UnreadableError: the disk, the network or the server refuses; all other methods may raise this, too.
        """
        ...

    def read_all(self, wanted: Sequence[tuple[str, int]]) -> Iterator[bytes]:
        """Several files, given as (key, limit), in this order, concurrently if that is faster; raises like `read`."""
        ...

    def exists(self, key: str) -> bool:
        """Whether the file exists."""
        ...

    def exist(self, keys: Sequence[str]) -> Iterator[bool]:
        """Whether the files exist, in the order of `keys`, concurrently if that is faster."""
        ...

    def names(self, folder: str) -> list[str]:
        """Sorted names of the entries of a folder ("" is the store itself); empty if the folder does not exist."""
        ...

    def names_from(self, folder: str, first: str) -> Iterator[str]:
        """Sorted names of the entries of a folder from `first` on, listed lazily."""
        ...

    def leaves(self, folder: str) -> list[str]:
        """Sorted keys of all files and empty folders below a folder."""
        ...

    def create(self, key: str, data: bytes) -> bool:
        """Write a file atomically unless it exists; returns whether this call created it."""
        ...

    def replace(self, key: str, data: bytes) -> None:
        """Write a file atomically, also over an existing one; for files about the present state, never for data.

        Raises:
            StoreError: the backend cannot be reached.
            OSError: the file cannot be written.
        """
        ...

    def remove(self, key: str) -> None:
        """Remove a file that `replace` wrote, if it exists."""
        ...

    def publish(self, transaction: Transaction) -> bool:
        """Publish a folder with its mark unless it is complete already; returns whether this call did it.

        Raises:
            StoreError: the folder may not be published, or the backend cannot be reached.
        """
        ...

    def move(self, key: str, new: str) -> None:
        """Move a damaged file or folder to an unused key; after an interruption, a second call completes the move."""
        ...

    def sweep(self, folders: Sequence[str]) -> int:
        """Remove unfinished files of dead writers in some folders; returns how many."""
        ...

    def only_one(self, name: str, *, alone: bool = False) -> AbstractContextManager[Any]:
        """Hold a lock.

        Args:
            name: of the lock.
            alone: whether no other process may hold it; otherwise a backend without locks allows several holders.

        Raises:
            UsageError: another process holds it; the message names that process.
        """
        ...


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder of a storage backend; as text, its name in messages."""

    backend: StorageBackend
    key: str

    @property
    def name(self) -> str:
        """The last part of its key."""
        return self.key.rpartition("/")[2]

    def __str__(self) -> str:
        return f"{self.backend.where}/{self.key}"

    def has(self, name: str) -> bool:
        """Whether it has a file."""
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
    """Whether this is a URL, allowed or not, and not a folder."""
    return isinstance(where, str) and "://" in where


def backend_of(where: str | Path) -> StorageBackend:
    """The storage backend for the path of a folder or for "s3://bucket/prefix".

    Raises:
        UsageError: the URL is not allowed, or credentials are missing.
    """
    if is_url(where):
        from shared.store.backends.s3 import S3Backend

        return S3Backend.of(str(where))
    if isinstance(where, Path) and where.parts[:1] == ("s3:",):
        raise UsageError(f"{where}: a path cannot hold the two slashes of a URL; give s3://BUCKET/PREFIX as text")
    from shared.store.backends.local import LocalBackend

    return LocalBackend(Path(where))


def folder_beside(where: str, suffix: str) -> Path:
    """A folder for what belongs to a store: beside it, or in the working folder if the store is in a bucket."""
    if is_url(where):
        return Path.cwd() / f"{where.rstrip('/').rpartition('/')[2]}-{suffix}"
    return Path(f"{where}-{suffix}")


def absolute(where: str) -> str:
    """A folder's path made absolute, for processes that work elsewhere; URLs stay."""
    return where if is_url(where) else str(Path(where).resolve())
