"""The objects of a folder: usable and refused ones, those that suit a task, and their split.

A catalogue keeps a few words an object; geometry is read when it is wanted (`load`), and kept in an `ObjectCache`.

    CACHE/<four digits>.json    one object each; a fixed number of places, so that the cache cannot grow without end

Objects whose files did not change are not read again: reading and checking the 68 objects of a folder takes 6 s,
looking at their files' sizes and times 0.1 s. What is kept is no more than a list of what there is: whoever loads an
object reads its files and compares their content hash.
"""

import hashlib
import os
import re
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from collector.objects.articulation import MIN_RANGE, ArticulatedObject, PartSummary
from collector.objects.decomposition import Decomposer
from collector.objects.files import ObjectFiles
from collector.objects.readers import READERS, read_files, read_object, reader_of
from shared.config import Collision, StrictModel
from shared.errors import ObjectError, StoreError, UsageError
from shared.io.documents import parse_document
from shared.io.files import read_bounded, read_named, write_atomically
from shared.io.private import cache_folder
from shared.io.text import short
from shared.plan import ObjectRef
from shared.seeds import generator
from shared.software import software_versions
from shared.tasks import Task

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


MAX_LIST_BYTES = 1 << 20
OBJECT_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


MOST_BYTES = 256 << 20
"""Of meshes. The published objects take 0.1 to 5 MB each, so that some hundreds find room."""


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One usable object; `parts[k - 1]` is its part k."""

    ref: ObjectRef
    folder: Path
    parts: tuple[PartSummary, ...]
    tree: Path
    """The folder that was scanned, below which links are followed."""
    notes: tuple[str, ...] = ()
    """What was left out or read otherwise, one phrase each."""

    @property
    def movable(self) -> int:
        """Number of movable parts."""
        return sum(part.span > MIN_RANGE for part in self.parts)


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The objects of a folder, ordered by id."""

    usable: tuple[CatalogueEntry, ...]
    refused: tuple[tuple[str, str], ...]
    """(id, reason in one line)."""


@dataclass(frozen=True, slots=True)
class ObjectSplit:
    """Disjoint sets of objects."""

    train: tuple[ObjectRef, ...]
    validation: tuple[ObjectRef, ...]
    test: tuple[ObjectRef, ...]


def scan(path: Path, *object_lists: Path, anew: bool = False) -> Catalogue:
    """Read and check every object below `path`.

    An object whose files have not changed since an earlier scan is not read again. A catalogue only says what there is:
    whoever loads an object reads its files, and compares their content.

    Args:
        path: a folder of object folders, or one object's folder. Files and hidden folders in it are ignored.
        object_lists: Where2Act lists, `<id> <category>` a line; if given, only their objects are used.
        anew: read all of them, whatever is known.

    Raises:
        UsageError: `path` or a list cannot be read, or there is no object.
    """
    folders = _object_folders(path)
    if object_lists:
        listed = dict.fromkeys(object_id for each in object_lists for object_id in read_list(each))
        if not listed:
            names = ", ".join(str(each) for each in object_lists)
            raise UsageError(f"{names}: names no object; name a list of '<id> <category>' lines")
        folders = {object_id: folders.get(object_id, path / object_id) for object_id in listed}
    elif all(reader_of(folder) is None for folder in folders.values()):
        layouts = ", ".join(READERS.names())
        raise UsageError(f"{path}: holds no object; name a folder of objects ({layouts}), or one object's folder")
    usable, refused, cache = [], [], ScanCache()
    for object_id in sorted(folders):
        try:
            usable.append(_entry(folders[object_id], path, cache, anew))
        except ObjectError as error:
            refused.append((object_id, str(error)))
    return Catalogue(tuple(usable), tuple(refused))


