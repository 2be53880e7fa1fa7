"""A simulated object as a Gymnasium environment: an episode is a rollout, and a step is one interaction."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal
from weakref import finalize

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary
from numpy.typing import NDArray
from pydantic import Field, PositiveInt

from collector.objects.procedural import categories_of, generate
from collector.rollout import Start, interact
from collector.sim.camera import EmbreeCamera
from collector.simulated_objects import SimulatedObjects
from shared.config import CameraConfig, CollectionConfig, StrictModel, parse
from shared.errors import UsageError
from shared.extras import require_packages
from shared.geometry import gripper_rotation
from shared.io.files import scratch_folder
from shared.plan import Plan
from shared.tasks import Task, task_of
from shared.types import Action, Float, Interaction, Observation, Outcome, OutcomeKind

PER_CATEGORY = 2
"""Procedural objects of each category that the task applies to, where nothing says which objects there are."""
NO_END = 1 << 62
"""Interactions: whoever steps the environment ends the loop."""
SEEDS = 1 << 32
"""How many there are to draw one from, if the first `reset` is given none."""


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


class EnvSettings(StrictModel):
    """The arguments of an environment; those of `gymnasium.make` after the id."""

    task: str
    """A name or a TOML file, as for `adaafford collect`; most ids have it."""
    objects: Path | Annotated[dict[str, PositiveInt], Field(min_length=1)] | None = None
    """A folder of objects; or numbers of procedural objects by category, such as {"Faucet": 4}; None: two procedural
    objects of each category that the task applies to."""
    objects_seed: int = Field(1, ge=0)
    """Of procedural objects."""
    collection: CollectionConfig = CollectionConfig()
    """As for `adaafford collect`: camera, hidden parameters, gripper, and so on; a group may be a dict."""
    hidden_in_info: bool = False
    """Whether `info["hidden"]` has the hidden dynamics, and the position, limits and twist of the joint."""
    end_at_success: bool = False
    """Whether an episode terminates at its first success."""
    render_mode: Literal["rgb_array"] | None = None
    """Whether `render` draws the object as the camera sees it."""


class ResetOptions(StrictModel):
    """The `options` of `reset`."""

    object: str | None = None
    """Id of the object, instead of the next one."""
    rollout: int | None = Field(None, ge=0, lt=1 << 32)
    """Number of the rollout, instead of the next one; the number of `adaafford collect` with the same seed."""


class ObjectEnv(gymnasium.Env[Values, Values]):
    """One simulated object after the other, each with hidden dynamics that are drawn for it.

    Episode k after `reset(seed=s)` is rollout k of `adaafford collect --seed s` on the same objects: the same object,
    hidden dynamics, camera and start state, and the same outcomes of the same actions, to the last bit. It runs the
    loop of `collector.rollout.interact` on the environment of `collector.rollout.begin`.

    The reward is 1 for a success, else 0. An episode terminates if the simulation diverges, if no point is left in view
    that may be acted on, or, with `end_at_success`, at a success. `gymnasium.make` truncates it after
    `max_episode_steps`. An action at a point that is not movable changes nothing.

    Args:
        settings: see `EnvSettings`.

    Attributes:
        start: the rollout of this episode, with its draw and the environment that the project's own loop uses.

    Raises:
        UsageError: a setting is unknown or not allowed, or there is no usable object.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 -- as Gymnasium declares it.

    def __init__(self, **settings: Any) -> None:
        self._settings = chosen = parse(EnvSettings, settings, "a Gymnasium environment")
        if chosen.render_mode is not None:
            require_packages("render_mode of a Gymnasium environment", "matplotlib")
        task, objects = task_of(chosen.task), chosen.objects
        if not isinstance(objects, Path):
            stack = ExitStack()
            made = stack.enter_context(scratch_folder("objects"))
            self._delete = finalize(self, stack.close)
            generate(made, objects or _procedural(task), chosen.objects_seed)
            objects = made
        self._objects = SimulatedObjects(objects, task, chosen.collection)
        self.render_mode = chosen.render_mode
        self.observation_space = observation_space(chosen.collection.camera)
        self.action_space = action_space(chosen.collection.camera)
        self.start: Start | None = None
        self._plan: Plan | None = None
        self._next = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Values, Values]:
        """Begin the next rollout; with a seed, the first one of this seed; see `ResetOptions`.

        Raises:
            UsageError: an option is unknown or not allowed, or no object comes to rest in view.
        """
        super().reset(seed=seed)
        asked = parse(ResetOptions, dict(options or {}), "options of reset")
        if seed is not None or self._plan is None:
            self._plan = self._objects.plan(int(self.np_random.integers(SEEDS)) if seed is None else seed)
            self._next = 0
        plan = self._plan if asked.object is None else self._objects.plan(self._plan.setting.seed, asked.object)
        self.start = self._objects.start(plan, self._next if asked.rollout is None else asked.rollout)
        self._next = self.start.draw.index + 1
        environment = self.start.environment
        self._observation = environment.observe()
        self._part = int(self._observation.part_ids[self._observation.movable][0])
        self._privileged = environment.privileged(self._part)
        self._proposer = _Given()
        self._loop = interact(environment, self._proposer, NO_END)
        self._over = False
        return observation_values(self._observation), self._info()

    def step(self, action: Values) -> tuple[Values, float, bool, bool, Values]:
        """Execute one interaction; `info` has its outcome.

        Raises:
            UsageError: the action is none (see `collector.gym.environment.action_of`), or the episode is over.
        """
        if self.start is None or self._over:
            raise UsageError("the episode is over, or none has begun; call reset")
        chosen, outcome = action_of(action, self._observation), None
        if self._observation.movable[chosen.point_index]:
            self._proposer.action = chosen
            outcome = next(self._loop).outcome
            # Later states of a scene that has diverged are not valid.
            self._over = outcome.kind is OutcomeKind.UNSTABLE or not self._look()
        success = outcome is not None and outcome.success
        self._over = self._over or (success and self._settings.end_at_success)
        info = {**self._info(), **outcome_info(outcome)}
        return observation_values(self._observation), float(success), self._over, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """The object as the camera sees it, [S, S, 3], each part in a colour; None without a render mode.

        Raises:
            UsageError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        if self.start is None:
            raise UsageError("nothing to draw before the first reset")
        from collector.viz.rendering import part_colours, shaded

        config, target = self._settings.collection.camera, self.start.environment.object
        camera = EmbreeCamera(target, self._observation.world_from_camera, config)
        picture = shaded(
            camera.capture(self._privileged.joint_positions), part_colours(len(target.parts)), config.image_size
        )
        return np.rint(picture * 255).astype(np.uint8)

    def close(self) -> None:
        """Drop the scene, and delete procedural objects."""
        self.start = None
        if not isinstance(self._settings.objects, Path):
            self._delete()

    def _look(self) -> bool:
        """Observe the present state; whether it shows a point that may be acted on."""
        assert self.start is not None
        environment = self.start.environment
        try:
            self._observation = environment.observe()
        except LookupError:
            return False  # The object is out of view; what was seen last remains.
        self._privileged = environment.privileged(self._part)
        return bool(self._observation.movable.any())

    def _info(self) -> Values:
        assert self.start is not None
        draw, told = self.start.draw, Values()
        if self._settings.hidden_in_info:
            part, privileged = self._part - 1, self._privileged
            told["hidden"] = {
                **draw.dynamics.values,
                "direction": draw.dynamics.direction.value,
                "joint_position": float(privileged.joint_positions[part]),
                "joint_limits": privileged.joint_limits[part].copy(),
                "joint_twist": privileged.joint_twist.copy(),
            }
        return {"object_id": draw.object.id, "category": draw.object.category, "rollout": draw.index, **told}


class FromGymnasium:
    """An environment of this kind as an `Environment`, so that proposers act in it through Gymnasium's interface.

    Args:
        env: from `gymnasium.make`, in any wrappers that change neither observations nor actions.
        seed: of its first `reset`.
        options: likewise.

    Attributes:
        over: whether the episode has ended.
        info: of the last reset or step.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], seed: int | None = None, options: dict[str, Any] | None = None
    ) -> None:
        self._env = env
        self.reset(seed, options)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin the next episode."""
        values, self.info = self._env.reset(seed=seed, options=options)
        self._observation, self.over = observation_of(values), False

    def observe(self) -> Observation:
        """What the last reset or step gave."""
        return self._observation

    def execute(self, action: Action) -> Outcome:
        """Execute the action by a step.

        Raises:
            UsageError: its point is not movable, or the episode is over.
        """
        values, _, terminated, truncated, self.info = self._env.step(action_values(action))
        self._observation, self.over = observation_of(values), terminated or truncated
        return outcome_of(self.info)


class _Given:
    """Proposes the action that a step was given."""

    name = "given"
    action: Action | None = None

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        return self.action


def _procedural(task: Task) -> dict[str, int]:
    """How many procedural objects there are of each category."""
    if not (categories := categories_of(task)):
        raise UsageError(f"no procedural object is of a category of the task '{task.name}'; name a folder of objects")
    return dict.fromkeys(categories, PER_CATEGORY)


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
