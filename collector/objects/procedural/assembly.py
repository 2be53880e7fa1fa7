"""An object under construction: a static body and the parts that hang on it, all in one frame, all closed."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from collector.objects.articulation import Mesh
from collector.objects.procedural.shapes import Pieces, Point, point
from shared.types import Float

GRID = 2.0**-14
"""Coordinates are multiples of this, so that moving them between frames rounds nothing: twins stay identical."""


@dataclass(frozen=True, slots=True)
class MovablePart:
    """A movable part, in the object's frame, at joint position 0."""

    name: str
    """Semantic name, as PartNet-Mobility has it."""
    kind: Literal["revolute", "prismatic"]
    pieces: Pieces
    origin: Point
    """A point on the axis."""
    axis: Point
    upper: float
    """rad or length."""
    lower: float = 0.0
    parent: int | None = None
    """Index of the part that it hangs on; None: the body."""


@dataclass(frozen=True, slots=True)
class ProceduralObject:
    """A whole object."""

    category: str
    body_name: str
    body: Pieces
    parts: tuple[MovablePart, ...]


def hinged(
    name: str,
    pieces: Pieces,
    corner: Point,
    edge: Point,
    outward: Point,
    upper: float,
    parent: int | None = None,
) -> MovablePart:
    """A panel that turns outward about one of its edges.

    Its axis runs along the outer face: a panel turned there leaves its frame and its neighbours without touching them.

    Args:
        name: semantic name.
        pieces: the panel and what is on it.
        corner: a point of the edge, on the outer face.
        edge: direction from the panel's middle to the edge that it turns about.
        outward: direction in which the far edge moves first.
        upper: how far it opens, rad.
        parent: see `MovablePart`.
    """
    return MovablePart(
        name, "revolute", pieces, corner, point(np.cross(np.negative(edge), outward)), upper, parent=parent
    )


def sliding(name: str, pieces: Pieces, direction: Point, upper: float) -> MovablePart:
    """A part that slides along `direction`."""
    return MovablePart(name, "prismatic", pieces, (0.0, 0.0, 0.0), direction, upper)


def normalised(assembly: ProceduralObject) -> ProceduralObject:
    """The object about the origin, its bounding box's diagonal 2, as PartNet-Mobility has it, on the grid."""
    everything = [*assembly.body, *(piece for part in assembly.parts for piece in part.pieces)]
    vertices = np.concatenate([piece.vertices for piece in everything])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale, centre = 2.0 / float(np.linalg.norm(high - low)), (low + high) / 2

    def place(vectors: Float) -> Float:
        steps: Float = np.round((vectors - centre) * scale / GRID)
        return steps * GRID

    def place_all(pieces: Pieces) -> Pieces:
        return tuple(Mesh(place(piece.vertices), piece.faces) for piece in pieces)

    def place_part(part: MovablePart) -> MovablePart:
        length = 1.0 if part.kind == "revolute" else scale
        return replace(
            part,
            pieces=place_all(part.pieces),
            origin=point(place(np.array(part.origin))),
            lower=part.lower * length,
            upper=part.upper * length,
        )

    return replace(assembly, body=place_all(assembly.body), parts=tuple(place_part(part) for part in assembly.parts))
