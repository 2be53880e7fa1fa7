"""The convex pieces that objects are made of, and an object under construction: a body and the parts that hang on it.

Directions are unit vectors as triples. Objects face -x, left is +y, up is +z; all is in one frame, all closed. Each
piece is one convex mesh, so that its hull in physics is itself; hollow things are made of several.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from itertools import pairwise

import numpy as np

from collector.objects import meshes
from collector.objects.articulation import Mesh
from collector.objects.model import MovablePart, ObjectModel, Pieces, Point, bounding_box, mapped, point
from shared.types import Float

FRONT: Point = (-1.0, 0.0, 0.0)
BACK: Point = (1.0, 0.0, 0.0)
LEFT: Point = (0.0, 1.0, 0.0)
RIGHT: Point = (0.0, -1.0, 0.0)
TOP: Point = (0.0, 0.0, 1.0)
BOTTOM: Point = (0.0, 0.0, -1.0)


def block(low: Point, high: Point) -> Mesh:
    """The axis-aligned box from `low` to `high`."""
    size = np.subtract(high, low)
    assert (size > 0).all(), f"an empty box from {low} to {high}"
    pose = np.eye(4)
    pose[:3, 3] = np.add(low, high) / 2
    return meshes.placed(meshes.box(size), pose)


def rod(start: Point, end: Point, radius: float, end_radius: float | None = None, sides: int = 16) -> Mesh:
    """A cylinder, or a truncated cone, from `start` to `end`."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    pose = np.eye(4)
    pose[:3, 2] = along / length
    # Any direction across will do; the fixed choice keeps a shape's sides where they were.
    aside = np.cross(pose[:3, 2], BACK if abs(pose[0, 2]) < 0.9 else LEFT)
    pose[:3, 0] = aside / np.linalg.norm(aside)
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    pose[:3, 3] = np.add(start, end) / 2
    return meshes.placed(meshes.frustum(radius, radius if end_radius is None else end_radius, length, sides), pose)


def hollow_box(low: Point, high: Point, wall: float, openings: Collection[Point]) -> Pieces:
    """Panels around a cavity; the faces whose directions are in `openings` are left out."""
    inner = [list(low), list(high)]
    pieces = []
    for axis in (2, 1, 0):
        for side, sign in ((0, -1.0), (1, 1.0)):
            if tuple(sign if i == axis else 0.0 for i in range(3)) in {tuple(o) for o in openings}:
                continue
            panel = [list(inner[0]), list(inner[1])]
            # The panel keeps its outer face and takes `wall` of the room; what comes later fits in between.
            panel[1 - side][axis] = inner[side][axis] = inner[side][axis] - sign * wall
            pieces.append(block((panel[0][0], panel[0][1], panel[0][2]), (panel[1][0], panel[1][1], panel[1][2])))
    return tuple(pieces)


def tub(bottom_radius: float, top_radius: float, low: float, high: float, wall: float) -> Pieces:
    """A round vessel about the z axis, open at the top: staves around, and a floor."""
    sides = 16
    angles = 2 * np.pi * (np.arange(sides + 1) + 0.5) / sides
    pieces = [rod((0.0, 0.0, low), (0.0, 0.0, low + wall), bottom_radius - wall / 2, sides=sides)]
    for first, second in pairwise(angles):
        corners = [
            [radius * np.cos(angle), radius * np.sin(angle), height]
            for angle in (first, second)
            for outer, height in ((bottom_radius, low), (top_radius, high))
            for radius in (outer - wall, outer)
        ]
        pieces.append(Mesh(np.array(corners), _STAVE_FACES))
    return tuple(pieces)


def ring(low: Point, high: Point, width: float) -> Pieces:
    """A rectangular frame in the y-z plane, `width` wide, open in the middle."""
    return hollow_box(low, high, width, (FRONT, BACK))


def arch(radius: float, thickness: float, lean: float) -> Pieces:
    """Half a hoop about the origin from +y to -y, leaning `lean` rad from upright towards -x."""
    angles = np.pi * np.arange(9) / 8
    points = [
        (-radius * np.sin(a) * np.sin(lean), radius * np.cos(a), radius * np.sin(a) * np.cos(lean)) for a in angles
    ]
    return tuple(rod(start, end, thickness, sides=8) for start, end in pairwise(points))


def grip(centre: Point, along: Point, outward: Point, length: float, stand_off: float, radius: float) -> Pieces:
    """A bar on two posts, as on drawers and doors.

    Args:
        centre: on the surface that carries it.
        along: direction of the bar.
        outward: direction of the posts.
        length: of the bar.
        stand_off: of the bar's axis from the surface.
        radius: of bar and posts.
    """
    middle = np.add(centre, np.multiply(outward, stand_off))
    half = np.multiply(along, length / 2)
    posts = [np.multiply(along, sign * (length / 2 - 2 * radius)) for sign in (-1, 1)]
    pieces = [rod(point(np.subtract(middle, half)), point(np.add(middle, half)), radius, sides=8)]
    pieces += [rod(point(np.add(centre, post)), point(np.add(middle, post)), radius * 0.8, sides=8) for post in posts]
    return tuple(pieces)


def moved(pieces: Pieces, by: Point) -> Pieces:
    """The pieces, shifted."""
    return tuple(Mesh(piece.vertices + np.array(by), piece.faces) for piece in pieces)


_STAVE_FACES = meshes.box(np.ones(3)).faces
"""A stave has a box's topology: its corners are listed along one side, then up, then outward, as a box's are."""


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
