"""Where an export goes: a folder of a disk, or a prefix of a bucket. An export that was killed goes on in either.

Until all is there, a disk has it as OUT.unfinished, and in both there are notes:

.export/begun.json      the identity of what is exported, which a complete export has in its croissant.json
.export/<n>.json        of each finished piece, its files and its summary
"""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol

from shared.errors import StoreError, UnreadableError, UsageError
from shared.io.documents import parse_object
from shared.io.files import (
    DRIVER_LOCK,
    exclusive_lock,
    read_bounded,
    remove_remnants,
    remove_tree,
    scratch_folder,
    sync_file,
    sync_folder,
    sync_tree,
    write_atomically,
)
from shared.store.backends.base import StorageBackend, backend_of, is_url
from shared.store.layout import MAX_DOCUMENT_BYTES
from shared.store.presence import present

UNFINISHED = ".unfinished"
NOTES, BEGUN = ".export", "begun.json"
CROISSANT, IDENTIFIER = "croissant.json", "identifier"
"""The file of a complete export, and its entry, that say what was exported."""
_PIECE = "piece"
_GO_ON = "repeat the command to go on"


class Destination(Protocol):
    """A place for one export.

    Attributes:
        folder: the files of the export, for what is written beside the pieces. For a bucket those of the pieces are of
            the right size but empty, since they are in the bucket.
    """

    folder: Path

    def is_complete(self, identity: str) -> bool:
        """Whether the complete export of this identity is there; notes that are left of it are removed."""
        ...

    def begin(self, identity: str) -> AbstractContextManager[None]:
        """Hold the place: with what an export of the same identity left there, or empty.

        Raises:
            UsageError: another process holds it, or it holds something that is no unfinished export of the identity.
            OSError: it cannot be written.
        """
        ...

    def note(self, name: str) -> dict[str, Any] | None:
        """A note; None where it is missing or was damaged."""
        ...

    def add_note(self, name: str, note: Mapping[str, Any]) -> None:
        """Write a note."""
        ...

    def has(self, files: Mapping[str, int]) -> bool:
        """Whether the files, given with their sizes, are there."""
        ...

    def piece(self) -> Path:
        """An empty folder for the files of a piece."""
        ...

    def take(self, aside: Path) -> dict[str, int]:
        """Take the files of a piece over; returns their sizes by their paths in the export."""
        ...

    def complete(self) -> None:
        """Take over what was written into `folder` beside the pieces, and make it known that the export is complete."""
        ...

    def on_error(self, error: OSError) -> UsageError:
        """What is said if the disk refuses."""
        ...


def destination(out: str | Path) -> Destination:
    """The place of this name.

    Raises:
        UsageError: it holds something that is no export, or its URL is not allowed.
    """
    if is_url(out):
        return BucketDestination(str(out))
    backend_of(out)  # Refuses a path that was meant as a URL.
    return DiskDestination(Path(out))


class DiskDestination(Destination):
    """A folder of a disk."""

    def __init__(self, out: Path) -> None:
        if os.path.lexists(out) and not (out / CROISSANT).is_file():
            raise _there_already(out)
        self._out = out
        self.folder = out.with_name(out.name + UNFINISHED)
        self._notes = self.folder / NOTES

    def is_complete(self, identity: str) -> bool:
        if _identifier(_note(self._out / CROISSANT)) != identity:
            return False
        # It was killed after it had its name, and before its notes were gone.
        remove_tree(self._out / NOTES)
        return True

    @contextmanager
    def begin(self, identity: str) -> Iterator[None]:
        folder, notes = self.folder, self._notes
        if os.path.lexists(self._out):
            raise _there_already(self._out)
        folder.mkdir(parents=True, exist_ok=True)
        if not notes.is_dir() and any(folder.iterdir()):
            raise UsageError(
                f"{folder}: holds something that is no unfinished export; move it away or name another folder"
            )
        notes.mkdir(exist_ok=True)
        with exclusive_lock(notes / DRIVER_LOCK):
            for written in (folder, notes):
                remove_remnants(written)
            if _identifier(self.note(BEGUN)) != identity:
                # Begun by another command, or before the store had grown.
                for path in [*folder.iterdir(), *notes.iterdir()]:
                    if path not in (notes, notes / DRIVER_LOCK):
                        remove_tree(path)
                self.add_note(BEGUN, {IDENTIFIER: identity})
            yield

    def note(self, name: str) -> dict[str, Any] | None:
        return _note(self._notes / name)

    def add_note(self, name: str, note: Mapping[str, Any]) -> None:
        write_atomically(self._notes / name, json.dumps(note).encode())

    def has(self, files: Mapping[str, int]) -> bool:
        paths = {self.folder / name: size for name, size in files.items()}
        return all(path.is_file() and path.stat().st_size == size for path, size in paths.items())

    def piece(self) -> Path:
        return _emptied(self._notes / _PIECE)

    def take(self, aside: Path) -> dict[str, int]:
        files = {}
        for path in _files(aside):
            name = path.relative_to(aside)
            sync_file(path)
            files[str(name)] = path.stat().st_size
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            path.replace(self.folder / name)
        remove_tree(aside)
        return files

    def complete(self) -> None:
        sync_tree(self.folder)
        # It names this machine. The other notes stay until the folder has its name: a kill here loses nothing.
        (self._notes / DRIVER_LOCK).unlink()
        self.folder.rename(self._out)
        remove_tree(self._out / NOTES)
        sync_folder(self._out.parent)

    def on_error(self, error: OSError) -> UsageError:
        left = f"; what is finished is in {self.folder}: {_GO_ON}" if self.folder.is_dir() else ""
        return UsageError(f"{self._out}: cannot be written ({_reason(error)}){left}, or name another folder")


