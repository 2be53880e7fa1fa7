"""URDF of objects and of arms: a tree of links with shapes, joined by joints, all of it checked.

Inertias, materials and dynamics are skipped: hidden dynamics are drawn for each rollout instead.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, cast, get_args
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from shared.errors import ObjectError
from shared.extras import require
from shared.io.text import short
from shared.types import Float

MAX_URDF_BYTES = 2 << 20
MAX_LINKS = 500
MAX_SHAPES = 5_000
MAX_NUMBER = 1e6
MIN_SIZE = 1e-9
"""Of a shape's lengths and scales; what is smaller has no extent."""
MAX_NAME = 200
MAX_PATH = 1000
MOST_NAMED = 8
"""Links that a message names."""
MESH_ENDINGS = (".obj", ".stl")
_XACRO_TAG = re.compile(r"\{\S*xacro/?\}")
"""Each of the namespaces that xacro has had ends in its name."""
_XACRO_ADVICE = "it holds <xacro:...> elements, so it is not a URDF yet; run xacro first"

JointKind = Literal["fixed", "revolute", "continuous", "prismatic"]
ShapeKind = Literal["mesh", "box", "cylinder", "sphere"]


@dataclass(frozen=True, slots=True)
class Shape:
    """What a `<visual>` or `<collision>` shows."""

    kind: ShapeKind
    link_from_shape: Float
    """[4, 4]."""
    size: Float
    """Scale of a mesh [3], edges of a box [3], radius and length of a cylinder [2], radius of a sphere [1]."""
    file: str = ""
    """Of a mesh, as written."""


@dataclass(frozen=True, slots=True)
class Link:
    """A rigid link."""

    name: str
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    """A joint as written; infinite limits stay infinite."""

    name: str
    kind: JointKind
    parent: str
    child: str
    parent_from_child: Float
    """[4, 4], at joint position 0."""
    axis: Float
    """[3], unit, in the child's frame."""
    lower: float
    upper: float
    mimics: str = ""
    """The joint that a `<mimic>` names; "" where there is none."""


@dataclass(frozen=True, slots=True)
class Urdf:
    """A checked tree: one root, every link reached from it once."""

    links: dict[str, Link]
    root: str
    joints: tuple[UrdfJoint, ...]
    """Parents before children; siblings in the order of the file."""

    def mesh_files(self) -> tuple[str, ...]:
        """The mesh files that shapes name, sorted, each once."""
        shapes = (shape for link in self.links.values() for shape in (*link.visuals, *link.collisions))
        return tuple(sorted({shape.file for shape in shapes if shape.kind == "mesh"}))

    def below(self, link: str) -> "Urdf":
        """The tree from `link` on, without the joint that moves it.

        Raises:
            ObjectError: there is no such link.
        """
        if link not in self.links:
            names = ", ".join(short(name) for name in list(self.links)[:MOST_NAMED])
            raise ObjectError(f"there is no link {short(link)}; there are {len(self.links)}, such as {names}")
        kept, joints = {link}, []
        for joint in self.joints:
            if joint.parent in kept and joint.child != link:
                kept.add(joint.child)
                joints.append(joint)
        return Urdf({name: each for name, each in self.links.items() if name in kept}, link, tuple(joints))


def parse_urdf(data: bytes, name: str, mesh_endings: tuple[str, ...] = MESH_ENDINGS) -> Urdf:
    """Parse and check a URDF document.

    Args:
        data: the whole file.
        name: what messages call it.
        mesh_endings: of the mesh files that it may name.

    Raises:
        ObjectError: with one line that says what is wrong and where.
    """
    try:
        return _checked(_Reader(mesh_endings).robot(parse_xml(data, MAX_URDF_BYTES)))
    except ObjectError as error:
        raise ObjectError(f"{name}: {error}") from None


