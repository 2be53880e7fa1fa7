"""How actions and outcomes enter the networks: their numbers, in the view frame.

A *frame* is the six numbers of a gripper's rotation: approach, then forward (Where2Act, by way of 6D rotations). Where
`config.pinch_profile` is set, the pinch profile of the action follows in the same tensor (see `shared.pinch`).
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from shared.networks.network_config import NetworkConfig
from shared.pinch import BINS
from shared.types import MAX_GRASP_WIDTH, Float32, OutcomeKind

FRAME_WIDTH = 6
MOTION_SCALE = 0.01
"""The motion that counts as a success, tau of the paper; log(1 + m / tau) spreads small motions out."""
PLACE_SCALE = 3.0
"""Places on an object, a few tenths of a unit, come to about 1."""
MOMENT_SCALE = 10.0
"""Lever arms that decide whether a part turns, some hundredths of a unit, come to some tenths."""
TOLD_KINDS = (
    *(OutcomeKind.OK, OutcomeKind.NO_CONTACT, OutcomeKind.NO_GRASP, OutcomeKind.START_COLLISION),
    *(OutcomeKind.WRONG_PART, OutcomeKind.HAND_CONTACT, OutcomeKind.UNSTABLE),
)
"""The kinds of outcome in the order in which networks are told them. They say whether the contact was valid, too."""
DETAIL_WIDTH = 1 + len(TOLD_KINDS) + 2
"""Numbers of `outcome_details`."""
GRASP_SCALE = 20.0
"""Widths of grasps, some centimetres, come to about 1."""
_DEGENERATE = 1e-4
"""Length below which a direction is mostly rounding."""


def action_width(config: NetworkConfig) -> int:
    """How many numbers describe an action."""
    return 12 if config.action_features else FRAME_WIDTH


def action_inputs(points: Tensor, frames: Tensor, config: NetworkConfig) -> Tensor:
    """The numbers that describe actions, [..., action_width].

    Deviation from the paper, where `config.action_features` is set: p and the approach's moment p x d are added, in the
    gravity-aligned view frame, since whether a push turns a hinge is linear in them. They are taken from the middle of
    what may be moved (`middle_of`), close to a knob's axis and half-way between the two edges where a door may hang.

    Args:
        points: p less the middle, [..., 3], broadcast against the frames.
        frames: approach and forward, [..., 6]; a profile that follows is not used.
        config: the sizes.
    """
    frames = frames[..., :FRAME_WIDTH]
    if not config.action_features:
        return frames
    places = points.expand(*frames.shape[:-1], 3)
    moments = torch.linalg.cross(places, frames[..., :3])
    return torch.cat([frames, PLACE_SCALE * places, MOMENT_SCALE * moments], dim=-1)


def in_gripper(offsets: Tensor, frames: Tensor) -> Tensor:
    """Offsets [..., k, 3] from p as a gripper at p has them, (forward, across, approach); leading axes broadcast."""
    approach, forward, across = _columns(frames)
    axes = torch.stack([forward, across, approach], dim=-1)
    return offsets @ axes


def turned_over(frames: Tensor) -> Tensor:
    """The same actions with the gripper turned by 180 deg about its approach, so that its fingers are swapped."""
    turned = torch.cat([frames[..., :3], -frames[..., 3:FRAME_WIDTH], frames[..., FRAME_WIDTH:]], dim=-1)
    return swapped_fingers(turned)


def swapped_fingers(frames: Tensor) -> Tensor:
    """Frames whose pinch profiles, where there are some, begin at the other finger."""
    if frames.shape[-1] == FRAME_WIDTH:
        return frames
    frame, profile = frames[..., :FRAME_WIDTH], frames[..., FRAME_WIDTH:]
    surface, there, rest = profile[..., :BINS], profile[..., BINS : 2 * BINS], profile[..., 2 * BINS :]
    return torch.cat([frame, surface.flip(-1), there.flip(-1), rest], dim=-1)


def middle_of(points: Tensor, movable: Tensor) -> Tensor:
    """The mean of a cloud's movable points, [..., 3]; of all of them where none is.

    Args:
        points: [..., N, 3].
        movable: [..., N].
    """
    counted = torch.where(movable.any(dim=-1, keepdim=True), movable, torch.ones_like(movable))[..., None]
    return (points * counted).sum(dim=-2) / counted.sum(dim=-2)


def outcome_width(config: NetworkConfig) -> int:
    """How many numbers describe an outcome."""
    return (3 if config.outcome_features else 1) + (DETAIL_WIDTH if config.outcome_details else 0)


def outcome_details(kinds: Sequence[str], grasp_widths: ArrayLike) -> Float32:
    """What is known of outcomes beside m and r, [I, DETAIL_WIDTH].

    In this order: whether the kind is known, the kind (one of `TOLD_KINDS` is 1), whether the grasp width is known, the
    grasp width. What is unknown is zeros.

    Args:
        kinds: values of `OutcomeKind`, [I].
        grasp_widths: m, [I]; NaN where it is unknown, or where the primitive closes no fingers.
    """
    widths = np.asarray(grasp_widths, dtype=np.float64)
    details = np.zeros((len(kinds), DETAIL_WIDTH), np.float32)
    for number, kind in enumerate(TOLD_KINDS, start=1):
        details[:, number] = np.asarray(kinds) == kind.value
    details[:, 0] = details[:, 1:-2].sum(axis=1)
    known = np.isfinite(widths)
    details[:, -2] = known
    details[known, -1] = GRASP_SCALE * widths[known].clip(0.0, MAX_GRASP_WIDTH)
    return details


def without_details(details: Tensor, no_kind: Tensor, no_width: Tensor) -> Tensor:
    """Details of outcomes, [..., DETAIL_WIDTH], with the kind or the grasp width made unknown where said, [...]."""
    return torch.cat(
        [details[..., :-2] * ~no_kind[..., None], details[..., -2:] * ~no_width[..., None]],
        dim=-1,
    )


def outcome_inputs(motions: Tensor, successes: Tensor, config: NetworkConfig, details: Tensor | None = None) -> Tensor:
    """The numbers that describe outcomes, [..., outcome_width].

    Args:
        motions: m, [...].
        successes: r as 0 or 1, [...]; used only where `config.outcome_features` is set (a deviation: the paper has m).
        config: the sizes.
        details: see `outcome_details`, [..., DETAIL_WIDTH]; used only where `config.outcome_details` is set (a
            deviation as well). None: all are unknown.
    """
    inputs = motions[..., None]
    if config.outcome_features:
        inputs = torch.stack([motions, torch.log1p(motions / MOTION_SCALE), successes], dim=-1)
    if not config.outcome_details:
        return inputs
    if details is None:
        details = motions.new_zeros(*motions.shape, DETAIL_WIDTH)
    return torch.cat([inputs, details], dim=-1)


def orthonormal_frames(raw: Tensor) -> Tensor:
    """Six free numbers to approach and forward, unit and at right angles (Gram-Schmidt), [..., 6].

    Numbers that determine no rotation (a zero or a parallel pair) still give one, so that no weights can make an
    action that is not a rotation.
    """
    # In half precision, a rotation would be off by a degree.
    raw = raw.to(torch.promote_types(raw.dtype, torch.float32))
    approach = _unit(raw[..., :3], raw.new_tensor([1.0, 0.0, 0.0]))
    # The axis that the approach has least of is never parallel to it.
    spare = functional.one_hot(approach.detach().abs().argmin(dim=-1), 3).to(raw.dtype)
    forward = _unit(_across(_unit(raw[..., 3:], spare), approach), _across(spare, approach))
    # Of a nearly parallel pair the first pass leaves mostly rounding; the second takes that out.
    return torch.cat([approach, functional.normalize(_across(forward, approach), dim=-1)], dim=-1)


def geodesic_distance(frames: Tensor, others: Tensor) -> Tensor:
    """Angle, rad, between rotations given as approach and forward, [..., 6] each."""
    trace = sum((a * b).sum(dim=-1) for a, b in zip(_columns(frames), _columns(others), strict=True))
    assert isinstance(trace, Tensor)
    # The slope of the arc cosine is infinite at its ends, which equal rotations reach.
    return torch.arccos(((trace - 1.0) / 2.0).clamp(-1.0 + 1e-6, 1.0 - 1e-6))


def _columns(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    approach, forward = frames[..., :3], frames[..., 3:FRAME_WIDTH]
    return approach, forward, torch.linalg.cross(approach, forward)


def _across(x: Tensor, unit: Tensor) -> Tensor:
    """The part of `x` at right angles to a unit vector."""
    return x - (x * unit).sum(dim=-1, keepdim=True) * unit


def _unit(x: Tensor, fallback: Tensor) -> Tensor:
    length = x.norm(dim=-1, keepdim=True)
    return torch.where(length > _DEGENERATE, x / length.clamp_min(_DEGENERATE), fallback)
