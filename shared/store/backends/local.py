"""The storage backend for a folder of a disk: files are written under a temporary name, synced and renamed."""

import errno
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath

from shared.errors import StoreError, UsageError
from shared.io.files import (
    TEMPORARY_PREFIX,
    create_exclusively,
    exclusive_lock,
    read_bounded,
    remove_if_abandoned,
    remove_remnants_once,
    remove_tree,
    sync_folder,
    temporary_name,
    unreadable,
    write_atomically,
    write_durably,
    write_new_folder,
)
from shared.store.backends.base import StorageBackend, Transaction
from shared.store.layout import LOCK_PREFIX

_LOCK_WAIT_S = 60.0
"""Locks are held for milliseconds; one that lasts longer means a hung disk."""


class LocalBackend(StorageBackend):
    """A folder of a disk."""

    writes_in_place = False

    def __init__(self, root: Path) -> None:
        self.root = root
        self.where = str(root)

    def is_there(self) -> bool:
        return stat.S_ISDIR(_mode(self.root))

    def read(self, key: str, limit: int) -> bytes:
        """See `StorageBackend.read`; symbolic links below the first level are refused."""
        parts = PurePosixPath(key).parts
        for depth in range(2, len(parts)):
            # A link could lead anywhere. The first level may be one, for example to a separate disk for the shards.
            if stat.S_ISLNK(_mode(self.root.joinpath(*parts[:depth]), follow=False)):
                raise StoreError(f"{self._at(key)}: reached through a symbolic link; replace it by the folder itself")
        return read_bounded(self._at(key), limit)

    def read_all(self, wanted: Sequence[tuple[str, int]]) -> Iterator[bytes]:
        return (self.read(key, limit) for key, limit in wanted)

    def exists(self, key: str) -> bool:
        return _mode(self._at(key)) != 0

    def exist(self, keys: Sequence[str]) -> Iterator[bool]:
        return map(self.exists, keys)

    def names(self, folder: str) -> list[str]:
        path = self._at(folder)
        if not stat.S_ISDIR(_mode(path)):
            return []
        try:
            return sorted(os.listdir(path))  # noqa: PTH208 - twice as fast, and there may be millions.
        except OSError as error:
            raise unreadable(path, error) from None

    def names_from(self, folder: str, first: str) -> Iterator[str]:
        """See `StorageBackend.names_from`; a disk has no order of names, so all are listed."""
        return (name for name in self.names(folder) if name >= first)

    def leaves(self, folder: str) -> list[str]:
        found = []
        left = [folder] if stat.S_ISDIR(_mode(self._at(folder))) else []
        while left:
            inner = left.pop()
            names = self.names(inner)
            if not names and inner != folder:
                found.append(inner)
            for name in names:
                key = f"{inner}/{name}"
                (left if stat.S_ISDIR(_mode(self._at(key), follow=False)) else found).append(key)
        return sorted(found)

    def create(self, key: str, data: bytes) -> bool:
        path = self._at(key)
        if _mode(path):
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        return create_exclusively(path, data)

    def replace(self, key: str, data: bytes) -> None:
        path = self._at(key)
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, data)

    def remove(self, key: str) -> None:
        self._at(key).unlink(missing_ok=True)

    def publish(self, transaction: Transaction) -> bool:
        final = self._at(transaction.folder)
        final.parent.mkdir(exist_ok=True)
        remove_remnants_once(final.parent)
        temporary = final.parent / temporary_name(final.name)
        try:
            _write_files(temporary, transaction.files, transaction.mark, transaction.describe(transaction.files))
            return self._move_into_place(temporary, final, transaction)
        finally:
            # After a lost race or an error the temporary folder is still there.
            remove_tree(temporary)

    def move(self, key: str, new: str) -> None:
        old, target = self._at(key), self._at(new)
        if not _mode(old, follow=False):
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        old.rename(target)
        sync_folder(target.parent)
        sync_folder(old.parent)

    def sweep(self, folders: Sequence[str]) -> int:
        remnants = [
            self._at(folder) / name
            for folder in folders
            for name in self.names(folder)
            if name.startswith(TEMPORARY_PREFIX)
        ]
        return sum(map(remove_if_abandoned, remnants))

    @contextmanager
    def only_one(self, name: str, *, alone: bool = False) -> Iterator[None]:
        with ExitStack() as held:
            try:
                held.enter_context(exclusive_lock(self.root / f"{LOCK_PREFIX}{name}"))
            except PermissionError as error:
                raise UsageError(
                    f"{self.root}: cannot be worked on ({error.strerror}); it needs write permission for you: have its "
                    f"owner run `chmod -R g+rwX {self.root}`, and all of its users `umask 002`"
                ) from None
            yield

    def _at(self, key: str) -> Path:
        return self.root / key

    def _move_into_place(self, temporary: Path, final: Path, transaction: Transaction) -> bool:
        """Rename a finished folder to its name; False where a published one has it already."""
        folder = final.parent
        # The lock makes one step of looking at what is there and of renaming; the data were written without it.
        with exclusive_lock(folder / f"{LOCK_PREFIX}{transaction.lock}", _LOCK_WAIT_S):
            if _mode(final / transaction.mark):
                return False
            transaction.check()
            if _mode(final):
                # A folder of this name without its mark: half a copy, say. Under this name a sweep may remove it.
                remnant = folder / temporary_name(final.name)
                final.rename(remnant)
                remove_tree(remnant)
            temporary.rename(final)
            sync_folder(folder)
        return True


def _mode(path: Path, *, follow: bool = True) -> int:
    """What kind of thing lies at a path; 0 for nothing.

    Raises:
        UnreadableError: the system does not say.
    """
    try:
        return path.stat(follow_symlinks=follow).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0
    except OSError as error:
        if error.errno == errno.ELOOP:
            return 0
        raise unreadable(path, error) from None


def _write_files(folder: Path, files: Mapping[str, bytes], mark: str, description: bytes) -> None:
    write_new_folder(folder, files)
    write_durably(folder / mark, description)
    sync_folder(folder)