@dataclass(slots=True)
class _Reader:
    """Turns elements into links and joints, counting shapes as it goes."""

    mesh_endings: tuple[str, ...]
    shapes: int = 0
    links: dict[str, Link] = field(default_factory=dict)

    def robot(self, robot: Element) -> tuple[dict[str, Link], list[UrdfJoint]]:
        if robot.tag != "robot":
            raise ObjectError(f"the root element is <{robot.tag[:40]}> instead of <robot>")
        if any(_XACRO_TAG.match(element.tag) for element in robot.iter()):
            raise ObjectError(_XACRO_ADVICE)
        links, joints = robot.findall("link"), robot.findall("joint")
        if len(links) > MAX_LINKS or len(joints) > MAX_LINKS:
            raise ObjectError(f"{len(links)} links and {len(joints)} joints; at most {MAX_LINKS} of each are allowed")
        for element in links:
            link = self.link(element)
            if link.name in self.links:
                raise ObjectError(f"two links are called {short(link.name)}")
            self.links[link.name] = link
        return self.links, [_joint(element) for element in joints]

    def link(self, element: Element) -> Link:
        name = _name(element)
        try:
            return Link(name, tuple(self.shapes_of(element, "visual")), tuple(self.shapes_of(element, "collision")))
        except ObjectError as error:
            raise ObjectError(f"link {short(name)}: {error}") from None

    def shapes_of(self, link: Element, tag: str) -> Iterator[Shape]:
        for element in link.findall(tag):
            self.shapes += 1
            if self.shapes > MAX_SHAPES:
                raise ObjectError(f"more than {MAX_SHAPES} shapes")
            yield _shape(element, self.mesh_endings)


def parse_xml(data: bytes, most_bytes: int) -> Element:
    """The root element; document types, entities and external references are refused.

    Raises:
        ObjectError: with one line that says what is wrong.
        UsageError: the package that reads XML safely is not installed.
    """
    if len(data) > most_bytes:
        raise ObjectError(f"{len(data)} bytes; at most {most_bytes} are allowed")
    require("a URDF", "arm")
    import defusedxml
    import defusedxml.ElementTree

    try:
        return cast(Element, defusedxml.ElementTree.fromstring(data, forbid_dtd=True))
    except defusedxml.DefusedXmlException as error:
        raise ObjectError(f"document types and entities are refused ({type(error).__name__})") from None
    except (ParseError, ValueError, LookupError) as error:
        if "unbound prefix" in str(error) and b"<xacro:" in data:
            raise ObjectError(_XACRO_ADVICE) from None
        raise ObjectError(f"malformed XML ({' '.join(str(error).split())[:80]})") from None


def _name(element: Element) -> str:
    name = element.get("name", "")
    if not name or len(name) > MAX_NAME or not name.isprintable():
        raise ObjectError(
            f"a <{element.tag}> needs a printable name of 1 to {MAX_NAME} characters; given {short(name)}"
        )
    return name


def _numbers(element: Element | None, attribute: str, default: str, count: int) -> Float:
    """`count` finite numbers from an attribute; the default stands in where element or attribute is missing."""
    text = default if element is None else element.get(attribute, default)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        raise ObjectError(f"{attribute} needs {count} numbers; given {short(text)}") from None
    if len(numbers) != count or not (np.abs(numbers) <= MAX_NUMBER).all():
        raise ObjectError(f"{attribute} needs {count} finite numbers, at most {MAX_NUMBER:g}; given {short(text)}")
    return numbers


def _pose(element: Element) -> Float:
    """[4, 4], of an element's `<origin>`: roll, pitch, yaw about fixed axes, then the translation."""
    origin = element.find("origin")
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_rpy(*_numbers(origin, "rpy", "0 0 0", 3))
    pose[:3, 3] = _numbers(origin, "xyz", "0 0 0", 3)
    return pose


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Float:
    """[3, 3], of roll, pitch and yaw about fixed axes."""
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _shape(element: Element, mesh_endings: tuple[str, ...]) -> Shape:
    geometry = element.find("geometry")
    found = [(kind, g) for kind in get_args(ShapeKind) for g in (() if geometry is None else geometry.findall(kind))]
    if len(found) != 1:
        raise ObjectError(f"a <{element.tag}> needs one geometry of {', '.join(get_args(ShapeKind))}")
    kind, inner = found[0]
    pose = _pose(element)
    if kind == "mesh":
        scale = _numbers(inner, "scale", "1 1 1", 3)
        if np.abs(scale).min() < MIN_SIZE:
            raise ObjectError(f"a <mesh> needs a scale other than 0 along each axis; given {scale.tolist()}")
        return Shape(kind, pose, scale, _mesh_file(inner, mesh_endings))
    if kind == "box":
        size = _numbers(inner, "size", "", 3)
    elif kind == "cylinder":
        size = np.concatenate([_numbers(inner, "radius", "", 1), _numbers(inner, "length", "", 1)])
    else:
        size = _numbers(inner, "radius", "", 1)
    if size.min() < MIN_SIZE:
        raise ObjectError(f"a <{kind}> needs a positive size; given {size.tolist()}")
    return Shape(kind, pose, size)


