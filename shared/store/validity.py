"""The rules of rollouts, which are checked before they are stored and after they are read."""

import math
from collections.abc import Sequence

import numpy as np

from shared.errors import StoreError
from shared.hidden import ALWAYS_DRAWN
from shared.plan import InteractionRecord, Job, RolloutRecord, RolloutStatus
from shared.store.codecs.columns import MAX_TEXT
from shared.store.codecs.observations import check_observation, depth_size
from shared.store.layout import MAX_ALL_PIXELS, MAX_ALL_POINTS, MAX_ROWS, Quarantined
from shared.types import Float

MAX_PARTS = 255
"""Movable parts that an object may have: part ids are bytes."""


def check_rollouts(rollouts: Sequence[RolloutRecord], job: Job, points: int, source: str) -> None:
    """Check that the rollouts of a shard belong to its job and follow the rules of a record.

    Args:
        rollouts: in order.
        job: the range that they must have.
        points: N, of every cloud.
        source: their name in messages.

    Raises:
        StoreError: with the rollout, the step and what is wrong.
    """
    if [rollout.index for rollout in rollouts] != list(range(job.start, job.stop)):
        raise StoreError(f"{source}: needs rollouts {job.start} to {job.stop - 1}, each once and in order")
    clouds = sum(len(rollout.observations) for rollout in rollouts)
    tries = sum(len(rollout.interactions) for rollout in rollouts)
    try:
        pixels = clouds * depth_size(seen for rollout in rollouts for seen in rollout.observations) ** 2
    except ValueError as error:
        raise StoreError(f"{source}: {error}") from None
    if clouds * points > MAX_ALL_POINTS or pixels > MAX_ALL_PIXELS or max(clouds, tries, len(rollouts)) > MAX_ROWS:
        raise StoreError(
            f"{source}: {clouds} clouds and {tries} interactions are too many for one shard; divide the job"
        )
    for rollout in rollouts:
        try:
            if rollout.dynamics.added != rollouts[0].dynamics.added:
                raise ValueError("has other hidden parameters than the rollout before it")
            if rollout.plan_key != job.plan_key:
                raise ValueError(f"belongs to plan '{rollout.plan_key}', not '{job.plan_key}'")
            _check_rollout(rollout, points)
        except (ValueError, TypeError, AttributeError) as error:
            raise StoreError(f"{source}: rollout {rollout.index}: {error}") from None


def check_quarantined(rollouts: Sequence[RolloutRecord], quarantined: Sequence[Quarantined], source: str) -> None:
    """Check the quarantined rollouts of a manifest against the rollouts.

    Raises:
        StoreError: a reason is given for a rollout that was executed.
    """
    given_up = {rollout.index for rollout in rollouts if rollout.status is RolloutStatus.QUARANTINED}
    for each in quarantined:
        if each.rollout not in given_up:
            raise StoreError(f"{source}: rollout {each.rollout} was executed, so no reason can be given why it was not")


def _check_rollout(rollout: RolloutRecord, points: int) -> None:
    if len(rollout.arm_base) not in (0, 4):
        raise ValueError(f"needs an arm_base of 4 numbers or none; given {len(rollout.arm_base)}")
    _check_texts(rollout.fidelity, rollout.status, rollout.object.category)
    if missing := ALWAYS_DRAWN.keys() - rollout.dynamics.values.keys():
        raise ValueError(f"lacks the hidden parameter '{min(missing)}'")
    drawn = [*rollout.dynamics.values.values(), rollout.azimuth_deg, rollout.elevation_deg]
    _check_finite("rollout's numbers", drawn)
    for observation in rollout.observations:
        check_observation(observation, points)
    if rollout.status is not RolloutStatus.OK and (rollout.interactions or rollout.observations):
        raise ValueError(f"is '{rollout.status}', so it cannot hold what it saw or did")
    steps = [interaction.step for interaction in rollout.interactions]
    if sorted(set(steps)) != steps or (steps and steps[0] < 0):
        raise ValueError(f"steps must grow, given {str(steps)[:80]}")
    for interaction in rollout.interactions:
        try:
            _check_interaction(interaction, rollout)
        except (ValueError, TypeError, AttributeError) as error:
            raise ValueError(f"step {interaction.step}: {error}") from None


def _check_interaction(interaction: InteractionRecord, rollout: RolloutRecord) -> None:
    action, outcome = interaction.action, interaction.outcome
    if not 0 <= interaction.observation < len(rollout.observations):
        raise ValueError(f"refers to observation {interaction.observation} of {len(rollout.observations)}")
    cloud = rollout.observations[interaction.observation].points
    if not 0 <= action.point_index < len(cloud):
        raise ValueError(f"refers to point {action.point_index} of {len(cloud)}")
    parts = len(interaction.joint_positions)
    if not 1 <= interaction.target_part <= parts <= MAX_PARTS:
        raise ValueError(f"target part {interaction.target_part} of {parts}; allowed: 1 to {min(parts, MAX_PARTS)}")
    _check_array("point", action.point, (3,))
    _check_array("rotation", action.rotation, (3, 3))
    _check_array("normal", interaction.normal, (3,))
    _check_array("joint positions", interaction.joint_positions, (parts,))
    _check_array("joint limits", interaction.joint_limits, (parts, 2))
    if len(interaction.joint_names) != parts:
        raise ValueError(f"{len(interaction.joint_names)} joint names of {parts} joints")
    _check_array("joint twist", interaction.joint_twist, (6,))
    _check_array("hand start", interaction.hand_start, (7,))
    _check_array("displacement", outcome.displacement, (3,), nan=True)
    _check_finite("motion or seconds", [outcome.motion, interaction.seconds])
    if outcome.motion < 0:
        raise ValueError(f"motion is {outcome.motion}; it is never negative")
    texts = (interaction.proposer, interaction.method, interaction.target_link, interaction.target_joint)
    _check_texts(*texts, *interaction.joint_names)


def _check_array(name: str, array: Float, shape: tuple[int, ...], *, nan: bool = False) -> None:
    if array.dtype != np.float64 or array.shape != shape:
        raise ValueError(f"{name} is {array.dtype} {array.shape}, needs float64 {shape}")
    if not nan and not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")


def _check_finite(name: str, numbers: Sequence[float]) -> None:
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{name} not finite: {numbers}")


def _check_texts(*texts: str) -> None:
    for text in texts:
        if len(text) > MAX_TEXT or not text.isprintable():
            raise ValueError(f"text of {len(text)} characters, {text[:40]!r}; allowed: {MAX_TEXT} printable ones")