def read_list(path: Path) -> tuple[str, ...]:
    """The ids of a Where2Act list: `<id> <category>` a line, more words are ignored; categories come from meta.json.

    Raises:
        UsageError: the list cannot be read, or a line does not start with an id.
    """
    advice = "name a list of '<id> <category>' lines"
    try:
        lines = read_named(path, MAX_LIST_BYTES, advice).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise UsageError(f"{path}: not text; name a list of '<id> <category>' lines") from None
    ids = [line.split()[0] for line in lines if line.strip()]
    for object_id in ids:
        if not OBJECT_ID.fullmatch(object_id):
            raise UsageError(f"{path}: {short(object_id)} is not an object's id; a line is '<id> <category>'")
    return tuple(dict.fromkeys(ids))


def load(entry: CatalogueEntry) -> ArticulatedObject:
    """The object's geometry.

    Raises:
        ObjectError: its files cannot be read, or have changed since the scan.
    """
    return _load(entry.folder, entry.tree, entry.ref)


def load_ref(path: Path, ref: ObjectRef, collision: Collision = "hulls") -> ArticulatedObject:
    """The object `ref` below `path`, which is what `scan` was given: a folder of objects, or the object's own.

    Args:
        path: the folder.
        ref: which object.
        collision: whether its collision meshes are used unchanged, or are decomposed first.

    Raises:
        ObjectError: it is missing, its files have changed, or it cannot be decomposed.
    """
    loaded = _load(path / ref.id if reader_of(path) is None else path.resolve(), path, ref)
    if collision == "hulls":
        return loaded
    with Decomposer(cache_folder("pieces")) as decomposer:
        return decomposer.decomposed(loaded)


def for_task(catalogue: Catalogue, task: Task) -> Catalogue:
    """The catalogue in which only objects that `task` may act on are usable."""
    return _without(catalogue, lambda entry: None if qualifying_parts(entry, task) else _unfit_reason(entry, task))


def of_categories(catalogue: Catalogue, categories: Collection[str]) -> Catalogue:
    """The catalogue in which only objects of some categories are usable; all categories if none is given."""

    def reason(entry: CatalogueEntry) -> str | None:
        if not categories or entry.ref.category in categories:
            return None
        return f"a {entry.ref.category}; only {', '.join(categories)} are asked for"

    return _without(catalogue, reason)


def qualifying_parts(described: CatalogueEntry | ArticulatedObject, task: Task) -> tuple[int, ...]:
    """The parts (1-based) that `task` may act on: visible, movable, and with the task's part names."""
    if task.categories and described.ref.category not in task.categories:
        return ()
    parts = described.parts if isinstance(described, CatalogueEntry) else described.summaries()
    return tuple(number for number, part in enumerate(parts, start=1) if _qualifies(part, task))


def split(refs: Iterable[ObjectRef], fractions: tuple[float, float, float], seed: int) -> ObjectSplit:
    """Split objects into train, validation and test, each category alike: a pure function of its arguments.

    Each set with a positive fraction gets an object if there are enough objects.

    Args:
        refs: in any order.
        fractions: of train, validation and test; non-negative, and they sum to 1.
        seed: of the split.

    Raises:
        UsageError: the fractions are negative or do not sum to 1.
    """
    if min(fractions) < 0 or abs(sum(fractions) - 1) > 1e-6:
        raise UsageError(f"fractions of train, validation and test must sum to 1; given {fractions}")
    ordered = _stratified_order(refs, seed)
    sets: list[list[ObjectRef]] = [[], [], []]
    for count, ref in enumerate(ordered, start=1):
        # Each object goes where the fewest are compared with what the fractions ask for: neighbours in the order are
        # of one category, so that each category is dealt out alike.
        shortfall = [fraction * count - len(chosen) for fraction, chosen in zip(fractions, sets, strict=True)]
        sets[int(np.argmax(shortfall))].append(ref)
    wanted = [index for index, fraction in enumerate(fractions) if fraction > 0]
    for index in wanted:
        if not sets[index] and len(ordered) >= len(wanted):
            sets[index].append(max(sets, key=len).pop())
    train, validation, test = (tuple(sorted(chosen, key=lambda ref: ref.id)) for chosen in sets)
    return ObjectSplit(train, validation, test)


def _object_folders(path: Path) -> dict[str, Path]:
    """Object folders by id."""
    if not path.is_dir():
        raise UsageError(f"{path}: no such folder; name a folder of objects, or one object's folder")
    if reader_of(path) is not None:
        return {path.resolve().name: path.resolve()}
    try:
        return {child.name: child for child in path.iterdir() if child.is_dir() and not child.name.startswith(".")}
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror})") from None


