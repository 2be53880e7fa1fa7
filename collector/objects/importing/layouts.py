"""Layouts of objects that are imported: which of them a file or a folder has, and what it says beside the shapes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic_core import from_json

from collector.objects.files import ObjectFiles
from collector.objects.importing.mesh_files import ENDINGS, MeshParser
from collector.objects.importing.placement import AS_IT_IS, Direction
from collector.objects.importing.sources import SourceFiles
from collector.objects.partnet import MAX_TEXT_BYTES, META_FILE, SEMANTICS_FILE, URDF_FILE, category_of, part_names
from collector.objects.readers import Description
from collector.objects.urdf_bodies import UrdfBodies, UrdfMeshes, joint_notes
from shared.errors import ObjectError, UsageError
from shared.io.text import short
from shared.urdf import MAX_URDF_BYTES, parse_urdf

Layout = Literal["urdf", "mjcf", "gapartnet", "articulate-anything"]
ENDING_OF = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"}
UNKNOWN_CATEGORY = "Imported"
GAPARTNET_URDF = "mobility_annotation_gapartnet.urdf"
GAPARTNET_PARTS = "link_annotation_gapartnet.json"
ARTICULATE_PROGRAMS = ("joint_pred.py", "link_placement.py")
"""What Articulate-Anything leaves beside the URDF that it makes."""


@dataclass(frozen=True, slots=True)
class Source:
    """An object that is to be imported."""

    file: Path
    layout: Layout
    name: str

    @property
    def front(self) -> Direction:
        """Where the front of objects of this layout faces; formats for robots have no rule."""
        return "+x" if self.layout == "articulate-anything" else AS_IT_IS


def source_of(path: Path) -> Source:
    """The object that a file or a folder holds.

    Raises:
        UsageError: it holds none, or several.
    """
    what = "name a .urdf or an MJCF .xml, or the folder of an object (GAPartNet, Articulate-Anything)"
    if path.is_file():
        layout = ENDING_OF.get(path.suffix.lower())
        if layout is None:
            raise UsageError(f"{path}: not a file of an object; {what}")
        return Source(path, "mjcf" if layout == "mjcf" else "urdf", path.stem)
    if not path.is_dir():
        raise UsageError(f"{path}: no such file or folder; {what}")
    name = path.resolve().name
    if (path / GAPARTNET_URDF).exists():
        return Source(path / GAPARTNET_URDF, "gapartnet", name)
    if (path / URDF_FILE).exists():
        made = any((path / each).exists() for each in ARTICULATE_PROGRAMS)
        return Source(path / URDF_FILE, "articulate-anything" if made else "urdf", name)
    found = sorted(each for each in path.glob("*.urdf") if each.is_file())
    if len(found) != 1:
        raise UsageError(f"{path}: holds {len(found)} .urdf files; {what}")
    return Source(found[0], "urdf", name)


def read_urdf(source: Source, files: SourceFiles, root: str | None = None) -> Description:
    """The object that a URDF describes, with the names of parts and the category that files beside it say.

    Args:
        source: of a layout with a URDF.
        files: where it and its meshes may be read.
        root: the link from which on it is wanted; None: all of it.

    Raises:
        ObjectError: with one line that says what is wrong.
    """
    beside, where = ObjectFiles(source.file.parent.absolute()), str(source.file)
    urdf = parse_urdf(beside.read(source.file.name, MAX_URDF_BYTES), where, ENDINGS)
    if root is not None:
        urdf = urdf.below(root)
    with MeshParser() as parser:
        found = UrdfMeshes(files, where, parser.parse)
        for name in urdf.mesh_files():
            found.load(name)
    names = _gapartnet_names(beside) if source.layout == "gapartnet" else {}
    if beside.exists(SEMANTICS_FILE):
        said = part_names(beside.read(SEMANTICS_FILE, MAX_TEXT_BYTES), str(source.file.parent / SEMANTICS_FILE))
        names = {**said, **names}
    merging = UrdfBodies(urdf, found, names, where)
    bodies = merging.merged()
    category = category_of(beside) if beside.exists(META_FILE) else UNKNOWN_CATEGORY
    return Description(category, bodies, (*found.notes(), *merging.notes(), *joint_notes(urdf, bodies)))


def _gapartnet_names(files: ObjectFiles) -> dict[str, str]:
    """GAPartNet's kind of part, such as "hinge_door", by link."""
    if not files.exists(GAPARTNET_PARTS):
        return {}
    try:
        parts = from_json(files.read(GAPARTNET_PARTS, MAX_TEXT_BYTES))
    except ValueError as error:
        raise ObjectError(f"{files.folder / GAPARTNET_PARTS}: malformed JSON ({error})") from None
    if not isinstance(parts, Sequence) or not all(isinstance(part, dict) for part in parts):
        raise ObjectError(f"{files.folder / GAPARTNET_PARTS}: needs a list of links, each with 'link_name'")
    named = {}
    for part in parts:
        link, kind = part.get("link_name"), part.get("category")
        if part.get("is_gapart") is True and isinstance(link, str) and isinstance(kind, str):
            if len(kind) > 64 or not kind.isprintable():
                raise ObjectError(f"{files.folder / GAPARTNET_PARTS}: {short(kind)} is no kind of part")
            named[link] = kind
    return named
