"""Objects that are imported: the layout of their files, and where they stand afterwards.

An object stands with its front towards -x, up towards z, centred at the origin, and of the usual size.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal, get_args
from urllib.parse import unquote

import numpy as np
from pydantic_core import from_json

from collector.objects.articulation import ends_at_zero
from collector.objects.files import ObjectFiles
from collector.objects.importing.mesh_files import ENDINGS, MeshParser
from collector.objects.model import ObjectModel, bounding_box, transformed
from collector.objects.partnet import MAX_TEXT_BYTES, META_FILE, SEMANTICS_FILE, URDF_FILE, category_of, part_names
from collector.objects.readers import Description
from collector.objects.urdf_bodies import UrdfBodies, UrdfMeshes, joint_notes, listed
from shared.errors import ObjectError, UsageError
from shared.io.text import short
from shared.types import Float
from shared.urdf import MAX_URDF_BYTES, parse_urdf

Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
USUAL_SIZE = 2.0
"""Diagonal of the bounding box of published objects, at joint position 0."""
AS_IT_IS: Direction = "-x"
"""The direction that the front of our own objects has."""


@dataclass(frozen=True, slots=True)
class Placement:
    """How a file's frame becomes ours.

    Attributes:
        front: the direction in the file's frame that the object's front faces.
        up: the direction that is up.
        scale: by which lengths are multiplied; None: `size` decides.
        size: diagonal of the object's bounding box afterwards, at joint position 0.
    """

    front: Direction = AS_IT_IS
    up: Direction = "+z"
    scale: float | None = None
    size: float = USUAL_SIZE

    def rotation(self) -> Float:
        """[3, 3], ours from the file's.

        Raises:
            UsageError: front and up are along one axis.
        """
        front, up = _vector(self.front), _vector(self.up)
        if front @ up:
            raise UsageError(f"--front {self.front} and --up {self.up} are along one axis; name two different axes")
        theirs = np.stack([front, up, np.cross(up, front)], axis=1)
        ours = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
        rotation: Float = ours @ theirs.T
        return rotation


def settled(model: ObjectModel, placement: Placement) -> ObjectModel:
    """`model` where `placement` puts it.

    Raises:
        ObjectError: it has no extent.
        UsageError: see `Placement.rotation`.
    """
    low, high = bounding_box(model)
    diagonal = float(np.linalg.norm(high - low))
    if not diagonal > 0:
        raise ObjectError("it has no shape that can be seen")
    scale = placement.size / diagonal if placement.scale is None else placement.scale
    return transformed(model, placement.rotation(), scale, (low + high) / 2)


def opening_upwards(model: ObjectModel) -> tuple[ObjectModel, list[str]]:
    """`model` in which joints that the file closes at their upper limit close at their lower one; and which these are.

    Our tasks take the lower limit of a door as closed. A joint from -2 to 0 becomes one from 0 to 2 about the opposite
    axis, which is the same motion.
    """
    parts, turned = [], []
    for part in model.parts:
        if ends_at_zero(part.lower, part.upper):
            turned.append(short(part.name))
            x, y, z = part.axis
            part = replace(part, axis=(-x, -y, -z), lower=0.0, upper=-part.lower)
        parts.append(part)
    return replace(model, parts=tuple(parts)), turned


def _vector(direction: Direction) -> Float:
    assert direction in get_args(Direction)
    vector = np.zeros(3)
    vector["xyz".index(direction[1])] = 1.0 if direction[0] == "+" else -1.0
    return vector


Layout = Literal["urdf", "mjcf", "gapartnet", "articulate-anything"]
ENDING_OF = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"}
UNKNOWN_CATEGORY = "Imported"
GAPARTNET_URDF = "mobility_annotation_gapartnet.urdf"
GAPARTNET_PARTS = "link_annotation_gapartnet.json"
ARTICULATE_PROGRAMS = ("joint_pred.py", "link_placement.py")
"""What Articulate-Anything leaves beside the URDF that it makes."""


SCHEMES = ("package", "model", "file")


class SourceFiles:
    """Finds files by the names that other files give them, and reads none from anywhere else.

    Args:
        folder: of the object's own file.
        search: further folders (`--search-path`), asked in their order.

    Raises:
        UsageError: one of the further folders is none.
    """

    def __init__(self, folder: Path, search: Sequence[Path] = ()) -> None:
        for each in search:
            if not each.is_dir():
                raise UsageError(f"--search-path {each}: no such folder; name one that holds the object's other files")
        self.folder = folder
        self._roots = tuple(ObjectFiles(Path(os.path.normpath(each.absolute()))) for each in (folder, *search))
        self._elsewhere: list[str] = []

    def find(self, name: str, most_bytes: int) -> tuple[str, bytes] | None:
        """The path below one of the folders, and the contents, of the file that is called `name`; None if it is absent.

        Args:
            name: a path relative to one of the folders, an absolute one, or a URI of `SCHEMES`.
            most_bytes: that it may have.

        Raises:
            ObjectError: it is in none of the folders, cannot be read, or is too large.
        """
        parts, exact, inside = self._places(name)
        for files, path in exact:
            if files.is_file(path):
                return path, files.read(path, most_bytes)
        for files in self._roots:
            for end in ("/".join(parts[k:]) for k in range(len(parts))):
                if files.is_file(end):
                    self._elsewhere.append(short(name))
                    return end, files.read(end, most_bytes)
        if inside:
            return None
        raise ObjectError(
            f"the file {short(name)} is in none of the folders that may be read ({self._named()}); name the folder "
            "that it is in by --search-path"
        )

    def notes(self) -> Iterator[str]:
        """What was found under another path."""
        if self._elsewhere:
            yield f"{len(self._elsewhere)} files found by the ends of their paths ({listed(self._elsewhere)})"

    def _places(self, name: str) -> tuple[tuple[str, ...], list[tuple[ObjectFiles, str]], bool]:
        """The parts of the path that may be looked for; where it may be; whether it is meant to be in the folders."""
        scheme, separator, rest = name.partition("://")
        if separator and scheme not in SCHEMES:
            raise ObjectError(f"the file {short(name)} has a scheme other than {', '.join(SCHEMES)}; copy it here")
        path = (unquote(rest) if separator else name).replace("\\", "/")
        parts = PurePosixPath(path).parts
        outside = [k for k, part in enumerate(parts) if part in ("..", "/", "//") or part.endswith(":")]
        plain = parts[max(outside, default=-1) + 1 :]
        if separator and scheme != "file":
            exact = [(files, "/".join(parts)) for files in self._roots]
            exact += [(files, "/".join(parts[1:])) for files in self._roots if parts[:1] == (files.folder.name,)]
            # The package's own folder may have another name here, so that a file in it is found by the path's end.
            return plain if outside else plain[1:], exact, False
        if outside and parts[outside[-1]].endswith(":"):
            return plain, [], False
        starts = [Path("/")] if path.startswith("/") else [files.folder for files in self._roots]
        exact = [
            (files, os.path.relpath(place, files.folder))
            for place in (os.path.normpath(start / path) for start in starts)
            for files in self._roots
            if Path(place).is_relative_to(files.folder)
        ]
        return plain, exact, bool(exact)

    def _named(self) -> str:
        return ", ".join(str(files.folder) for files in self._roots)


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
