"""What cannot be seen, as numbers for the oracle: hidden dynamics, and the ways in which the part can move.

A row's *twist* (w, v) says how its part moves: a point p that turns or slides by a small q is displaced by
q (w x p + v). It tells the side of a hinge and its sign.

Shapes: I interactions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shared.config import DynamicsRanges, Range
from shared.hidden import ALWAYS_DRAWN
from shared.types import Float

WAY_WIDTH = 7
WAYS_WIDTH = 2 * WAY_WIDTH
FACTS_WIDTH = len(ALWAYS_DRAWN) + WAYS_WIDTH
"""Where no other hidden parameters are drawn than always; each further one adds a number."""
_TOLD_AS: dict[str, Callable[[Float], Float]] = {
    "part_mass": lambda values: np.log(np.maximum(values, 1e-6)),
    "joint_friction": lambda values: values,
    "surface_friction": lambda values: np.log(np.maximum(values, 1e-6)),
}
"""How oracles were told these from the beginning; others are told as a place in their range."""
MIN_ROOM = 0.01
"""A part that has less room, rad or length, cannot move that way: no such motion would count as a success."""
MIN_TURNING = 0.1
"""Length of w below which a part slides; that of a hinge is 1."""
MAX_ROOM = 3.15
"""A joint without limits has as much room as half a turn."""


@dataclass(frozen=True, slots=True)
class HiddenColumns:
    """Columns of the store that facts are made from.

    Attributes:
        twist: [I, 6], (w, v) of the target joint, world frame.
        room: [I, 2], how far the target joint can go up and down from where it starts.
        dynamics: [I] each, the values of the hidden parameters.
        ranges: that they were drawn from.
        view: [I, 3, 3], view frame from world frame.
        middle: [I, 3], view frame, of what may be moved; actions are told their places from there.
    """

    twist: Float
    room: Float
    dynamics: Mapping[str, Float]
    ranges: DynamicsRanges
    view: Float
    middle: Float


def facts_of(hidden: HiddenColumns) -> Float:
    """Facts for the oracle, [I, FACTS_WIDTH or more], in the view frame.

    Columns: a number for each hidden parameter, first those that are always drawn; for each of the two ways in which
    the part might move, the room that it has and its twist (w, v), zero where there is no room. A joint's sign is a
    convention of its file, so that the ways come in an order of their own (`ordered_ways`).
    """
    turned = np.einsum("iab,icb->ica", hidden.view, hidden.twist.reshape(-1, 2, 3))
    # w x p + v is the same motion, whatever point p and v are taken from.
    turned[:, 1] += np.cross(turned[:, 0], hidden.middle)
    turned = turned.reshape(-1, 6)
    told = [_TOLD_AS[name](hidden.dynamics[name]) for name in ALWAYS_DRAWN]
    told += [_place(hidden.dynamics[name], hidden.ranges[name]) for name in hidden.ranges.added]
    room = np.clip(np.nan_to_num(hidden.room, nan=0.0, posinf=MAX_ROOM), 0.0, MAX_ROOM)[..., None]
    both = np.stack([turned, -turned], axis=1) * (room > MIN_ROOM)
    ways = ordered_ways(torch.from_numpy(np.concatenate([room, both], axis=2))).numpy()
    return np.concatenate([np.stack(told, axis=1), ways.reshape(len(ways), -1)], axis=1)


def _place(values: Float, interval: Range) -> Float:
    """Where values lie in an interval that they were drawn from: -1 at its lower end, 1 at its upper end."""
    low, high = interval.low, interval.high
    if interval.log:
        low, high, values = np.log(low), np.log(high), np.log(np.maximum(values, 1e-12))
    return np.asarray(2.0 * (values - low) / max(high - low, 1e-12) - 1.0)


def ordered_ways(ways: Tensor) -> Tensor:
    """The two ways of each part, [..., 2, WAY_WIDTH], the one about (or along) the more positive axis first.

    The axis counts by its largest component; that of a twist whose w is zero is v.
    """
    difference = ways[..., 0, 1:] - ways[..., 1, 1:]
    turning, sliding = difference[..., :3], difference[..., 3:]
    axis = torch.where(turning.norm(dim=-1, keepdim=True) > MIN_TURNING, turning, sliding)
    largest = torch.gather(axis, -1, axis.abs().argmax(dim=-1, keepdim=True))
    return torch.where((largest < 0)[..., None], ways.flip(-2), ways)
