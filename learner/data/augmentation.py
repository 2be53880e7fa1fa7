"""Seeing the same interactions turned about the vertical, and in a mirror; not in the paper.

Gravity points down in the view frame, so that physics is the same after a turn about z or a reflection of y; the hand
is its own mirror image once its fingers are swapped, which keeps approach and forward. Neighbours stay neighbours.

Shapes: B ordered sets of interactions, one rotation or reflection each.
"""

import numpy as np
import torch
from torch import Tensor

from learner.data.privileged import WAY_WIDTH, WAYS_WIDTH, ordered_ways
from learner.settings import AugmentationConfig
from shared.networks.actions import FRAME_WIDTH, swapped_fingers, turned_over


def draw_turns(count: int, config: AugmentationConfig, rng: np.random.Generator) -> Tensor:
    """Orthogonal matrices that keep the vertical, [count, 3, 3]."""
    angle = np.deg2rad(config.turn_deg) * rng.uniform(-1.0, 1.0, count)
    mirrored = rng.random(count) < 0.5 if config.mirror else np.zeros(count, dtype=bool)
    cos, sin, sign = np.cos(angle), np.sin(angle), np.where(mirrored, -1.0, 1.0)
    turns = np.zeros((count, 3, 3), dtype=np.float32)
    turns[:, 0, 0], turns[:, 0, 1] = cos, -sin * sign
    turns[:, 1, 0], turns[:, 1, 1] = sin, cos * sign
    turns[:, 2, 2] = 1.0
    return torch.as_tensor(turns)


def draw_flips(count: int, config: AugmentationConfig, rng: np.random.Generator) -> Tensor:
    """Whether the gripper is turned about its approach in each set, [count]."""
    return torch.as_tensor(rng.random(count) < 0.5 if config.flip else np.zeros(count, dtype=bool))


def turn_frames(turns: Tensor, frames: Tensor) -> Tensor:
    """Frames with or without pinch profiles, [B, n, 6 or more], after the turns [B, 3, 3]."""
    if frames.shape[-1] == FRAME_WIDTH:
        return turn_vectors(turns, frames)
    turned = torch.cat([turn_vectors(turns, frames[..., :FRAME_WIDTH]), frames[..., FRAME_WIDTH:]], dim=-1)
    # A mirror keeps approach and forward, and so swaps the fingers.
    return torch.where((torch.linalg.det(turns) < 0)[:, None, None], swapped_fingers(turned), turned)


def flip_frames(flips: Tensor, frames: Tensor) -> Tensor:
    """Frames with or without pinch profiles, [B, n, 6 or more], turned about the approach in the sets `flips`, [B]."""
    return torch.where(flips[:, None, None], turned_over(frames), frames) if flips.any() else frames


def turn_vectors(turns: Tensor, vectors: Tensor) -> Tensor:
    """Vectors or points, [B, n, 3 k], each three of them turned by the matrices [B, 3, 3]."""
    triples = vectors.reshape(*vectors.shape[:2], -1, 3)
    return _turned(turns, triples).reshape(vectors.shape)


def turn_facts(turns: Tensor, facts: Tensor) -> Tensor:
    """Facts for the oracle, [B, n, facts], of what is seen after the turns (see `learner.data.privileged`)."""
    dynamics = facts[..., :-WAYS_WIDTH]
    ways = facts[..., -WAYS_WIDTH:].reshape(*facts.shape[:2], 2, WAY_WIDTH)
    room, turning, sliding = ways[..., :1], ways[..., 1:4], ways[..., 4:]
    # An axis of rotation is the cross product of two vectors: a mirror turns it round beside reflecting it.
    handed = torch.linalg.det(turns)[:, None, None, None]
    turning = handed * _turned(turns, turning)
    sliding = _turned(turns, sliding)
    turned = ordered_ways(torch.cat([room, turning, sliding], dim=-1))
    return torch.cat([dynamics, turned.flatten(-2)], dim=-1)


def _turned(turns: Tensor, triples: Tensor) -> Tensor:
    """Vectors [B, n, k, 3] turned; a sum of products, since a matrix product may be taken in half precision."""
    return (turns[:, None, None] * triples[..., None, :]).sum(dim=-1)
