"""Reader of one object in PartNet-Mobility's layout.

    <id>/mobility.urdf, meta.json, semantics.txt, textured_objs/*.obj

The folder's name is the object's id. Everything in it is hostile until checked.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from collector import meshes
from collector.articulation import ArticulatedObject, Body, Joint, Mesh
from collector.bounds import check_bounds
from collector.files import ObjectFiles, short
from collector.urdf import MAX_URDF_BYTES, Shape, Urdf, UrdfJoint, parse_urdf
from shared.errors import ObjectError
from shared.plan import ObjectRef
from shared.vocabulary import Float

MAX_TEXT_BYTES = 1 << 20
MAX_OBJECT_BYTES = 256 << 20
MAX_OBJECT_VERTICES = 5_000_000
"""Over all shapes: a URDF may show one mesh many times."""
MAX_WORD = 64

URDF_FILE = "mobility.urdf"
META_FILE = "meta.json"
SEMANTICS_FILE = "semantics.txt"


def read_object(folder: Path) -> ArticulatedObject:
    """Read, check and merge one object.

    Links that fixed joints tie together become one body. A body without collision meshes collides as it looks.

    Raises:
        ObjectError: with one line that says what is wrong with the object's files.
    """
    files = ObjectFiles(folder)
    urdf_bytes = files.read(URDF_FILE, MAX_URDF_BYTES)
    category = _category(files)
    semantics = files.read(SEMANTICS_FILE, MAX_TEXT_BYTES) if files.exists(SEMANTICS_FILE) else b""
    urdf = parse_urdf(urdf_bytes, str(folder / URDF_FILE))
    if all(joint.kind == "fixed" for joint in urdf.joints):
        raise ObjectError(f"{folder}: has no movable part: every joint is fixed")
    mesh_bytes = _read_meshes(files, urdf)
    content = {URDF_FILE: urdf_bytes, SEMANTICS_FILE: semantics, "category": category.encode(), **mesh_bytes}
    ref = _reference(folder, category, content_hash(content))
    bodies = _Bodies(urdf, mesh_bytes, _part_names(semantics, folder), folder).merged()
    try:
        check_bounds(bodies)
    except ObjectError as error:
        raise ObjectError(f"{folder}: {error}") from None
    if not any(body.visuals and body.joint for body in bodies):
        raise ObjectError(f"{folder}: has no movable part that can be seen: its moving links have no mesh")
    return ArticulatedObject(ref, bodies)


def content_hash(content: Mapping[str, bytes]) -> str:
    """SHA-256 over names and bytes, whatever their order."""
    digest = hashlib.sha256()
    for name in sorted(content):
        for part in (name.encode("utf-8", "surrogatepass"), content[name]):
            # Lengths keep the boundary between two files from being moved without notice.
            digest.update(len(part).to_bytes(8, "big"))
            digest.update(part)
    return digest.hexdigest()


def _reference(folder: Path, category: str, digest: str) -> ObjectRef:
    object_id = folder.resolve().name
    try:
        return ObjectRef(id=object_id, category=category, content_hash=digest)
    except ValidationError:
        raise ObjectError(
            f"{folder}: the folder's name is the object's id and may hold letters, digits, '.', '_' and '-', up to 100"
        ) from None


def _category(files: ObjectFiles) -> str:
    """`model_cat` of meta.json."""
    data = files.read(META_FILE, MAX_TEXT_BYTES)
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ObjectError(f"{files.folder / META_FILE}: malformed JSON ({type(error).__name__})") from None
    category = meta.get("model_cat") if isinstance(meta, dict) else None
    if not isinstance(category, str) or not 0 < len(category) <= MAX_WORD or not category.isprintable():
        raise ObjectError(f"{files.folder / META_FILE}: needs a 'model_cat', the category's name")
    return category


def _part_names(semantics: bytes, folder: Path) -> dict[str, str]:
    """Semantic name by link, from lines of link, kind of joint, name."""
    try:
        lines = [line.split() for line in semantics.decode("utf-8").splitlines()]
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


def _read_meshes(files: ObjectFiles, urdf: Urdf) -> dict[str, bytes]:
    """The bytes of every mesh file that the URDF names."""
    names = urdf.mesh_files()
    missing = [name for name in names if not files.exists(name)]
    if missing:
        raise ObjectError(
            f"{files.folder}: {len(missing)} of {len(names)} mesh files are missing, such as {missing[0]}"
        )
    contents, left = {}, MAX_OBJECT_BYTES
    for name in names:
        contents[name] = files.read(name, min(left, meshes.MAX_OBJ_BYTES))
        left -= len(contents[name])
    return contents


@dataclass(slots=True)
class _Growing:
    """A body while links are added to it."""

    link: str
    part_name: str
    joint: Joint | None
    visuals: list[Mesh] = field(default_factory=list)
    collisions: list[Mesh] = field(default_factory=list)

    def body(self) -> Body:
        visuals = tuple(self.visuals)
        return Body(self.link, self.part_name, self.joint, visuals, tuple(self.collisions) or visuals)


class _Bodies:
    """Merges the links of a URDF into bodies, parsing each mesh file once."""

    def __init__(self, urdf: Urdf, mesh_bytes: Mapping[str, bytes], names: Mapping[str, str], folder: Path) -> None:
        self._urdf = urdf
        self._names = names
        self._folder = folder
        self._parsed = {name: meshes.parse_obj(data, str(folder / name)) for name, data in mesh_bytes.items()}
        self._vertices = 0

    def merged(self) -> tuple[Body, ...]:
        """Body 0 is the root; the others follow in the order of the URDF's joints."""
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
        return tuple(body.body() for body in bodies)

    def _add_link(self, body: _Growing, name: str, body_from_link: Float) -> None:
        """Add the link's meshes to `body`; a mesh that is both seen and collided with is kept once."""
        link = self._urdf.links[name]
        kept: dict[tuple[object, ...], Mesh] = {}
        for shapes, meshes_of_body in ((link.visuals, body.visuals), (link.collisions, body.collisions)):
            for shape in shapes:
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
                return self._parsed[shape.file], None if (shape.size == 1).all() else shape.size
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
