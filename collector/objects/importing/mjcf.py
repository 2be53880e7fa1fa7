"""MJCF: MuJoCo resolves its defaults, frames and joints, and we read its meshes.

What MuJoCo gets to see is one document without the name of any file: included files are put in their places here, and
each mesh is replaced by a stand-in, so that no file is read but through `SourceFiles`. Elements that do not concern the
shape and the joints of an object are left out before; plugins, and elements that make others, are refused.
"""

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element, tostring

import mujoco
import numpy as np

from collector.objects import meshes
from collector.objects.articulation import Body, Joint, Mesh
from collector.objects.importing.layouts import UNKNOWN_CATEGORY, SourceFiles
from collector.objects.importing.mesh_files import MeshParser, capsule
from collector.objects.readers import Description
from collector.objects.urdf_bodies import ShapeCount, listed
from shared.errors import ObjectError
from shared.io.text import plain, short
from shared.types import Float
from shared.urdf import MAX_LINKS, MAX_SHAPES, parse_xml

MAX_BYTES = 4 << 20
"""Of all documents together: meshes may be written in them, and MuJoCo's time for a mesh has no other bound."""
MAX_FILES, MAX_DEPTH = 100, 100
MOST = {"body": MAX_LINKS, "default": MAX_LINKS}
"""Elements of these names, and `MAX_SHAPES` of each other: MuJoCo's time grows with the square of their number."""
SECTIONS = ("compiler", "default", "asset", "worldbody")
KEPT = {"compiler", "default", "asset", "worldbody", "mesh", "body", "joint", "freejoint", "geom", "frame"}
REFUSED = {
    **dict.fromkeys(("plugin", "extension"), "plugins are code"),
    **dict.fromkeys(("replicate", "composite", "flexcomp", "attach"), "it makes other elements"),
    "builtin": "it makes a mesh of any size",
}
"""Elements, and attributes of meshes, that are refused, and why; elements that are in neither set are left out."""
SAID = ("equality", "tendon", "hfield", "skin", "flex")
"""What is left out and would make the object move or look otherwise."""
MAX_SAID = 160
MOST_VISIBLE_GROUP = 2
"""MuJoCo's viewers show the groups 0 to 2 unless told otherwise."""
_UNIT_SIMPLEX = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
_SIMPLEX_FACES = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]


def read_mjcf(file: Path, files: SourceFiles, root: str | None = None, radians: bool = False) -> Description:
    """The object that an MJCF file describes.

    Args:
        file: the main document.
        files: where it, what it includes, and its meshes may be read.
        root: the body from which on it is wanted; None: everything but planes.
        radians: whether angles are radians instead of degrees where the file does not say.

    Raises:
        ObjectError: with one line that says what is wrong.
    """
    document = _Document(files)
    top = document.expanded(file.name)
    if radians and not any("angle" in compiler.attrib for compiler in top.iter("compiler")):
        top.insert(0, Element("compiler", angle="radian"))
    spec = _spec(top)
    with MeshParser() as parser:
        found = _Meshes(files, parser, document.folders).replaced(spec)
    try:
        with warnings.catch_warnings():
            # Of masses and inertias, which are drawn for each rollout.
            warnings.simplefilter("ignore")
            model = spec.compile()
    except (ValueError, RuntimeError) as error:
        raise ObjectError(f"MuJoCo refuses it: {_said(error)}") from None
    bodies, notes = _Bodies(model, found).below(root)
    if left_out := [tag for tag in SAID if tag in document.left_out]:
        notes.append(f"left out: {listed([f'<{tag}>' for tag in left_out])}")
    return Description(UNKNOWN_CATEGORY, bodies, (*notes, *files.notes()))


