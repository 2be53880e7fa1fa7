"""How far a hand can fly along a straight line before it may touch the object, by planes that separate convex pieces.

The engine does not answer that: it lists contact points of pairs that are apart in some steps and not in others.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject, Mesh
from collector.sim.engine import Link, convex_shapes, half_spaces
from shared.types import Float

PARALLEL = 1e-3
"""Sine of an angle below which two axes are taken for one."""
STANDS = 1e-30
"""m: what comes nearer by less than this in a step is taken to do so by this."""


class Piece:
    """A convex piece of a link, in the link's frame.

    Args:
        mesh: with outward faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh

    @property
    def corners(self) -> Float:
        """[V, 3]."""
        return self._mesh.vertices

    @cached_property
    def half_spaces(self) -> tuple[Float, Float]:
        """Outward normals [F, 3] of its faces and offsets [F]: for all of the piece, normal . x <= offset."""
        normals = half_spaces(self._mesh)[0]
        # Not from the faces' own corners: the normal of a sliver may be anything.
        return normals, (normals @ self.corners.T).max(axis=1)


@dataclass(frozen=True, slots=True)
class Pieces:
    """The convex pieces of some links, in order of these, with a box of each along the axes of its link.

    Attributes:
        each: the pieces.
        of_link: [P], the link of each.
        centres: [P, 4], of the boxes, frame of the link, as matrices take them: the last is 1.
        halves: [P, 3], half the lengths of their edges.
    """

    each: tuple[Piece, ...]
    of_link: NDArray[np.int64]
    centres: Float
    halves: Float


def pieces_of(links: Sequence[Link]) -> Pieces:
    """What links collide as."""
    by_link = [[Piece(mesh) for mesh in convex_shapes(link)] for link in links]
    each = tuple(piece for pieces in by_link for piece in pieces)
    corners = np.concatenate([np.zeros((0, 3)), *(piece.corners for piece in each)])
    starts = _starts(len(piece.corners) for piece in each)
    low, high = (extreme.reduceat(corners, starts, axis=0) if each else corners for extreme in (np.minimum, np.maximum))
    of_link = np.repeat(np.arange(len(links)), [len(pieces) for pieces in by_link])
    centres = np.append((low + high) / 2, np.ones((len(each), 1)), axis=1)
    return Pieces(each, of_link, centres, (high - low) / 2)


def pieces_of_object(target: ArticulatedObject, links: Sequence[Link]) -> Pieces:
    """What an object collides as, the same in every scene; read from `links`, those of one of them, at the first."""
    pieces = _OBJECTS.get(target)
    if pieces is None:
        pieces = _OBJECTS[target] = pieces_of(links)
    return pieces


_OBJECTS: WeakKeyDictionary[ArticulatedObject, Pieces] = WeakKeyDictionary()
"""Of the objects that somebody still holds."""


def _starts(counts: Iterable[int]) -> NDArray[np.int64]:
    return np.cumsum([0, *counts], dtype=np.int64)[:-1]


