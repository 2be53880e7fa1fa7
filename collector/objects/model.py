"""A whole object in one frame: a static body and the parts that hang on it, all at joint position 0.

Objects are made, imported and exported in this form: frames of links are nobody's business but the file's.
"""

from dataclasses import dataclass
from typing import Literal

from collector.objects.articulation import Mesh

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
