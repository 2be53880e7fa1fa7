"""Imports one object: reads it, puts it in its place, writes it in our layout, and judges it as a check does."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic_core import from_json

from collector.objects.articulation import ArticulatedObject, check_bounds
from collector.objects.importing.layouts import Placement, Source, SourceFiles, opening_upwards, read_urdf, settled
from collector.objects.model import ObjectModel, bodies_of, bounding_box, model_of
from collector.objects.partnet import META_FILE
from collector.objects.readers import Description, read_object
from collector.objects.urdf_bodies import listed
from collector.objects.writing import holds, object_files, write_folder
from shared.errors import ObjectError, StoreError, UsageError
from shared.extras import require_packages
from shared.io.files import read_bounded, remove_remnants, remove_tree, sync_folder, temporary_name, writing
from shared.io.text import plain, short

MAX_META_BYTES = 1 << 20
IMPORTED = "imported_from"
"""The entry of meta.json that says what an object was imported from."""


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """What the user decides of an import.

    Attributes:
        search: folders where meshes and included files may be as well.
        placement: front, up and size.
        category: None: what the source says.
        part_names: semantic names by the names of links or bodies in the source.
        root: the link or body from which on the object is wanted; None: all.
        radians: whether angles of an MJCF that says no unit are radians instead of degrees.
        replace: whether an object of this name that was imported before is replaced.
    """

    search: Sequence[Path] = ()
    placement: Placement = field(default_factory=Placement)
    category: str | None = None
    part_names: Mapping[str, str] = field(default_factory=dict)
    root: str | None = None
    radians: bool = False
    replace: bool = False


@dataclass(frozen=True, slots=True)
class Imported:
    """An object that was imported.

    Attributes:
        folder: of the object.
        before: as the file has it, but about the origin and of the usual size, so that it can be drawn.
        after: as it was written and read again.
        extent: edges of its bounding box in the file, [3].
        notes: what was left out or read otherwise, one phrase each.
    """

    folder: Path
    before: ArticulatedObject
    after: ArticulatedObject
    extent: tuple[float, ...]
    notes: tuple[str, ...]


def import_object(source: Source, folder: Path, settings: ImportSettings) -> Imported:
    """Import `source` as `folder`, whose name becomes the object's id; it appears whole or not at all.

    A folder that holds the same is left as it is, so that a call that was interrupted can be repeated.

    Raises:
        ObjectError: it cannot be read, or `objects check` would refuse it.
        UsageError: a setting cannot be honoured, or `folder` holds another object or cannot be written.
    """
    if folder.exists() and not _was_imported(folder):
        raise _taken(folder)
    described = _read(source, settings)
    category = described.category if settings.category is None else settings.category
    try:
        model, turned = opening_upwards(model_of(category, described.bodies))
        low, high = bounding_box(model)
        usual, final = settled(model, Placement()), settled(model, settings.placement)
        # Here, since what is written has other names.
        check_bounds(bodies_of(final))
    except ObjectError as error:
        raise ObjectError(f"{source.file}: {error}") from None
    notes = list(described.notes)
    if turned:
        notes.append(f"{len(turned)} joints that closed at their upper limit turned round ({listed(turned)})")
    written = _write(folder, final, source, replace=settings.replace)
    return Imported(
        folder,
        ArticulatedObject(written.ref, bodies_of(usual)),
        written,
        tuple(np.subtract(high, low).tolist()),
        (*notes, *written.notes),
    )


def _read(source: Source, settings: ImportSettings) -> Description:
    """The object as its file has it, with the names that the user gives its parts."""
    try:
        files = SourceFiles(source.file.parent, settings.search)
        if source.layout == "mjcf":
            require_packages("reading MJCF", "mujoco")
            try:
                from collector.objects.importing.mjcf import read_mjcf
            except ImportError as error:
                # Its own parts may be of different versions.
                raise UsageError(f"reading MJCF needs mujoco, which cannot be imported ({plain(error)})") from None
            described = read_mjcf(source.file, files, settings.root, settings.radians)
        else:
            described = read_urdf(source, files, settings.root)
    except ObjectError as error:
        said = str(error)
        raise ObjectError(said if said.startswith(str(source.file)) else f"{source.file}: {said}") from None
    links = [body.link for body in described.bodies]
    if unknown := [name for name in settings.part_names if name not in links]:
        raise UsageError(f"--part-names {short(unknown[0])}: no such part; there are {', '.join(map(short, links))}")
    bodies = tuple(
        replace(body, part_name=settings.part_names.get(body.link, body.part_name)) for body in described.bodies
    )
    return replace(described, bodies=bodies)


def _taken(folder: Path) -> UsageError:
    return UsageError(
        f"{folder}: is there already; name another by --id, or give --replace where it was imported before"
    )


def _write(folder: Path, model: ObjectModel, source: Source, *, replace: bool) -> ArticulatedObject:
    """Write the object, if it can be read again."""
    digest = hashlib.sha256(read_bounded(source.file, 1 << 30)).hexdigest()
    meta = {IMPORTED: {"file": source.file.name, "layout": source.layout, "sha256": digest}}
    files = object_files(model, meta)
    with writing(folder, "name a folder that can"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_remnants(folder.parent)
        scratch = folder.parent / temporary_name(folder.name)
        try:
            written = write_folder(scratch / folder.name, files)
            try:
                judged = read_object(written)
            except ObjectError as error:
                raise ObjectError(str(error).replace(str(written), str(source.file))) from None
            if holds(folder, files):
                return judged
            if folder.exists():
                if not replace:
                    raise _taken(folder)
                folder.rename(scratch / "replaced")
            written.rename(folder)
            sync_folder(folder.parent)
        finally:
            remove_tree(scratch)
    return judged


def _was_imported(folder: Path) -> bool:
    """Whether a folder holds an object that this module has written."""
    try:
        meta = from_json(read_bounded(folder / META_FILE, MAX_META_BYTES))
    except (StoreError, ValueError):
        return False
    return isinstance(meta, dict) and IMPORTED in meta