def _entry(folder: Path, tree: Path, cache: ScanCache, anew: bool) -> CatalogueEntry:
    found = None if anew else cache.get(folder, tree)
    if found is None:
        begun, files = time.time_ns(), ObjectFiles(folder, tree)
        described = read_files(files)
        found = Found(ref=described.ref, parts=described.summaries(), notes=described.notes)
        cache.keep(folder, tree, found, files.asked, begun)
    return CatalogueEntry(found.ref, folder, found.parts, tree, found.notes)


def _load(folder: Path, tree: Path, ref: ObjectRef) -> ArticulatedObject:
    loaded = read_object(folder, tree)
    if loaded.ref != ref:
        raise ObjectError(
            f"{folder}: is not the object that was planned ({loaded.ref.id} {loaded.ref.content_hash[:12]} instead of "
            f"{ref.id} {ref.content_hash[:12]}); restore its files or start another run"
        )
    return loaded


def _qualifies(part: PartSummary, task: Task) -> bool:
    named = not task.part_names or any(name in part.name for name in task.part_names)
    turns = part.kind == "revolute" or not task.revolute_only
    return named and turns and part.visible and part.span > MIN_RANGE


def _without(catalogue: Catalogue, reason: Callable[[CatalogueEntry], str | None]) -> Catalogue:
    """The catalogue in which every object that there is a reason against is refused for it."""
    reasons = [(entry, reason(entry)) for entry in catalogue.usable]
    refused = [(entry.ref.id, against) for entry, against in reasons if against is not None]
    usable = tuple(entry for entry, against in reasons if against is None)
    return Catalogue(usable, tuple(sorted([*catalogue.refused, *refused])))


def _unfit_reason(entry: CatalogueEntry, task: Task) -> str:
    if task.categories and entry.ref.category not in task.categories:
        return f"the task '{task.name}' is for {', '.join(task.categories)}; this is a {entry.ref.category}"
    return f"no part that the task '{task.name}' may act on"


def _stratified_order(refs: Iterable[ObjectRef], seed: int) -> Sequence[ObjectRef]:
    """The objects category by category, shuffled within each."""
    by_category: dict[str, list[ObjectRef]] = {}
    for ref in sorted(refs, key=lambda ref: ref.id):
        by_category.setdefault(ref.category, []).append(ref)
    rng = generator(seed, "object split")
    return [by_category[name][i] for name in sorted(by_category) for i in rng.permutation(len(by_category[name]))]


class ObjectCache:
    """The objects of one folder, read on demand; the least recently used ones are dropped.

    Args:
        folder: of the objects.
        most_bytes: of meshes to keep; the last object is kept in any case.
    """

    def __init__(self, folder: Path, most_bytes: int = MOST_BYTES) -> None:
        self.folder = folder
        self._most_bytes = most_bytes
        self._kept: OrderedDict[tuple[ObjectRef, Collision], ArticulatedObject] = OrderedDict()
        self._bytes = 0

    def load(self, ref: ObjectRef, collision: Collision) -> ArticulatedObject:
        """The object of a reference.

        Raises:
            ObjectError: see `collector.objects.catalogue.load_ref`.
        """
        key = ref, collision
        if key not in self._kept:
            self._kept[key] = load_ref(self.folder, ref, collision)
            self._bytes += mesh_bytes(self._kept[key])
        self._kept.move_to_end(key)
        while self._bytes > self._most_bytes and len(self._kept) > 1:
            _, dropped = self._kept.popitem(last=False)
            self._bytes -= mesh_bytes(dropped)
        return self._kept[key]


def mesh_bytes(target: ArticulatedObject) -> int:
    """Memory of an object's meshes, each counted once, bytes."""
    meshes = {id(mesh): mesh for body in target.bodies for mesh in (*body.visuals, *body.collisions)}
    return sum(mesh.vertices.nbytes + mesh.faces.nbytes for mesh in meshes.values())
