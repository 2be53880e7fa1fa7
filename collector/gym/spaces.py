"""Observations and actions as Gymnasium's spaces hold them, and back. N: points of a cloud."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary

from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import gripper_rotation
from shared.types import Action, Float, Observation, Outcome, OutcomeKind

Values = dict[str, Any]
"""An element of a `Dict` space: arrays and numbers by name."""

MAX_POINT = float(np.finfo(np.float16).max)
"""Coordinates are rounded to float16."""
LEAST_SINE = 1e-6
"""Of the angle between approach and forward direction, below which they do not say how the hand is turned."""
ORTHONORMAL = 1e-9
"""Directions that are a frame up to this are used as they are."""
NOT_EXECUTED = "not-executed"
"""`info["outcome"]` of an action at a point that the task may not act on."""


def observation_space(camera: CameraConfig) -> Dict:
    """The space of the clouds of a camera, with the fields of `shared.types.Observation`."""
    count, far = camera.points, camera.distance + 1.0
    return Dict(
        {
            "points": Box(-MAX_POINT, MAX_POINT, (count, 3), np.float32),
            "normals": Box(-1.0, 1.0, (count, 3), np.float32),
            "part_ids": Box(0, 255, (count,), np.uint8),
            "movable": MultiBinary(count),
            "pixels": Box(0, camera.image_size**2 - 1, (count,), np.uint32),
            "world_from_camera": Box(-far, far, (4, 4), np.float64),
        }
    )


def action_space(camera: CameraConfig) -> Dict:
    """The space of actions on such a cloud: the point p, and two directions in the world frame."""
    return Dict(
        {
            "point_index": Discrete(camera.points),
            "approach": Box(-1.0, 1.0, (3,), np.float64),
            "forward": Box(-1.0, 1.0, (3,), np.float64),
        }
    )


def observation_values(observation: Observation) -> Values:
    """The observation as an element of its space, in memory of its own."""
    values = {name: np.array(getattr(observation, name)) for name in _FIELDS}
    return {**values, "movable": values["movable"].astype(np.int8)}


def observation_of(values: Mapping[str, Any]) -> Observation:
    """The observation that an element of the space holds; depth images are not part of it."""
    return Observation(**{**{name: values[name] for name in _FIELDS}, "movable": values["movable"].astype(np.bool_)})


def action_values(action: Action) -> Values:
    """The action as an element of its space."""
    index = np.int64(action.point_index)
    return {"point_index": index, "approach": action.approach.copy(), "forward": action.forward.copy()}


def action_of(values: Mapping[str, Any], observation: Observation) -> Action:
    """The action that an element of the space means on an observation.

    The approach is scaled to length 1. Of the forward direction, the part normal to the approach counts.

    Raises:
        UsageError: it is none: there is no such point, a direction is no vector, or the two are parallel.
    """
    try:
        index = int(values["point_index"])
        approach, forward = (np.array(values[name], np.float64).reshape(3) for name in ("approach", "forward"))
    except (KeyError, TypeError, ValueError):
        raise UsageError("an action has 'point_index', and 'approach' and 'forward' of three numbers each") from None
    if not 0 <= index < len(observation.points):
        raise UsageError(f"no point {index}; allowed: 0 to {len(observation.points) - 1}")
    return Action(index, observation.points[index].astype(np.float64), _rotation(approach, forward))


def outcome_of(info: Mapping[str, Any]) -> Outcome:
    """The outcome that `info` of a step tells.

    Raises:
        UsageError: the action was not executed.
    """
    if info["outcome"] == NOT_EXECUTED:
        raise UsageError("the action was not executed, as the task may not act on its point; choose a movable point")
    told = {each.name: info[each.name] for each in fields(Outcome) if each.name in info}
    return Outcome(kind=OutcomeKind(info["outcome"]), **told)


def outcome_info(outcome: Outcome | None) -> Values:
    """An outcome for `info`, None for an action that was not executed. What is not a number is left out."""
    if outcome is None:
        return {"outcome": NOT_EXECUTED, "success": False, "motion": 0.0}
    told = {each.name: getattr(outcome, each.name) for each in fields(outcome) if each.name != "kind"}
    finite = {name: value for name, value in told.items() if np.isfinite(value).all()}
    return {"outcome": outcome.kind.value, **finite}


def _rotation(approach: Float, forward: Float) -> Float:
    """R, [3, 3], of two directions, [3]."""
    frame = np.stack([approach, forward])
    if np.abs(frame @ frame.T - np.eye(2)).max() <= ORTHONORMAL:
        # The rotation of an action comes back with the same bits, except for the last ones of its second column.
        return np.stack([forward, np.cross(approach, forward), approach], axis=1)
    lengths = np.linalg.norm(frame, axis=1)
    normal = np.linalg.norm(np.cross(approach, forward))
    if not np.isfinite(frame).all() or normal <= LEAST_SINE * lengths.prod():
        raise UsageError(
            f"approach {approach.tolist()} and forward {forward.tolist()} are no two directions; they must be finite, "
            "not zero and not parallel"
        )
    return gripper_rotation(approach / lengths[0], forward / lengths[1])


_FIELDS = tuple(each.name for each in fields(Observation) if each.name not in ("dense", "reach"))
