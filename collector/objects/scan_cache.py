"""What scans found in the folders of objects, so that objects whose files did not change need not be read again.

CACHE/<four digits>.json    one object each; a fixed number of places, so that the cache cannot grow without end

Reading and checking the 68 objects of a folder takes 6 s, looking at their files' sizes and times 0.1 s. What is kept
is no more than a list of what there is: whoever loads an object reads its files and compares their content hash.
"""

import hashlib
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from collector.objects.articulation import PartSummary
from shared.config import StrictModel
from shared.errors import StoreError, UsageError
from shared.io.documents import parse_document
from shared.io.files import read_bounded, write_atomically
from shared.io.private import cache_folder
from shared.plan import ObjectRef
from shared.software import software_versions

PLACES = 10_000
"""Two objects that share one drop each other: of 1,000 objects, that is one in twenty."""
MAX_BYTES = 1 << 20
SETTLED_NS = 2_000_000_000
"""Files that changed less than this before they were read could change again without their times telling so."""

Signature = tuple[int, int, int, int, int]
"""Device, inode, size, and the times of the last change of contents and of anything, in nanoseconds."""


class Found(StrictModel):
    """What a scan says of a usable object."""

    ref: ObjectRef
    parts: tuple[PartSummary, ...]
    notes: tuple[str, ...]


class _Kept(StrictModel):
    """The contents of a place."""

    folder: str
    tree: str
    software: dict[str, str]
    files: dict[str, Signature | None]
    """Of each file that was asked for; None: there was none."""
    found: Found


class ScanCache:
    """What was found in object folders, by their paths.

    Files of the cache are checked when they are read. Where there is no place for a cache, or it cannot be read or
    written, objects are read anew.
    """

    def __init__(self) -> None:
        self._cache: Path | None = None
        with suppress(UsageError):
            self._cache = cache_folder("objects")

    def get(self, folder: Path, tree: Path) -> Found | None:
        """What was found in `folder` below the scanned `tree`; None if nothing is known, or anything has changed."""
        if self._cache is None:
            return None
        try:
            place = _place(self._cache, folder)
            kept = parse_document(_Kept, read_bounded(place, MAX_BYTES), str(place), "it is read anew")
            if kept.folder != _absolute(folder) or kept.tree != _absolute(tree) or kept.software != software_versions():
                return None
            changed = any(_signature(folder / name) != before for name, before in kept.files.items())
        except (StoreError, OSError, ValueError):
            return None
        return None if changed else kept.found

    def keep(self, folder: Path, tree: Path, found: Found, asked: Collection[str], begun: int) -> None:
        """Remember what was found.

        Args:
            folder: of the object.
            tree: that was scanned.
            found: what to remember.
            asked: names of the files that it depends on.
            begun: when the first of them was read, nanoseconds since 1970; files that changed about then or later keep
                anything from being remembered.
        """
        if self._cache is None:
            return
        with suppress(OSError, ValueError):
            # The folder itself changes with the names in it, by which readers tell layouts apart.
            files = {name: _signature(folder / name) for name in sorted({".", *asked})}
            if any(one is not None and max(one[3:]) > begun - SETTLED_NS for one in files.values()):
                return
            kept = _Kept(
                folder=_absolute(folder), tree=_absolute(tree), software=software_versions(), files=files, found=found
            )
            data = kept.model_dump_json().encode()
            if len(data) > MAX_BYTES:
                return
            # Bytes that a crash loses are read anew, so nothing waits for the disk.
            write_atomically(_place(self._cache, folder), data, forced=False)


def _place(cache: Path, folder: Path) -> Path:
    number = int.from_bytes(hashlib.sha256(os.fsencode(_absolute(folder))).digest()[:8], "big") % PLACES
    return cache / f"{number:04}.json"


def _absolute(path: Path) -> str:
    return os.path.abspath(path)  # noqa: PTH100 -- a link's own name counts, not where it leads.


def _signature(path: Path) -> Signature | None:
    """Of the file that `path` leads to; None where there is none."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
