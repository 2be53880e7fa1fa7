"""What cannot be seen, as numbers for the oracle: hidden dynamics, and the ways in which the part can move.

The rows do not hold a joint's axis, but every row that moved its part says something of it: a point p of a part that
turns or slides by a small q is displaced by q (w x p + v), where (w, v) is the joint's *twist*. Its six numbers are
fitted to all rows that moved the same part of the same object; they tell the side of a hinge and its sign.

Shapes: I interactions.
"""

from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from shared.vocabulary import Float

DYNAMICS_WIDTH = 3
WAY_WIDTH = 7
KNOWN_WIDTH = 1
FACTS_WIDTH = DYNAMICS_WIDTH + 2 * WAY_WIDTH + KNOWN_WIDTH
MIN_ROOM = 0.01
"""A part that has less room, rad or length, cannot move that way: no such motion would count as a success."""
MIN_MOTION = 1e-3
"""Smallest motion, rad or length, that says anything of a twist."""
RIDGE = 1e-5
"""Keeps a twist that few rows determine small instead of wild."""
MIN_TURNING = 0.1
"""Length of w below which a part slides; that of a hinge is 1."""
MAX_ROOM = 3.15
"""A joint without limits has as much room as half a turn."""


@dataclass(frozen=True, slots=True)
class HiddenColumns:
    """Columns of the store that facts are made from; vectors in the world frame.

    Attributes:
        part: [I, 2] text, object and target part.
        point: [I, 3].
        displacement: [I, 3], NaN where unknown.
        motion: [I], signed, end minus start of the target joint; NaN where unknown.
        room: [I, 2], how far the target joint can go up and down from where it starts.
        dynamics: [I, 3], part mass, joint friction, surface friction.
        view: [I, 3, 3], view frame from world frame.
        middle: [I, 3], view frame, of what may be moved; actions are told their places from there.
    """

    part: list[tuple[str, int]]
    point: Float
    displacement: Float
    motion: Float
    room: Float
    dynamics: Float
    view: Float
    middle: Float


def facts_of(hidden: HiddenColumns) -> Float:
    """Facts for the oracle, [I, FACTS_WIDTH], in the view frame.

    Columns: log mass, joint friction, log surface friction; for each of the two ways in which the part might move, the
    room that it has and its twist (w, v), zero where there is no room; and whether the twist is known. A joint's sign
    is a convention of its file, so that the ways come in an order of their own (`ordered_ways`).
    """
    twists = fit_twists(hidden)
    known = [part in twists for part in hidden.part]
    twist = np.stack([twists.get(part, np.zeros(6)) for part in hidden.part]).reshape(-1, 2, 3)
    turned = np.einsum("iab,icb->ica", hidden.view, twist)
    # w x p + v is the same motion, whatever point p and v are taken from.
    turned[:, 1] += np.cross(turned[:, 0], hidden.middle)
    turned = turned.reshape(-1, 6)
    mass, friction, surface = hidden.dynamics.T
    numbers = np.stack([np.log(np.maximum(mass, 1e-6)), friction, np.log(np.maximum(surface, 1e-6))], axis=1)
    room = np.clip(np.nan_to_num(hidden.room, nan=0.0, posinf=MAX_ROOM), 0.0, MAX_ROOM)[..., None]
    both = np.stack([turned, -turned], axis=1) * (room > MIN_ROOM)
    ways = ordered_ways(torch.from_numpy(np.concatenate([room, both], axis=2))).numpy()
    return np.concatenate([numbers, ways.reshape(len(ways), -1), np.array(known, dtype=float)[:, None]], axis=1)


def ordered_ways(ways: Tensor) -> Tensor:
    """The two ways of each part, [..., 2, WAY_WIDTH], the one about (or along) the more positive axis first.

    The axis counts by its largest component; that of a twist whose w is zero is v.
    """
    difference = ways[..., 0, 1:] - ways[..., 1, 1:]
    turning, sliding = difference[..., :3], difference[..., 3:]
    axis = torch.where(turning.norm(dim=-1, keepdim=True) > MIN_TURNING, turning, sliding)
    largest = torch.gather(axis, -1, axis.abs().argmax(dim=-1, keepdim=True))
    return torch.where((largest < 0)[..., None], ways.flip(-2), ways)


def fit_twists(hidden: HiddenColumns) -> dict[tuple[str, int], Float]:
    """The twist (w, v), [6], world frame, of every part that some row moved."""
    says = np.isfinite(hidden.displacement).all(axis=1) & (np.abs(np.nan_to_num(hidden.motion)) > MIN_MOTION)
    rows = sorted(np.flatnonzero(says).tolist(), key=lambda row: hidden.part[row])
    twists = {}
    for part, group in groupby(rows, key=lambda row: hidden.part[row]):
        of_part = np.fromiter(group, dtype=np.int64)
        twists[part] = _fit(hidden.point[of_part], hidden.displacement[of_part], hidden.motion[of_part])
    return twists


def _fit(points: Float, displacements: Float, motions: Float) -> Float:
    """Least squares for (w, v) in displacement = motion * (w x p + v), with p half-way, where the chord is tangent."""
    middle = points + displacements / 2.0
    zero = np.zeros(len(middle))
    x, y, z = middle.T
    # w x p is minus the cross matrix of p times w.
    crosses = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    identity = np.broadcast_to(np.eye(3), crosses.shape)
    matrix = (np.concatenate([crosses, identity], axis=2) * motions[:, None, None]).reshape(-1, 6)
    normal = matrix.T @ matrix + RIDGE * np.eye(6)
    return np.asarray(np.linalg.solve(normal, matrix.T @ displacements.reshape(-1)), dtype=np.float64)