@dataclass(slots=True)
class _Document:
    """A document and all that it includes, as one tree of the elements that are wanted."""

    files: SourceFiles
    folders: list[str] = field(default_factory=lambda: ["", ""])
    """Of meshes, as the compiler element says: `assetdir` or `meshdir`, and "strip" where paths are to be stripped."""
    left_out: dict[str, int] = field(default_factory=dict)
    documents: int = 0
    bytes: int = 0
    elements: Counter[str] = field(default_factory=Counter)

    def expanded(self, name: str) -> Element:
        """The whole of the document that is called `name`."""
        found = self._parsed(name, ())
        if found.tag not in ("mujoco", "mujocoinclude"):
            raise ObjectError(f"the root element is <{found.tag[:40]}> instead of <mujoco>")
        top = Element("mujoco")
        top.extend(list(self._children(found, (name,), 0)))
        return top

    def _parsed(self, name: str, stack: Sequence[str]) -> Element:
        self.documents += 1
        if self.documents > MAX_FILES:
            raise ObjectError(f"more than {MAX_FILES} files are included")
        if name in stack:
            raise ObjectError(f"{short(name)} includes itself")
        found = self.files.find(name, MAX_BYTES - self.bytes)
        if found is None:
            raise ObjectError(f"the included file {short(name)} is absent")
        self.bytes += len(found[1])
        try:
            return parse_xml(found[1], MAX_BYTES)
        except ObjectError as error:
            raise ObjectError(f"{short(name)}: {error}") from None

    def _children(self, element: Element, stack: Sequence[str], depth: int) -> Iterator[Element]:
        """The wanted elements below `element`, in which included files are put in their places."""
        if depth > MAX_DEPTH:
            raise ObjectError(f"elements are nested in more than {MAX_DEPTH} others")
        for child in element:
            made = child.tag == "mesh" and "builtin" in child.attrib
            word = "plugin" if "plugin" in child.attrib else "builtin" if made else child.tag
            if word in REFUSED:
                raise ObjectError(f"<{word}> is refused, since {REFUSED[word]}; save the model as MuJoCo compiles it")
            if child.tag == "include":
                yield from self._included(child.get("file", ""), stack, depth)
            elif child.tag not in KEPT or (depth == 0 and child.tag not in SECTIONS):
                self.left_out[child.tag] = self.left_out.get(child.tag, 0) + 1
            else:
                self.elements[child.tag] += 1
                if self.elements[child.tag] > (most := MOST.get(child.tag, MAX_SHAPES)):
                    raise ObjectError(f"more than {most} elements <{child.tag}>")
                kept = Element(child.tag, {k: v for k, v in child.attrib.items() if k not in ("material", "user")})
                if child.tag == "compiler":
                    self._note_folders(kept)
                elif child.tag == "mesh" and "name" not in kept.attrib and kept.get("file"):
                    kept.set("name", PurePosixPath(kept.attrib["file"].replace("\\", "/")).stem)
                elif child.tag == "geom" and "mesh" in kept.attrib:
                    # A primitive that is to be fitted to a mesh is taken as the mesh.
                    kept.set("type", "mesh")
                kept.extend(list(self._children(child, stack, depth + 1)))
                yield kept

    def _included(self, name: str, stack: Sequence[str], depth: int) -> Iterator[Element]:
        """What a file holds, whose path is relative to the main one's folder or, failing that, to its includer's."""
        beside = str(PurePosixPath(stack[-1]).parent / name)
        try:
            found = self._parsed(name, stack)
        except ObjectError:
            if beside == name:
                raise
            name = beside
            found = self._parsed(name, stack)
        yield from self._children(found, (*stack, name), depth)

    def _note_folders(self, compiler: Element) -> None:
        folder = compiler.get("meshdir", compiler.get("assetdir"))
        if folder is not None:
            self.folders[0] = folder
        if compiler.get("strippath") == "true":
            self.folders[1] = "strip"
        for name in ("meshdir", "texturedir", "assetdir", "strippath", "discardvisual", "fusestatic"):
            compiler.attrib.pop(name, None)