def _mesh_file(mesh: Element, endings: tuple[str, ...]) -> str:
    """The file's path as written; which file below the folder that is, is found where it is read."""
    name = mesh.get("filename", "").strip()
    if not name or len(name) > MAX_PATH or not name.isprintable():
        raise ObjectError(f"a mesh must name a file in at most {MAX_PATH} characters; given {short(name)}")
    if not name.lower().endswith(endings):
        how = "import the object by `adaafford objects import`" if endings == MESH_ENDINGS else "convert it"
        raise ObjectError(
            f"a mesh must be a file of {' or '.join(endings)}; given {short(name)}: {how} (docs/objects.md)"
        )
    return name


def _joint(element: Element) -> UrdfJoint:
    name = _name(element)
    try:
        kind = element.get("type", "")
        if kind not in get_args(JointKind):
            raise ObjectError(f"type {short(kind)}; allowed: {', '.join(get_args(JointKind))}")
        parent, child = (_end(element, tag) for tag in ("parent", "child"))
        axis = np.array([1.0, 0.0, 0.0])
        if kind != "fixed":
            axis = _numbers(element.find("axis"), "xyz", "1 0 0", 3)
            length = np.linalg.norm(axis)
            if length < 1e-9:
                raise ObjectError("the axis is zero")
            axis = axis / length
        lower, upper = _limits(element, kind)
        mimic = element.find("mimic")
        mimics = "" if mimic is None or kind == "fixed" else mimic.get("joint", "") or "no joint"
        return UrdfJoint(name, cast(JointKind, kind), parent, child, _pose(element), axis, lower, upper, mimics)
    except ObjectError as error:
        raise ObjectError(f"joint {short(name)}: {error}") from None


def _end(joint: Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")


def _limits(joint: Element, kind: str) -> tuple[float, float]:
    """Lower and upper limit; infinite where the joint turns freely."""
    if kind == "fixed":
        return 0.0, 0.0
    if kind == "continuous":
        return -np.inf, np.inf
    limit = joint.find("limit")
    if limit is None:
        raise ObjectError(f"a {kind} joint needs a <limit> (lower, upper); one that turns freely is 'continuous'")
    try:
        lower, upper = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
    except ValueError:
        raise ObjectError("a limit is not a number") from None
    for value in (lower, upper):
        if np.isnan(value) or (np.isfinite(value) and abs(value) > MAX_NUMBER):
            raise ObjectError(f"limits must be numbers, at most {MAX_NUMBER:g} or infinite; given {lower} to {upper}")
    if lower > upper:
        raise ObjectError(f"the lower limit {lower} is above the upper limit {upper}, so it cannot move; exchange them")
    return lower, upper


def _checked(parsed: tuple[dict[str, Link], list[UrdfJoint]]) -> Urdf:
    """Order the joints as a tree; refuse anything else."""
    links, joints = parsed
    if not links:
        raise ObjectError("there are no links")
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise ObjectError(f"joint {short(joint.name)} refers to the link {short(end)}, which is not there")
    names, children = Counter(joint.name for joint in joints), Counter(joint.child for joint in joints)
    for counts, problem in ((names, "two joints are called"), (children, "two joints move the link")):
        if repeated := [name for name, count in counts.items() if count > 1]:
            raise ObjectError(f"{problem} {short(repeated[0])}")
    roots = [name for name in links if name not in children]
    if not roots:
        raise ObjectError("the joints form a cycle; there is no root link")
    if len(roots) > 1:
        raise ObjectError(f"{len(roots)} root links ({short(roots[0])}, {short(roots[1])}); one is needed")
    ordered = _depth_first(roots[0], joints)
    if len(ordered) != len(joints):
        raise ObjectError("the joints form a cycle")
    return Urdf(links, roots[0], tuple(ordered))


def _depth_first(root: str, joints: list[UrdfJoint]) -> list[UrdfJoint]:
    below: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    ordered, waiting = [], below.get(root, [])[::-1]
    while waiting:
        joint = waiting.pop()
        ordered.append(joint)
        waiting.extend(below.get(joint.child, [])[::-1])
    return ordered
