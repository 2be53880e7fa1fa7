"""An articulated object as the scene and the camera need it: rigid bodies joined by moving joints; and its bounds.

Links that a fixed joint ties together are one body. Body 0 is the static root; body k >= 1 is the k-th movable part
and is connected to its parent by exactly one moving joint; parents come before children. Beyond the bounds the engine
and the scene are slow, wrong, or crash.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shared.errors import ObjectError
from shared.geometry import cross
from shared.io.text import short
from shared.plan import ObjectRef
from shared.types import Float

MIN_RANGE = 1e-6
"""A joint whose limits are closer than this cannot move."""

MAX_PARTS = 150
"""Published objects have fewer. The engine loses joints beyond 254, and time grows with the square of their number."""
MAX_DEPTH = 12
"""Moving joints between a part and the root. Chains of about 30 overlapping links end the process in the engine."""
MAX_SHAPE_PAIRS = 50_000
"""Collision shapes of different bodies, which the engine may have to test against each other at every step."""
MAX_REACH = 20.0
"""Distance from the root's origin that a vertex may come to. Published objects fit into a sphere of radius 1; the
hand waits at a height of 50, and must not be met there."""
MAX_LAYERS = 3000
"""Triangles that a camera's ray may have to be tested against, by the boxes around them as a share of that around a
published object. An image of 448 x 448 pixels takes a second of processor time for 750 layers; published objects have
up to 21."""
USUAL_HALF_SURFACE = 12.0
"""Of the box around a sphere of radius 1."""
MAX_ANGLE = 2 * np.pi
"""The engine wraps the positions of joints that turn further."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in the frame of their body, at the joint's zero position."""

    vertices: Float
    """[V, 3]."""
    faces: NDArray[np.int32]
    """[F, 3], indices into `vertices`."""


@dataclass(frozen=True, slots=True)
class Joint:
    """The moving joint of a part."""

    name: str
    kind: Literal["revolute", "prismatic"]
    parent: int
    """Index of the parent body."""
    parent_from_body: Float
    """[4, 4], pose of the body's frame in its parent's at joint position 0; the axis passes through its origin."""
    axis: Float
    """[3], unit, in the body's frame."""
    lower: float
    """rad or length; infinite limits are cut to -pi, as published."""
    upper: float
    """Likewise, cut to pi."""

    @property
    def span(self) -> float:
        """Upper limit minus lower limit."""
        return self.upper - self.lower


@dataclass(frozen=True, slots=True)
class PartSummary:
    """What a task asks of a movable part."""

    name: str
    """Semantic name; "" where semantics.txt is silent."""
    kind: Literal["revolute", "prismatic"]
    span: float
    """Upper limit minus lower limit, rad or length."""
    visible: bool
    """Whether it has any visual mesh."""


@dataclass(frozen=True, slots=True)
class Body:
    """One rigid body."""

    link: str
    """Name in the URDF of the link that the joint moves (of the root for body 0)."""
    part_name: str
    """What the part is, from semantics.txt, such as "rotation_door"; "" where that is silent."""
    joint: Joint | None
    """None for the root."""
    visuals: tuple[Mesh, ...]
    """What a camera sees."""
    collisions: tuple[Mesh, ...]
    """Each stands for its convex hull in physics."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class ArticulatedObject:
    """A whole object, root link at the world's origin; equal to itself alone."""

    ref: ObjectRef
    bodies: tuple[Body, ...]
    notes: tuple[str, ...] = ()
    """What of its files was left out or read otherwise, for the user to know: one phrase each."""

    @property
    def parts(self) -> tuple[Body, ...]:
        """The movable bodies; part id k is `parts[k - 1]`."""
        return self.bodies[1:]

    def summaries(self) -> tuple[PartSummary, ...]:
        """What tasks ask of each part."""
        return tuple(
            PartSummary(body.part_name, body.joint.kind, body.joint.span, bool(body.visuals))
            for body in self.parts
            if body.joint is not None
        )

    def limits(self) -> Float:
        """[parts, 2], lower and upper joint limits."""
        return np.array([[b.joint.lower, b.joint.upper] for b in self.parts if b.joint is not None]).reshape(-1, 2)

    def body_poses(self, joint_positions: Float) -> Float:
        """world_from_body, [bodies, 4, 4], at the given joint positions [parts]."""
        poses = np.tile(np.eye(4), (len(self.bodies), 1, 1))
        for k, (body, position) in enumerate(zip(self.parts, joint_positions, strict=True), start=1):
            assert body.joint is not None
            poses[k] = poses[body.joint.parent] @ body.joint.parent_from_body @ joint_motion(body.joint, position)
        return poses

    def visible_boxes(self, joint_positions: Float) -> Float:
        """The lowest and the highest corner of each body, [bodies, 2, 3], world; NaN where nothing of it is visible."""
        boxes = np.full((len(self.bodies), 2, 3), np.nan)
        for box, body, pose in zip(boxes, self.bodies, self.body_poses(joint_positions), strict=True):
            if body.visuals:
                points = np.concatenate([mesh.vertices for mesh in body.visuals]) @ pose[:3, :3].T + pose[:3, 3]
                box[:] = points.min(axis=0), points.max(axis=0)
        return boxes


def ends_at_zero(lower: float, upper: float) -> bool:
    """Whether limits end at 0 from below, as those of a joint that is closed at its upper limit do."""
    return lower < -MIN_RANGE and abs(upper) <= MIN_RANGE


