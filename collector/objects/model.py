"""A whole object in one frame: a static body and the parts that hang on it, all at joint position 0.

Objects are made, imported and exported in this form: frames of links are nobody's business but the file's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from collector.objects.articulation import Body, Joint, Mesh
from collector.objects.meshes import placed
from shared.types import Float

MAX_NAME = 64
"""Letters of the semantic name of a part."""
Point = tuple[float, float, float]
Pieces = tuple[Mesh, ...]


@dataclass(frozen=True, slots=True)
class MovablePart:
    """A movable part, in the object's frame, at joint position 0."""

    name: str
    """Semantic name, as PartNet-Mobility has it."""
    kind: Literal["revolute", "prismatic"]
    pieces: Pieces
    """What a camera sees."""
    origin: Point
    """A point on the axis."""
    axis: Point
    upper: float
    """rad or length."""
    lower: float = 0.0
    parent: int | None = None
    """Index of the part that it hangs on; None: the body."""
    collisions: Pieces | None = None
    """What it collides as, each its convex hull; None: `pieces`."""


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """A whole object."""

    category: str
    body_name: str
    body: Pieces
    parts: tuple[MovablePart, ...]
    body_collisions: Pieces | None = None
    """As those of a part."""


def model_of(category: str, bodies: Sequence[Body]) -> ObjectModel:
    """The bodies of an object in its own frame, all joints at position 0."""
    poses = np.tile(np.eye(4), (len(bodies), 1, 1))
    parts = []
    for k, body in enumerate(bodies):
        if body.joint is None:
            continue
        pose = poses[k] = poses[body.joint.parent] @ body.joint.parent_from_body
        parts.append(
            MovablePart(
                name=_word(body.part_name or body.link),
                kind=body.joint.kind,
                pieces=_moved(body.visuals, pose),
                origin=point(pose[:3, 3]),
                axis=point(pose[:3, :3] @ body.joint.axis),
                upper=body.joint.upper,
                lower=body.joint.lower,
                parent=body.joint.parent - 1 if body.joint.parent else None,
                collisions=_collisions(body, pose),
            )
        )
    root = bodies[0]
    return ObjectModel(
        category,
        _word(root.part_name or root.link),
        root.visuals,
        tuple(parts),
        _collisions(root, np.eye(4)),
    )


def bodies_of(model: ObjectModel) -> tuple[Body, ...]:
    """The bodies of a model: the root at the object's origin, each part's frame at its `origin`, turned as the object.

    A link is called as its part.
    """

    def moved(pieces: Pieces, origin: Float) -> Pieces:
        return tuple(Mesh(piece.vertices - origin, piece.faces) for piece in pieces)

    own = model.body if model.body_collisions is None else model.body_collisions
    bodies = [Body(model.body_name, model.body_name, None, model.body, own)]
    for number, part in enumerate(model.parts):
        origin, pose = np.array(part.origin), np.eye(4)
        pose[:3, 3] = origin - (0.0 if part.parent is None else np.array(model.parts[part.parent].origin))
        parent = 0 if part.parent is None else part.parent + 1
        axis = np.array(part.axis)
        joint = Joint(f"joint_{number}", part.kind, parent, pose, axis, part.lower, part.upper)
        seen = moved(part.pieces, origin)
        hit = seen if part.collisions is None else moved(part.collisions, origin)
        bodies.append(Body(part.name, part.name, joint, seen, hit))
    return tuple(bodies)


def transformed(model: ObjectModel, rotation: Float, scale: float, centre: Float) -> ObjectModel:
    """`model` about `centre`, turned and scaled."""
    return mapped(model, lambda points: (points - centre) @ rotation.T * scale, lambda axis: rotation @ axis, scale)


def mapped(
    model: ObjectModel, place: Callable[[Float], Float], turn: Callable[[Float], Float], scale: float
) -> ObjectModel:
    """`model` with all of it in other places.

    Args:
        model: an object.
        place: where points [..., 3] go.
        turn: where directions [3] point.
        scale: what lengths are multiplied by.
    """

    def place_all(pieces: Pieces) -> Pieces:
        return tuple(Mesh(place(piece.vertices), piece.faces) for piece in pieces)

    def place_part(part: MovablePart) -> MovablePart:
        length = 1.0 if part.kind == "revolute" else scale
        return replace(
            part,
            pieces=place_all(part.pieces),
            origin=point(place(np.array(part.origin))),
            axis=point(turn(np.array(part.axis))),
            upper=part.upper * length,
            lower=part.lower * length,
            collisions=None if part.collisions is None else place_all(part.collisions),
        )

    own = None if model.body_collisions is None else place_all(model.body_collisions)
    return ObjectModel(model.category, model.body_name, place_all(model.body), tuple(map(place_part, model.parts)), own)


def bounding_box(model: ObjectModel) -> tuple[Float, Float]:
    """Lowest and highest corner, [3] each, of what can be seen; of what collides where nothing can."""
    seen = [model.body, *(part.pieces for part in model.parts)]
    collides = [model.body_collisions or (), *(part.collisions or () for part in model.parts)]
    vertices = [mesh.vertices for pieces in (seen if any(seen) else collides) for mesh in pieces]
    if not vertices:
        return np.zeros(3), np.zeros(3)
    return np.min([v.min(axis=0) for v in vertices], axis=0), np.max([v.max(axis=0) for v in vertices], axis=0)


def point(vector: Float) -> Point:
    """A vector [3] as numbers of Python."""
    x, y, z = vector.tolist()
    return x, y, z


def _word(name: str) -> str:
    """A name as one word of semantics.txt."""
    return "".join(c if c.isprintable() and not c.isspace() else "_" for c in name)[:MAX_NAME] or "part"


def _moved(meshes: Pieces, pose: Float) -> Pieces:
    return tuple(placed(mesh, pose) for mesh in meshes)


def _collisions(body: Body, pose: Float) -> Pieces | None:
    same = len(body.visuals) == len(body.collisions) and all(
        seen is hit for seen, hit in zip(body.visuals, body.collisions, strict=True)
    )
    return None if same else _moved(body.collisions, pose)