class FreeSpace:
    """The space around an object in which a hand can move.

    Args:
        hand: the hand's links; poses count from the first one, its palm.
        links: the object's.
        pieces: of `links`.

    Attributes:
        pieces: likewise.
    """

    def __init__(self, hand: Sequence[Link], links: Sequence[Link], pieces: Pieces) -> None:
        of_hand = pieces_of(hand)
        self._hand, self._links, self.pieces = hand, links, pieces
        corners = np.concatenate([piece.corners for piece in of_hand.each])
        self._corners = np.append(corners, np.ones((len(corners), 1)), axis=1)
        counts = [len(piece.corners) for piece in of_hand.each]
        self._starts, self._of_corner = _starts(counts), np.repeat(of_hand.of_link, counts)

    def steps(self, world_from_hand: Float, stride: Float, most: int, margin: float) -> int:
        """How many steps the hand can move without coming nearer to the object than `margin`, `most` at most.

        It is a lower bound. The fingers are as far open as they are now.

        Args:
            world_from_hand: [4, 4], where the palm starts.
            stride: [3], what it moves in each step, hand frame.
            most: steps that are asked for.
            margin: m.
        """
        corners, pieces = self._placed_corners(), self.pieces
        way = most * stride
        low = corners.min(axis=0) + np.minimum(way, 0.0) - margin
        high = corners.max(axis=0) + np.maximum(way, 0.0) + margin
        hand_from_pieces = _seen_from(world_from_hand, _matrices(self._links))[pieces.of_link]
        centres = (hand_from_pieces @ pieces.centres[:, :, None])[:, :, 0]
        reach = (np.abs(hand_from_pieces[:, :, :3]) @ pieces.halves[:, :, None])[:, :, 0]
        near = ((centres - reach <= high) & (centres + reach >= low)).all(axis=1).nonzero()[0]
        if not len(near):
            return most
        turns = hand_from_pieces[near, :, :3]
        axes = _axes(turns)
        hand = _ends(axes @ corners.T, self._starts)
        closing = axes @ stride
        paces = 1.0 / np.maximum(closing, STANDS), 1.0 / np.maximum(-closing, STANDS)
        middle = (axes @ centres[near, :, None])[:, :, 0]
        spread = (np.abs(axes @ turns) @ pieces.halves[near, :, None])[:, :, 0]
        at_least = _steps_along(hand, (middle - spread, middle + spread), paces, margin).min(axis=1)
        free = float(most)
        for k in at_least.argsort():
            if at_least[k] >= free:
                break
            piece, matrix = pieces.each[near[k]], hand_from_pieces[near[k]]
            along = axes[k] @ _moved(piece.corners, matrix).T
            of_hand, of_axes = (hand[0][k], hand[1][k]), (paces[0][k], paces[1][k])
            by_axes = _steps_along(of_hand, (along.min(axis=1), along.max(axis=1)), of_axes, margin)
            normals, offsets = piece.half_spaces
            normals = normals @ turns[k].T
            begins = np.minimum.reduceat(normals @ corners.T, self._starts, axis=1)
            room = begins - (offsets + normals @ matrix[:3, 3] + margin)[:, None]
            by_faces = (room / np.maximum(-(normals @ stride), STANDS)[:, None]).max(axis=0)
            free = min(free, float(np.maximum(by_faces, by_axes).min()))
        return int(max(free, 0.0))

    def _placed_corners(self) -> Float:
        """[C, 3], of all pieces of the hand, in the frame of its palm."""
        matrices = _matrices(self._hand)
        placed = _seen_from(matrices[0], matrices)[self._of_corner]
        return np.asarray((placed @ self._corners[:, :, None])[:, :, 0])


def _axes(hand_from_links: Float) -> Float:
    """Axes that separate boxes along the axes of the hand and of a link, for some links; of length 1, or 0 if parallel.

    Args:
        hand_from_links: rotations, [..., 3, 3].

    Returns:
        [..., 15, 3], hand frame.
    """
    own = hand_from_links.swapaxes(-1, -2)
    axes = np.zeros((*own.shape[:-2], 15, 3))
    axes[..., :3, :] = np.eye(3)
    axes[..., 3:6, :] = own
    # Those of the hand across those of the link.
    axes[..., 6:9, 1], axes[..., 6:9, 2] = -own[..., 2], own[..., 1]
    axes[..., 9:12, 0], axes[..., 9:12, 2] = own[..., 2], -own[..., 0]
    axes[..., 12:, 0], axes[..., 12:, 1] = -own[..., 1], own[..., 0]
    lengths = np.sqrt((axes * axes).sum(axis=-1, keepdims=True))
    axes *= (lengths > PARALLEL) / np.maximum(lengths, PARALLEL)
    return axes


def _ends(along: Float, starts: NDArray[np.int64]) -> tuple[Float, Float]:
    """Where pieces begin and where they end, [..., pieces], of where their corners are, [..., corners]."""
    return np.minimum.reduceat(along, starts, axis=-1), np.maximum.reduceat(along, starts, axis=-1)


def _steps_along(
    hand: tuple[Float, Float], piece: tuple[Float, Float], paces: tuple[Float, Float], margin: float
) -> Float:
    """Steps until pieces are no more than `margin` apart along each of some axes, [..., pieces of the hand].

    Less than 0 where they are so from the start.

    Args:
        hand: where each piece of the hand begins and ends along each axis, [..., axes, pieces of the hand].
        piece: where a piece of the object does, [..., axes].
        paces: steps that the hand takes for a metre along each axis, forth and back, [..., axes].
        margin: m.
    """
    before = ((piece[0] - margin)[..., None] - hand[1]) * paces[0][..., None]
    behind = (hand[0] - (piece[1] + margin)[..., None]) * paces[1][..., None]
    return np.asarray(np.maximum(before, behind).max(axis=-2))


def _matrices(links: Sequence[Link]) -> Float:
    """world_from_link, [links, 4, 4]."""
    return np.array([link.entity_pose.to_transformation_matrix() for link in links], dtype=np.float64)


def _seen_from(world_from_frame: Float, world_from_links: Float) -> Float:
    """frame_from_link, [links, 3, 4], of a rigid frame, [4, 4], and links, [links, 4, 4]."""
    apart = world_from_links[:, :3].copy()
    apart[:, :, 3] -= world_from_frame[:3, 3]
    return np.asarray(world_from_frame[:3, :3].T @ apart)


def _moved(points: Float, matrix: Float) -> Float:
    """Points, [P, 3], by a rigid matrix, [3, 4]."""
    return points @ matrix[:, :3].T + matrix[:, 3]
