"""The bodies of an object that a URDF describes, wherever its mesh files are."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from collector.objects import meshes
from collector.objects.articulation import MIN_RANGE, Body, Joint, Mesh
from collector.objects.readers import alike
from shared.errors import ObjectError
from shared.io.text import short
from shared.types import Float
from shared.urdf import Shape, Urdf, UrdfJoint

MAX_OBJECT_BYTES = 256 << 20
MAX_OBJECT_VERTICES, MAX_OBJECT_TRIANGLES = 5_000_000, 10_000_000
"""Over all mesh files, and over all shapes, which may show one mesh many times."""
MOST_NAMED = 3
"""Meshes and joints that a note names."""


class MeshFiles(Protocol):
    """Finds the mesh files that a URDF names."""

    def find(self, name: str, most_bytes: int) -> tuple[str, bytes] | None:
        """The path and the contents of the file that the URDF calls `name`; None where it is absent.

        Raises:
            ObjectError: it is none of the object's files, unreadable, or beyond `most_bytes`.
        """
        ...

    def notes(self) -> Iterator[str]:
        """What was found in another place than the URDF says."""
        ...


@dataclass(slots=True)
class ShapeCount:
    """Counts what the shapes of an object hold, each mesh as often as it is shown."""

    vertices: int = 0
    triangles: int = 0

    def add(self, mesh: Mesh) -> None:
        """Count a mesh before it is placed.

        Raises:
            ObjectError: it is too much.
        """
        self.vertices, self.triangles = self.vertices + len(mesh.vertices), self.triangles + len(mesh.faces)
        if self.vertices > MAX_OBJECT_VERTICES or self.triangles > MAX_OBJECT_TRIANGLES:
            raise ObjectError(f"more than {MAX_OBJECT_VERTICES} vertices or {MAX_OBJECT_TRIANGLES} triangles in all")


class UrdfMeshes:
    """The mesh files that a URDF names, each read and parsed once; what cannot be used is noted.

    Args:
        files: where they are.
        where: what messages call the object.
        parse: the mesh in a file's bytes; the name says its format.
    """

    def __init__(self, files: MeshFiles, where: str, parse: Callable[[bytes, str], Mesh] = meshes.parse_mesh) -> None:
        self._files = files
        self._where = where
        self._parse = parse
        self._parsed: dict[str, Mesh] = {}
        self.unusable: dict[str, str] = {}
        """Why, by the name that the URDF has."""
        self._bytes = self._triangles = 0

    def load(self, name: str) -> bytes | None:
        """Read and parse the file that the URDF calls `name`; returns its bytes, None where it is absent.

        Raises:
            ObjectError: it is none below the folder, unreadable, or beyond a bound.
        """
        found = self._files.find(name, min(MAX_OBJECT_BYTES - self._bytes, meshes.MAX_OBJ_BYTES))
        if found is None:
            self.unusable[name] = "is absent"
            return None
        file, data = found
        self._bytes += len(data)
        try:
            mesh = self._parse(data, file)
        except meshes.MeshSizeError as error:
            raise ObjectError(f"{self._where}: {error}") from None
        except ObjectError as error:
            self.unusable[name] = f"cannot be used: {str(error).removeprefix(f'{file}: ')}"
            return data
        self._triangles += len(mesh.faces)
        if self._triangles > MAX_OBJECT_TRIANGLES:
            raise ObjectError(f"{self._where}: more than {MAX_OBJECT_TRIANGLES} triangles in all")
        self._parsed[name] = mesh
        return data

    def get(self, name: str) -> Mesh | None:
        """The mesh of that name; None where it cannot be used."""
        return self._parsed.get(name)

    def notes(self) -> Iterator[str]:
        """What was left out, and what was found under another path."""
        if self.unusable:
            why = listed([f"{short(name)} {reason}" for name, reason in self.unusable.items()])
            yield f"{len(self.unusable)} of {len(self.unusable) + len(self._parsed)} meshes left out: {why}"
        yield from self._files.notes()


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
    without_collision: list[str] = field(default_factory=list)
    """Links that are seen and name nothing to collide with."""

    def body(self) -> Body:
        visuals = tuple(self.visuals)
        return Body(self.link, self.part_name, self.joint, visuals, tuple(self.collisions) or visuals)


class UrdfBodies:
    """Merges the links of a URDF into bodies: those that fixed joints tie together become one.

    A body without collision meshes collides as it looks. A link without any does not, where another link of its body
    has some: in published objects, simpler shapes for collision are in links that are fixed to the one that is seen.
    """

    def __init__(self, urdf: Urdf, found: UrdfMeshes, names: Mapping[str, str], where: str) -> None:
        self._urdf = urdf
        self._names = names
        self._where = where
        self._found = found
        self._count = ShapeCount()
        self._passable: list[str] = []

    def notes(self) -> Iterator[str]:
        """What of the shapes a user would not expect; after `merged`."""
        if self._passable:
            names = listed([short(name) for name in self._passable])
            yield (
                f"{len(self._passable)} of {len(self._urdf.links)} links are seen and do not collide, since only other "
                f"links of the same part have a <collision> ({names})"
            )

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
                raise ObjectError(f"{self._where}: the movable part {short(body.link)} keeps no shape: {why}")
        self._passable = [link for body in bodies if body.collisions for link in body.without_collision]
        return tuple(body.body() for body in bodies)

    def _add_link(self, body: _Growing, name: str, body_from_link: Float) -> None:
        """Add the link's meshes to `body`; a mesh that is both seen and collided with is kept once."""
        link = self._urdf.links[name]
        kept: dict[tuple[object, ...], Mesh] = {}
        if link.visuals and not link.collisions:
            body.without_collision.append(name)
        for shapes, meshes_of_body in ((link.visuals, body.visuals), (link.collisions, body.collisions)):
            here = set[tuple[object, ...]]()
            for shape in shapes:
                if shape.kind == "mesh" and self._found.get(shape.file) is None:
                    body.lost.append(shape.file)
                    continue
                key = (shape.kind, shape.file, shape.size.tobytes(), shape.link_from_shape.tobytes())
                if key not in kept:
                    kept[key] = self._mesh(shape, body_from_link)
                elif key in here:
                    self._counted(kept[key])
                here.add(key)
                meshes_of_body.append(kept[key])

    def _mesh(self, shape: Shape, body_from_link: Float) -> Mesh:
        mesh, scale = self._local_mesh(shape)
        return meshes.placed(self._counted(mesh), body_from_link @ shape.link_from_shape, scale)

    def _counted(self, mesh: Mesh) -> Mesh:
        try:
            self._count.add(mesh)
        except ObjectError as error:
            raise ObjectError(f"{self._where}: {error}") from None
        return mesh

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


def joint_notes(urdf: Urdf, bodies: Sequence[Body]) -> Iterator[str]:
    """What of its joints a user would not expect."""
    still = [body.joint for body in bodies if body.joint is not None and body.joint.span <= MIN_RANGE]
    if still:
        names = listed([short(joint.name) for joint in still])
        yield f"{len(still)} of {len(bodies) - 1} joints cannot move, since both limits are {alike(still)} ({names})"
    mimics = [f"{short(joint.name)} of {short(joint.mimics)}" for joint in urdf.joints if joint.mimics]
    if mimics:
        yield f"<mimic> is not followed: what has it moves on its own ({listed(mimics)})"


def listed(words: Sequence[str]) -> str:
    """The first few of some words, and how many more there are."""
    more = f" and {len(words) - MOST_NAMED} more" if len(words) > MOST_NAMED else ""
    return ", ".join(words[:MOST_NAMED]) + more