class BucketDestination(Destination):
    """A prefix of a bucket. A piece is written to the temporary folder of this machine, and then goes to the bucket."""

    def __init__(self, out: str) -> None:
        from shared.store.backends.s3 import S3Backend

        self._out = out.rstrip("/")
        self._backend, self._notes = S3Backend.of(self._out), S3Backend.of(f"{self._out}/{NOTES}")
        self._taken = set[str]()
        there = set(self._backend.names(""))
        if there - {NOTES} and not self._notes.exists(BEGUN) and CROISSANT not in there:
            raise self._there_already()

    def is_complete(self, identity: str) -> bool:
        return not self._notes.exists(BEGUN) and _identifier(_read(self._backend, CROISSANT)) == identity

    @contextmanager
    def begin(self, identity: str) -> Iterator[None]:
        if not self._notes.exists(BEGUN) and self._backend.exists(CROISSANT):
            raise self._there_already()
        with scratch_folder("export") as staging, present(self._notes, "export", alone=True):
            self._staging, self.folder = staging, staging / "out"
            self.folder.mkdir()
            if _identifier(self.note(BEGUN)) != identity:
                for key in self._backend.leaves(""):
                    if not key.startswith(f"{NOTES}/status/"):
                        self._backend.remove(key)
                self.add_note(BEGUN, {IDENTIFIER: identity})
            yield

    def note(self, name: str) -> dict[str, Any] | None:
        return _read(self._notes, name)

    def add_note(self, name: str, note: Mapping[str, Any]) -> None:
        with _going_on():
            self._notes.replace(name, json.dumps(note).encode())

    def has(self, files: Mapping[str, int]) -> bool:
        # An object of a bucket is whole or not there.
        if not all(self._backend.exist(list(files))):
            return False
        for name, size in files.items():
            self._leave_empty(name, size)
        return True

    def piece(self) -> Path:
        return _emptied(self._staging / _PIECE)

    def take(self, aside: Path) -> dict[str, int]:
        files = {}
        for path in _files(aside):
            name = str(path.relative_to(aside))
            files[name] = path.stat().st_size
            self._upload(name, path)
            path.unlink()
            self._leave_empty(name, files[name])
        return files

    def complete(self) -> None:
        for path in _files(self.folder):
            name = str(path.relative_to(self.folder))
            if name not in self._taken:
                self._upload(name, path)
        with _going_on():
            # As long as it is said what was begun, the export counts as unfinished.
            for name in sorted(self._notes.leaves(""), key=lambda name: name == BEGUN):
                self._notes.remove(name)

    def on_error(self, error: OSError) -> UsageError:
        return UsageError(
            f"{self._out}: cannot be written through the temporary folder ({_reason(error)}), which TMPDIR names; "
            f"what is finished is in the bucket: {_GO_ON}"
        )

    def _there_already(self) -> UsageError:
        return UsageError(f"{self._out}: is there already; name a new prefix")

    def _upload(self, name: str, path: Path) -> None:
        with _going_on():
            self._backend.upload(name, path)

    def _leave_empty(self, name: str, size: int) -> None:
        """Leave a file without content, which takes no space, in the place of one that is in the bucket."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.truncate(path, size)
        self._taken.add(name)


@contextmanager
def _going_on() -> Iterator[None]:
    """Add to what a bucket refuses that the same command goes on."""
    try:
        yield
    except UnreadableError as error:
        raise UnreadableError(f"{error}; what is finished is in the bucket: {_GO_ON}") from None


def _there_already(out: Path) -> UsageError:
    return UsageError(f"{out}: is there already; name a new folder")


def _note(path: Path) -> dict[str, Any] | None:
    """A note on a disk; None where it is missing or was damaged."""
    try:
        return parse_object(read_bounded(path, MAX_DOCUMENT_BYTES), str(path))
    except StoreError:
        return None


def _read(backend: StorageBackend, name: str) -> dict[str, Any] | None:
    """A note in a bucket; None where it is missing or was damaged."""
    try:
        return parse_object(backend.read(name, MAX_DOCUMENT_BYTES), f"{backend.where}/{name}")
    except UnreadableError:
        raise
    except StoreError:
        return None


def _identifier(note: Mapping[str, Any] | None) -> object:
    return None if note is None else note.get(IDENTIFIER)


def _emptied(folder: Path) -> Path:
    remove_tree(folder)
    folder.mkdir()
    return folder


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _reason(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)