def joint_motion(joint: Joint, position: float) -> Float:
    """[4, 4], where a joint at `position` takes the body from where position 0 has it."""
    motion = np.eye(4)
    if joint.kind == "prismatic":
        motion[:3, 3] = position * joint.axis
        return motion
    x, y, z = joint.axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    motion[:3, :3] = np.eye(3) + np.sin(position) * cross + (1 - np.cos(position)) * (cross @ cross)
    return motion


def joint_twist(joint: Joint, world_from_body: Float) -> Float:
    """(w, v), [6], world frame: a point p of the body starts to move by w x p + v a unit of joint position.

    Args:
        joint: of the body.
        world_from_body: [4, 4], the body's pose; the axis passes through its origin.
    """
    axis = world_from_body[:3, :3] @ joint.axis
    if joint.kind == "prismatic":
        return np.concatenate([np.zeros(3), axis])
    return np.concatenate([axis, cross(world_from_body[:3, 3], axis)])


SURFACE_POINTS = 4096
"""Of a whole object: a point every few centimetres, closer than the links of an arm are thick."""


def surface_at(target: ArticulatedObject, joint_positions: Float) -> Float:
    """Points of an object's visible surface, [SURFACE_POINTS, 3], world frame, at joint positions, [parts]."""
    poses = target.body_poses(joint_positions)
    return np.concatenate(
        [points @ pose[:3, :3].T + pose[:3, 3] for points, pose in zip(_samples(target), poses, strict=True)]
    )


@lru_cache(maxsize=4)
def _samples(target: ArticulatedObject) -> tuple[Float, ...]:
    """Points of each body, in its frame, as many as its share of the area; always the same ones."""
    triangles = [_triangles(body.visuals or body.collisions) for body in target.bodies]
    areas = [np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) for t in triangles]
    rng = np.random.default_rng(0)
    cumulated = np.cumsum(np.concatenate(areas))
    chosen = np.searchsorted(cumulated, rng.uniform(0, cumulated[-1], SURFACE_POINTS), side="right").clip(
        0, len(cumulated) - 1
    )
    corner, edge = rng.uniform(size=(2, SURFACE_POINTS, 1))
    a, b, c = np.concatenate(triangles)[chosen].transpose(1, 0, 2)
    points = (1 - np.sqrt(corner)) * a + np.sqrt(corner) * ((1 - edge) * b + edge * c)
    of_body = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])[chosen]
    return tuple(points[of_body == body] for body in range(len(triangles)))


def _triangles(meshes: tuple[Mesh, ...]) -> Float:
    """The corners of the triangles of some meshes, [F, 3, 3]."""
    return np.concatenate([np.empty((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)])


def check_bounds(bodies: Sequence[Body]) -> None:
    """Refuse an object that is out of bounds.

    Args:
        bodies: the root, then the parts, parents before children.

    Raises:
        ObjectError: with one line that has the bound and the value.
    """
    parts = len(bodies) - 1
    if parts > MAX_PARTS:
        raise ObjectError(f"{parts} movable parts; at most {MAX_PARTS} are allowed")
    shapes = [len(body.collisions) for body in bodies]
    pairs = (sum(shapes) ** 2 - sum(count * count for count in shapes)) // 2
    if pairs > MAX_SHAPE_PAIRS:
        raise ObjectError(f"{pairs} pairs of collision shapes of different bodies; at most {MAX_SHAPE_PAIRS}")
    depths, origins = [0], [0.0]
    for body in bodies[1:]:
        assert body.joint is not None
        depths.append(depths[body.joint.parent] + 1)
        origins.append(origins[body.joint.parent] + _offset(body.joint))
        if depths[-1] > MAX_DEPTH:
            raise ObjectError(f"link {short(body.link)} hangs on {depths[-1]} moving joints; at most {MAX_DEPTH}")
    for body, origin in zip(bodies, origins, strict=True):
        reach = origin + _radius(body)
        if not reach <= MAX_REACH:
            raise ObjectError(
                f"link {short(body.link)} can be {reach:.3g} from the root's origin; at most {MAX_REACH:g} is allowed "
                "(published objects fit into a sphere of radius 1; scale meshes in millimetres by 0.001)"
            )
    layers = sum(_layers(mesh) for body in bodies for mesh in body.visuals)
    if layers > MAX_LAYERS:
        raise ObjectError(
            f"so many of its triangles overlap that a ray of the camera meets up to {layers:.0f}; at most {MAX_LAYERS} "
            "are allowed; simplify its meshes"
        )


def _layers(mesh: Mesh) -> float:
    """How many of the mesh's triangles a ray through a published object would meet if they were around its middle."""
    corners = [mesh.vertices[mesh.faces[:, k]] for k in range(3)]
    x, y, z = (np.maximum.reduce(corners) - np.minimum.reduce(corners)).T
    return float(np.minimum((x * y + y * z + z * x) / USUAL_HALF_SURFACE, 1.0).sum())


def _offset(joint: Joint) -> float:
    """How far the body's origin can be from its parent's, after checking the joint's limits."""
    farthest = max(abs(joint.lower), abs(joint.upper))
    if joint.kind == "prismatic":
        return float(np.linalg.norm(joint.parent_from_body[:3, 3])) + farthest
    if farthest > MAX_ANGLE:
        raise ObjectError(
            f"joint {short(joint.name)}: limits {joint.lower:.4g} to {joint.upper:.4g} are beyond one turn either way"
        )
    return float(np.linalg.norm(joint.parent_from_body[:3, 3]))


def _radius(body: Body) -> float:
    """The greatest distance of a vertex from the body's origin."""
    meshes = {id(mesh): mesh for mesh in (*body.visuals, *body.collisions)}.values()
    return max((float(np.linalg.norm(mesh.vertices, axis=1).max(initial=0.0)) for mesh in meshes), default=0.0)
