"""Reader of one object in PartNet-Mobility's layout; docs/objects.md describes it for users.

    <id>/mobility.urdf, meta.json, semantics.txt, textured_objs/*.obj

The folder's name is the object's id. Everything in it is hostile until checked. A mesh that is absent or unusable is
left out, as the simulator's own reader does, and noted; a part that keeps no shape at all makes the object unusable.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal
from urllib.parse import unquote

import numpy as np
from pydantic_core import from_json

from collector.objects import meshes
from collector.objects.articulation import MIN_RANGE, Body, Joint, Mesh
from collector.objects.files import ObjectFiles, add_framed, short
from collector.objects.readers import MAX_WORD, Description, alike
from collector.objects.urdf import MAX_URDF_BYTES, Shape, Urdf, UrdfJoint, parse_urdf
from shared.errors import ObjectError
from shared.types import Float

MAX_TEXT_BYTES = 1 << 20
MAX_OBJECT_BYTES = 256 << 20
MAX_OBJECT_VERTICES = 5_000_000
"""Over all shapes: a URDF may show one mesh many times."""
MAX_OBJECT_TRIANGLES = 10_000_000
"""Over all mesh files."""
MOST_NAMED = 3
"""Meshes and joints that a note names."""

URDF_FILES = ("mobility.urdf", "mobility_vhacd.urdf", "mobility_cvx.urdf")
"""The first that is there is read; the others are what Where2Act and ManiSkill derive from it."""
URDF_FILE = URDF_FILES[0]
META_FILE = "meta.json"
SEMANTICS_FILE = "semantics.txt"


def urdf_of(folder: Path) -> str | None:
    """The name of the URDF in a folder; None where it holds no object."""
    return next((name for name in URDF_FILES if (folder / name).is_symlink() or (folder / name).exists()), None)


class PartNetReader:
    """Reads, checks and merges one object.

    Links that fixed joints tie together become one body. A body without collision meshes collides as it looks.
    """

    def matches(self, folder: Path) -> bool:
        """Whether there is a URDF of one of the known names."""
        return urdf_of(folder) is not None

    def read(self, files: ObjectFiles) -> Description:
        """The object; raises as every reader does."""
        folder = files.folder
        urdf_file = urdf_of(folder) or URDF_FILE
        urdf_bytes = files.read(urdf_file, MAX_URDF_BYTES)
        category = _category(files)
        semantics = files.read(SEMANTICS_FILE, MAX_TEXT_BYTES) if files.exists(SEMANTICS_FILE) else b""
        urdf = parse_urdf(urdf_bytes, str(folder / urdf_file))
        if all(joint.kind == "fixed" for joint in urdf.joints):
            raise ObjectError(f"{folder}: has no movable part: every joint is fixed")
        documents = {urdf_file: urdf_bytes, SEMANTICS_FILE: semantics, "category": category.encode()}
        # Of the category alone, since the rest of meta.json does not matter; and of the names that the URDF has.
        found, digest = _Meshes(files, folder), hashlib.sha256()
        for name in sorted({*documents, *urdf.mesh_files()}):
            data = documents[name] if name in documents else found.load(name)
            if data is not None:
                add_framed(digest, name.encode("utf-8", "surrogatepass"), data)
        bodies = _Bodies(urdf, found, _part_names(semantics, folder), folder).merged()
        notes = [] if urdf_file == URDF_FILE else [f"read from {urdf_file}"]
        notes += [*found.notes(), *_joint_notes(urdf, bodies)]
        return Description(category, bodies, tuple(notes), digest.hexdigest())


READER = PartNetReader()


def _joint_notes(urdf: Urdf, bodies: Sequence[Body]) -> Iterator[str]:
    """What of its joints a user would not expect."""
    still = [body.joint for body in bodies if body.joint is not None and body.joint.span <= MIN_RANGE]
    if still:
        names = _listed([short(joint.name) for joint in still])
        yield f"{len(still)} of {len(bodies) - 1} joints cannot move, since both limits are {alike(still)} ({names})"
    mimics = [f"{short(joint.name)} of {short(joint.mimics)}" for joint in urdf.joints if joint.mimics]
    if mimics:
        yield f"<mimic> is not followed: what has it moves on its own ({_listed(mimics)})"


def _listed(words: Sequence[str]) -> str:
    more = f" and {len(words) - MOST_NAMED} more" if len(words) > MOST_NAMED else ""
    return ", ".join(words[:MOST_NAMED]) + more


def _category(files: ObjectFiles) -> str:
    """`model_cat` of meta.json."""
    if not files.exists(META_FILE):
        raise ObjectError(
            f"{files.folder}: '{META_FILE}' is missing; write one that names the category, such as "
            '{"model_cat": "StorageFurniture"} (docs/objects.md)'
        )
    data = files.read(META_FILE, MAX_TEXT_BYTES)
    try:
        meta = from_json(_text(data))
    except ValueError as error:
        # The parser's words name the cause and the place.
        raise ObjectError(f"{files.folder / META_FILE}: malformed JSON ({error})") from None
    category = meta.get("model_cat") if isinstance(meta, dict) else None
    if not isinstance(category, str) or not 0 < len(category) <= MAX_WORD or not category.isprintable():
        raise ObjectError(f"{files.folder / META_FILE}: needs a 'model_cat', the category's name (docs/objects.md)")
    return category


def _text(data: bytes) -> str:
    """UTF-8 text, with or without a byte order mark; a ValueError says where it is none."""
    try:
        text, wrong = data.decode("utf-8-sig"), data.find(b"\0")
    except UnicodeDecodeError as error:
        text, wrong = "", error.start
    if wrong >= 0:
        # UTF-16 without a byte order mark is valid UTF-8 with zero bytes in it.
        line, column = data.count(b"\n", 0, wrong) + 1, wrong - data.rfind(b"\n", 0, wrong)
        raise ValueError(f"not UTF-8 text at line {line} column {column}; save it in UTF-8")
    return text


def _part_names(semantics: bytes, folder: Path) -> dict[str, str]:
    """Semantic name by link, from lines of link, kind of joint, name."""
    try:
        lines = [line.split() for line in semantics.decode("utf-8-sig").splitlines()]
    except UnicodeDecodeError:
        raise ObjectError(f"{folder / SEMANTICS_FILE}: not UTF-8 text") from None
    names = {}
    for number, words in enumerate(lines, start=1):
        if not words:
            continue
        if len(words) != 3 or not all(len(word) <= MAX_WORD and word.isprintable() for word in words):
            raise ObjectError(f"{folder / SEMANTICS_FILE}: line {number} is not '<link> <kind of joint> <name>'")
        names[words[0]] = words[2]
    return names


class _Meshes:
    """The mesh files that a URDF names, each read and parsed once; what cannot be used is noted."""

    def __init__(self, files: ObjectFiles, folder: Path) -> None:
        self._files = files
        self._folder = folder
        self._parsed: dict[str, Mesh] = {}
        self._elsewhere: list[str] = []
        self.unusable: dict[str, str] = {}
        """Why, by the name that the URDF has."""
        self._bytes = self._triangles = 0

    def load(self, name: str) -> bytes | None:
        """Read and parse the file that the URDF calls `name`; returns its bytes, None where it is absent.

        Raises:
            ObjectError: it is none below the folder, unreadable, or beyond a bound.
        """
        file = self._below_folder(name)
        if not self._files.exists(file):
            self.unusable[name] = "is absent"
            return None
        data = self._files.read(file, min(MAX_OBJECT_BYTES - self._bytes, meshes.MAX_OBJ_BYTES))
        self._bytes += len(data)
        try:
            mesh = meshes.parse_mesh(data, file)
        except meshes.MeshSizeError as error:
            raise ObjectError(f"{self._folder}: {error}") from None
        except ObjectError as error:
            self.unusable[name] = f"cannot be used: {str(error).removeprefix(f'{file}: ')}"
            return data
        self._triangles += len(mesh.faces)
        if self._triangles > MAX_OBJECT_TRIANGLES:
            raise ObjectError(f"{self._folder}: more than {MAX_OBJECT_TRIANGLES} triangles in all")
        self._parsed[name] = mesh
        return data

    def get(self, name: str) -> Mesh | None:
        """The mesh of that name; None where it cannot be used."""
        return self._parsed.get(name)

    def notes(self) -> Iterator[str]:
        """What was left out, and what was found under another path."""
        if self.unusable:
            why = _listed([f"{short(name)} {reason}" for name, reason in self.unusable.items()])
            yield f"{len(self.unusable)} of {len(self.unusable) + len(self._parsed)} meshes left out: {why}"
        if self._elsewhere:
            yield f"{len(self._elsewhere)} meshes found by the ends of their paths ({_listed(self._elsewhere)})"

    def _below_folder(self, name: str) -> str:
        """The path below the folder of the file that the URDF calls `name`.

        Of a URI, an absolute path or one that leads out of the folder it is the longest end that is there: whoever
        wrote it had the folder elsewhere.
        """
        _, separator, rest = name.partition("://")
        parts = PurePosixPath((unquote(rest) if separator else name).replace("\\", "/")).parts
        outside = [k for k, part in enumerate(parts) if part in ("..", "/") or part.endswith(":")]
        if not separator and not outside and "\\" not in name:
            return name
        last = max(outside, default=-1)
        ends = ["/".join(parts[k:]) for k in range(last + 1, len(parts))]
        found = next((end for end in ends if self._files.is_file(end)), None)
        if found is None:
            raise ObjectError(
                f"{self._folder}: the mesh {short(name)} is not a plain path below the object's folder, and no file "
                "in it has the end of that path; copy the file there and name it relative to the URDF (docs/objects.md)"
            )
        self._elsewhere.append(short(name))
        return found


@dataclass(slots=True)
class _Growing:
    """A body while links are added to it."""

    link: str
    part_name: str
    joint: Joint | None
    visuals: list[Mesh] = field(default_factory=list)
    collisions: list[Mesh] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    """Mesh files that cannot be used."""

    def body(self) -> Body:
        visuals = tuple(self.visuals)
        return Body(self.link, self.part_name, self.joint, visuals, tuple(self.collisions) or visuals)


class _Bodies:
    """Merges the links of a URDF into bodies."""

    def __init__(self, urdf: Urdf, found: _Meshes, names: Mapping[str, str], folder: Path) -> None:
        self._urdf = urdf
        self._names = names
        self._folder = folder
        self._found = found
        self._vertices = 0

    def merged(self) -> tuple[Body, ...]:
        """Body 0 is the root; the others follow in the order of the URDF's joints.

        Raises:
            ObjectError: a part has no shape but meshes that cannot be used, or there are too many vertices.
        """
        root = self._urdf.root
        bodies = [_Growing(root, self._names.get(root, ""), None)]
        self._add_link(bodies[0], root, np.eye(4))
        place: dict[str, tuple[int, Float]] = {root: (0, np.eye(4))}
        for joint in self._urdf.joints:
            index, body_from_parent = place[joint.parent]
            body_from_child = body_from_parent @ joint.parent_from_child
            if joint.kind != "fixed":
                moving = _moving_joint(joint, index, body_from_child)
                bodies.append(_Growing(joint.child, self._names.get(joint.child, ""), moving))
                index, body_from_child = len(bodies) - 1, np.eye(4)
            elif not bodies[index].part_name:
                # The semantic name may stand at a link that is fixed to the one that moves.
                bodies[index].part_name = self._names.get(joint.child, "")
            place[joint.child] = index, body_from_child
            self._add_link(bodies[index], joint.child, body_from_child)
        for body in bodies[1:]:
            if body.lost and not body.visuals and not body.collisions:
                mesh = body.lost[0]
                why = f"{short(mesh)} {self._found.unusable[mesh]}"
                raise ObjectError(f"{self._folder}: the movable part {short(body.link)} keeps no shape: {why}")
        return tuple(body.body() for body in bodies)

    def _add_link(self, body: _Growing, name: str, body_from_link: Float) -> None:
        """Add the link's meshes to `body`; a mesh that is both seen and collided with is kept once."""
        link = self._urdf.links[name]
        kept: dict[tuple[object, ...], Mesh] = {}
        for shapes, meshes_of_body in ((link.visuals, body.visuals), (link.collisions, body.collisions)):
            for shape in shapes:
                if shape.kind == "mesh" and self._found.get(shape.file) is None:
                    body.lost.append(shape.file)
                    continue
                key = (shape.kind, shape.file, shape.size.tobytes(), shape.link_from_shape.tobytes())
                if key not in kept:
                    kept[key] = self._mesh(shape, body_from_link)
                meshes_of_body.append(kept[key])

    def _mesh(self, shape: Shape, body_from_link: Float) -> Mesh:
        mesh, scale = self._local_mesh(shape)
        self._vertices += len(mesh.vertices)
        if self._vertices > MAX_OBJECT_VERTICES:
            raise ObjectError(f"{self._folder}: more than {MAX_OBJECT_VERTICES} vertices in all")
        return meshes.placed(mesh, body_from_link @ shape.link_from_shape, scale)

    def _local_mesh(self, shape: Shape) -> tuple[Mesh, Float | None]:
        match shape.kind:
            case "mesh":
                mesh = self._found.get(shape.file)
                assert mesh is not None
                return mesh, None if (shape.size == 1).all() else shape.size
            case "box":
                return meshes.box(shape.size), None
            case "cylinder":
                return meshes.frustum(shape.size[0], shape.size[0], shape.size[1]), None
            case "sphere":
                return meshes.sphere(shape.size[0]), None


def _moving_joint(joint: UrdfJoint, parent: int, parent_from_body: Float) -> Joint:
    lower = joint.lower if np.isfinite(joint.lower) else -np.pi
    upper = joint.upper if np.isfinite(joint.upper) else np.pi
    if lower > upper:
        raise ObjectError(f"joint {short(joint.name)}: limits {joint.lower} to {joint.upper} leave nothing within +-pi")
    kind: Literal["revolute", "prismatic"] = "prismatic" if joint.kind == "prismatic" else "revolute"
    return Joint(joint.name, kind, parent, parent_from_body, joint.axis, lower, upper)
