"""An object under construction: a static body and the parts that hang on it, all in one frame, all closed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point, bounding_box, mapped, point
from collector.objects.procedural.shapes import moved
from shared.types import Float

GRID = 2.0**-14
"""Coordinates are multiples of this, so that moving them between frames rounds nothing: twins stay identical."""


def hinged(name: str, pieces: Pieces, corner: Point, edge: Point, outward: Point, upper: float) -> MovablePart:
    """A panel that turns outward about one of its edges.

    Its axis runs along the outer face: a panel turned there leaves its frame and its neighbours without touching them.

    Args:
        name: semantic name.
        pieces: the panel and what is on it.
        corner: a point of the edge, on the outer face.
        edge: direction from the panel's middle to the edge that it turns about.
        outward: direction in which the far edge moves first.
        upper: how far it opens, rad.
    """
    return MovablePart(name, "revolute", pieces, corner, point(np.cross(np.negative(edge), outward)), upper)


def sliding(name: str, pieces: Pieces, direction: Point, upper: float) -> MovablePart:
    """A part that slides along `direction`."""
    return MovablePart(name, "prismatic", pieces, (0.0, 0.0, 0.0), direction, upper)


def shifted(part: MovablePart, by: Point) -> MovablePart:
    """The part somewhere else."""
    return replace(part, pieces=moved(part.pieces, by), origin=point(np.add(part.origin, by)))


def either(
    rng: np.random.Generator,
    first: Callable[[np.random.Generator], ObjectModel],
    second: Callable[[np.random.Generator], ObjectModel],
) -> ObjectModel:
    """An object of one of two kinds, equally often; what is drawn for the first does not depend on the second."""
    (aside,) = rng.spawn(1)
    return second(aside) if aside.random() < 0.5 else first(rng)


def normalised(assembly: ObjectModel) -> ObjectModel:
    """The object about the origin, its bounding box's diagonal 2, as PartNet-Mobility has it, on the grid."""
    low, high = bounding_box(assembly)
    scale, centre = 2.0 / float(np.linalg.norm(high - low)), (low + high) / 2

    def place(vectors: Float) -> Float:
        steps: Float = np.round((vectors - centre) * scale / GRID)
        return steps * GRID

    return mapped(assembly, place, lambda axis: axis, scale)
