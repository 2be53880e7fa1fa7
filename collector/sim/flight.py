"""How far a hand can fly along a straight line before it may touch the object, by planes that separate convex pieces.

The engine does not answer that: it lists contact points of pairs that are apart in some steps and not in others.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from collector.sim.engine import Link, half_spaces
from shared.types import Float

PARALLEL = 1e-3
"""Sine of an angle below which two axes are taken for one."""


@dataclass(frozen=True, slots=True)
class Pieces:
    """The convex pieces of one link, in its frame.

    Attributes:
        vertices: [V, 3], of all pieces, one after the other.
        vertex_starts: [P], the first vertex of each piece.
        normals: [F, 3], outward, of the faces of all pieces.
        offsets: [F], of the faces: for all of a piece, normal . x <= offset.
        face_starts: [P], the first face of each piece.
        centre: [3], of a sphere around all of them.
        radius: of that sphere.
    """

    vertices: Float
    vertex_starts: NDArray[np.int64]
    normals: Float
    offsets: Float
    face_starts: NDArray[np.int64]
    centre: Float
    radius: float


def pieces_of(link: Link) -> Pieces | None:
    """What a link collides as; None if it does not collide."""
    corners = [np.asarray(shape.vertices, dtype=np.float64) for shape in link.collision_shapes]
    if not corners:
        return None
    normals = [half_spaces(shape)[0] for shape in link.collision_shapes]
    vertices = np.concatenate(corners)
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Pieces(
        vertices=vertices,
        vertex_starts=_starts(len(of_piece) for of_piece in corners),
        normals=np.concatenate(normals),
        # Not from the faces' own corners: the normal of a sliver may be anything.
        offsets=np.concatenate([(n @ of_piece.T).max(axis=1) for n, of_piece in zip(normals, corners, strict=True)]),
        face_starts=_starts(len(of_piece) for of_piece in normals),
        centre=centre,
        radius=float(np.linalg.norm(vertices - centre, axis=1).max()),
    )


def _starts(counts: Iterable[int]) -> NDArray[np.int64]:
    return np.cumsum([0, *counts], dtype=np.int64)[:-1]


class FreeSpace:
    """The space around an object in which a hand can move.

    Args:
        hand: the hand's links; poses count from the first one, its palm.
        links: the object's.
    """

    def __init__(self, hand: Sequence[Link], links: Sequence[Link]) -> None:
        self._palm = hand[0]
        self._hand = [(link, pieces) for link in hand if (pieces := pieces_of(link))]
        self._object = [(link, pieces) for link in links if (pieces := pieces_of(link))]

    def steps(self, world_from_hand: Float, stride: Float, most: int, margin: float) -> int:
        """How many steps the hand can move without coming nearer to the object than `margin`, `most` at most.

        It is a lower bound. The fingers are as far open as they are now.

        Args:
            world_from_hand: [4, 4], where the palm starts.
            stride: [3], what it moves in each step, hand frame.
            most: steps that are asked for.
            margin: m.
        """
        palm_from_world = np.linalg.inv(_matrix(self._palm))
        placed = [_moved(pieces.vertices, palm_from_world @ _matrix(link)) for link, pieces in self._hand]
        corners = np.concatenate(placed)
        counts = np.cumsum([0, *map(len, placed)])
        starts = np.concatenate([pieces.vertex_starts + n for (_, pieces), n in zip(self._hand, counts, strict=False)])
        low, high = np.minimum.reduceat(corners, starts), np.maximum.reduceat(corners, starts)
        way = most * stride
        nearest = low.min(axis=0) + np.minimum(way, 0.0) - margin, high.max(axis=0) + np.maximum(way, 0.0) + margin
        hand_from_world = np.linalg.inv(world_from_hand)
        free = float(most)
        for link, pieces in self._object:
            hand_from_link = hand_from_world @ _matrix(link)
            centre = hand_from_link[:3, :3] @ pieces.centre + hand_from_link[:3, 3]
            beside = centre - np.clip(centre, *nearest)
            if beside @ beside > pieces.radius**2:
                continue
            normals = pieces.normals @ hand_from_link[:3, :3].T
            beyond = np.minimum.reduceat(normals @ corners.T, starts, axis=1)
            room = beyond - (pieces.offsets + normals @ hand_from_link[:3, 3])[:, None]
            by_faces = _steps_until(room, -(normals @ stride)[:, None], margin)
            axes = _axes(hand_from_link[:3, :3])
            reach, extent = corners @ axes.T, _moved(pieces.vertices, hand_from_link) @ axes.T
            closing, of_piece = axes @ stride, pieces.vertex_starts
            before = np.minimum.reduceat(extent, of_piece)[:, None] - np.maximum.reduceat(reach, starts)
            behind = np.minimum.reduceat(reach, starts) - np.maximum.reduceat(extent, of_piece)[:, None]
            by_axes = np.maximum(_steps_until(before, closing, margin), _steps_until(behind, -closing, margin))
            by_faces = np.maximum.reduceat(by_faces, pieces.face_starts)
            free = min(free, float(np.maximum(by_faces, by_axes.max(axis=2)).min()))
        return int(free)


def _axes(hand_from_link: Float) -> Float:
    """Unit vectors, [A, 3], hand frame, that separate boxes along the axes of the hand and of a link."""
    crossed = np.cross(np.eye(3)[:, None], hand_from_link.T[None]).reshape(9, 3)
    lengths = np.linalg.norm(crossed, axis=1)
    apart = lengths > PARALLEL
    return np.concatenate([np.eye(3), crossed[apart] / lengths[apart, None]])


def _steps_until(room: Float, closing: Float, margin: float) -> Float:
    """Steps until what is `room` apart along an axis, and comes nearer by `closing` a step, is `margin` apart."""
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.where(closing > 0, (room - margin) / closing, np.inf)
    return np.where(room >= margin, steps, 0.0)


def _matrix(link: Link) -> Float:
    return np.asarray(link.entity_pose.to_transformation_matrix(), dtype=np.float64)


def _moved(points: Float, matrix: Float) -> Float:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