def _spec(top: Element) -> Any:
    """MuJoCo's own tree of a document that names no file but those of meshes, which are not read yet."""
    # It would write what it warns of into a file in the working folder; what matters is checked here.
    mujoco.set_mju_user_warning(lambda _: None)
    for geom in top.iter("geom"):
        for name in ("hfield", "fluidshape"):
            geom.attrib.pop(name, None)
    try:
        spec = mujoco.MjSpec.from_string(tostring(top, encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        raise ObjectError(f"MuJoCo refuses it: {_said(error)}") from None
    # Masses are drawn for each rollout; those of the file need not suffice to simulate.
    spec.compiler.boundmass = spec.compiler.boundinertia = 1.0
    spec.compiler.balanceinertia = True
    return spec


def _said(error: Exception) -> str:
    return plain(re.sub(r"\s+", " ", str(error)), MAX_SAID)


@dataclass(slots=True)
class _Meshes:
    """The mesh files that a document names."""

    files: SourceFiles
    parser: MeshParser
    folders: Sequence[str]
    count: ShapeCount = field(default_factory=ShapeCount)

    def replaced(self, spec: Any) -> dict[str, Mesh]:
        """The meshes of a tree by name, as its geoms show them; each that has a file gets a stand-in for MuJoCo."""
        found: dict[str, Mesh] = {}
        for asset in spec.meshes:
            if not asset.file:
                continue
            mesh = self._read(asset.file)
            scale = np.array(asset.scale, dtype=np.float64)
            if np.abs(scale).min() < 1e-9:
                raise ObjectError(f"mesh {short(asset.name)}: a scale other than 0 is needed along each axis")
            reference = np.linalg.inv(_pose(np.array(asset.refpos), np.array(asset.refquat))).astype(np.float64)
            found[asset.name] = meshes.placed(mesh, reference, scale)
            asset.file = ""
            asset.uservert, asset.userface = _UNIT_SIMPLEX.ravel().tolist(), _SIMPLEX_FACES
            asset.scale, asset.refpos, asset.refquat = [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
        return found

    def _read(self, name: str) -> Mesh:
        if self.folders[1]:
            name = PurePosixPath(name).name
        path = name if not self.folders[0] or name.startswith("/") else f"{self.folders[0].rstrip('/')}/{name}"
        found = self.files.find(path, meshes.MAX_OBJ_BYTES)
        if found is None:
            raise ObjectError(f"the mesh {short(path)} is absent; name its folder by --search-path")
        mesh = self.parser.parse(found[1], found[0])
        self.count.add(mesh)
        return mesh


class _Bodies:
    """Merges the bodies of a compiled model: those that no joint moves become part of their parents."""

    def __init__(self, model: Any, found: dict[str, Mesh]) -> None:
        for numbers in (model.geom_size, model.geom_pos, model.body_pos, model.jnt_pos, model.jnt_range, model.qpos0):
            if not (np.abs(numbers) <= meshes.MAX_COORDINATE).all():
                raise ObjectError(f"a size, a position or a limit is not finite, or beyond {meshes.MAX_COORDINATE:g}")
        self._model = model
        self._found = found
        self._count = ShapeCount()
        self._free: list[str] = []
        self._hides = self._groups_that_hide()

    def below(self, root: str | None) -> tuple[tuple[Body, ...], list[str]]:
        """Body 0 is the world, or what stands still of what is wanted; the others follow; and what there is to say."""
        model = self._model
        names = [model.body(k).name or f"body_{k}" for k in range(model.nbody)]
        if root is not None and root not in names:
            raise ObjectError(f"there is no body {short(root)}; there are {', '.join(map(short, names[1:13]))}")
        first = 0 if root is None else names.index(root)
        state = mujoco.MjData(model)
        mujoco.mj_kinematics(model, state)
        start = np.eye(4)
        start[:3, :3] = state.xmat[first].reshape(3, 3)
        bodies: list[tuple[str, Joint | None, list[Mesh], list[Mesh]]] = [(root or "world", None, [], [])]
        place: dict[int, tuple[int, Float]] = {}
        for k in range(model.nbody):
            if k == first:
                index, pose = 0, start
            elif model.body_parentid[k] in place and k > first:
                index, pose = place[model.body_parentid[k]]
                pose = pose @ _pose(model.body_pos[k], model.body_quat[k])
            else:
                continue
            for joint in self._joints(k, names[k]):
                index, pose = self._moved(bodies, joint, index, pose, names[k])
            place[k] = index, pose
            self._add_shapes(k, pose, bodies[index][2], bodies[index][3])
        notes = [f"free joints left out, so that it stands still: {listed(self._free)}"] if self._free else []
        made = tuple(Body(name, "", joint, tuple(seen or hit), tuple(hit or seen)) for name, joint, seen, hit in bodies)
        return made, notes

    def _joints(self, body: int, name: str) -> Iterator[Any]:
        model, first = self._model, self._model.body_jntadr[body]
        for j in range(first, first + model.body_jntnum[body]):
            kind = mujoco.mjtJoint(model.jnt_type[j])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                self._free.append(short(name))
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                raise ObjectError(f"body {short(name)} has a ball joint; only hinges and slides are read")
            else:
                yield j

    def _moved(
        self,
        bodies: list[tuple[str, Joint | None, list[Mesh], list[Mesh]]],
        j: int,
        parent: int,
        parent_from_body: Float,
        name: str,
    ) -> tuple[int, Float]:
        """Add the body that joint `j` moves; returns its index, and where the model's body is in it."""
        model = self._model
        anchor = np.eye(4)
        anchor[:3, 3] = model.jnt_pos[j]
        slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
        lower, upper = (-np.pi, np.pi)
        if model.jnt_limited[j]:
            # Position 0 of ours is where the file draws the body.
            lower, upper = (float(limit) - float(model.qpos0[model.jnt_qposadr[j]]) for limit in model.jnt_range[j])
        several = any(name == each[0] for each in bodies[1:])
        joint = Joint(
            name=model.joint(j).name or f"joint_{j}",
            kind="prismatic" if slides else "revolute",
            parent=parent,
            parent_from_body=parent_from_body @ anchor,
            axis=model.jnt_axis[j] / np.linalg.norm(model.jnt_axis[j]),
            lower=lower,
            upper=upper,
        )
        bodies.append((f"{name}_{j}" if several else name, joint, [], []))
        anchor[:3, 3] *= -1.0
        return len(bodies) - 1, anchor

    def _add_shapes(self, body: int, pose: Float, seen: list[Mesh], hit: list[Mesh]) -> None:
        model, first = self._model, self._model.body_geomadr[body]
        for g in range(first, first + model.body_geomnum[body]):
            shape = self._shape(g)
            if shape is None:
                continue
            self._count.add(shape[0])
            mesh = meshes.placed(shape[0], pose @ shape[1])
            collides = self._collides(g)
            if collides:
                hit.append(mesh)
            if self._visible(g) and not (collides and self._hides):
                seen.append(mesh)

    def _shape(self, g: int) -> tuple[Mesh, Float] | None:
        """The shape of a geom in its own frame, and that frame in the body's; None where it has no extent."""
        model, size = self._model, self._model.geom_size[g]
        pose = _pose(model.geom_pos[g], model.geom_quat[g])
        match mujoco.mjtGeom(model.geom_type[g]):
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                return meshes.sphere(size[0]), pose
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                return capsule(size[0], size[1]), pose
            case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                return meshes.placed(meshes.sphere(1.0), np.eye(4), size.copy()), pose
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                return meshes.frustum(size[0], size[0], 2 * size[1]), pose
            case mujoco.mjtGeom.mjGEOM_BOX:
                return meshes.box(2 * size), pose
            case mujoco.mjtGeom.mjGEOM_MESH:
                return self._mesh(int(model.geom_dataid[g]), pose)
            case _:
                return None

    def _mesh(self, number: int, body_from_compiled: Float) -> tuple[Mesh, Float]:
        """A mesh; MuJoCo has moved the geom to where the principal axes are of what it took for the mesh."""
        model = self._model
        name = model.mesh(number).name
        if name in self._found:
            moved = _pose(model.mesh_pos[number], model.mesh_quat[number])
            return self._found[name], body_from_compiled @ np.linalg.inv(moved)
        start, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
        first, faces = model.mesh_faceadr[number], model.mesh_facenum[number]
        vertices = model.mesh_vert[start : start + count].astype(np.float64)
        return Mesh(vertices, model.mesh_face[first : first + faces].astype(np.int32)), body_from_compiled

    def _collides(self, g: int) -> bool:
        return bool(self._model.geom_contype[g] or self._model.geom_conaffinity[g])

    def _visible(self, g: int) -> bool:
        return bool(self._model.geom_group[g] <= MOST_VISIBLE_GROUP and self._model.geom_rgba[g][3] > 0)

    def _groups_that_hide(self) -> bool:
        """Whether what is seen and what collides are in groups of their own, so that the latter is to be hidden."""
        geoms = range(self._model.ngeom)
        seen = {int(self._model.geom_group[g]) for g in geoms if self._visible(g) and not self._collides(g)}
        hit = {int(self._model.geom_group[g]) for g in geoms if self._collides(g)}
        return bool(seen) and not seen & hit


def _pose(position: Float, quaternion: Float) -> Float:
    """[4, 4], from a position and a quaternion w, x, y, z."""
    pose, rotation = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion))
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose
