"""The random draws of a rollout that precede its simulation.

A rollout is a pure function of its plan and its number: object, hidden dynamics, camera, states and actions are drawn
from seeds that are derived from these. So it is the same for every worker and at any time.
"""

from dataclasses import dataclass, replace

import numpy as np

from collector.objects.articulation import ArticulatedObject, surface_at
from shared import seeds
from shared.config import DynamicsRanges, Range
from shared.hidden import ALWAYS_DRAWN
from shared.plan import ObjectRef, Plan
from shared.tasks import Task
from shared.types import HiddenDynamics

ARM_DISTANCE, ARM_ASIDE, ARM_TURN = (0.3, 0.6), 0.3, 0.2
"""Of the base of an arm: how far before the object's front, and aside of its middle, m, and turned off it, rad."""


@dataclass(frozen=True, slots=True)
class Draw:
    """The draw of one rollout: object, hidden dynamics and camera."""

    index: int
    object: ObjectRef
    dynamics: HiddenDynamics
    azimuth_deg: float
    elevation_deg: float


def draw_rollout(plan: Plan, index: int, attempt: int = 0) -> Draw:
    """The draw of rollout `index`; a further `attempt` draws another camera only."""
    setting = plan.setting
    ranges = setting.dynamics
    rng = seeds.generator(setting.seed, f"dynamics/{plan.key}", index)
    dynamics = draw_dynamics(ranges, setting.task_record, rng)
    for name in ranges.added:
        # A separate generator, so that the other draws do not depend on it.
        rng = seeds.generator(setting.seed, f"dynamics/{name}/{plan.key}", index)
        dynamics = replace(dynamics, values={**dynamics.values, name: draw_range(ranges[name], rng)})
    camera = setting.collection.camera
    rng = seeds.generator(setting.seed, f"camera/{plan.key}", index, attempt)
    return Draw(
        index,
        object_of(plan, index),
        dynamics,
        draw_range(camera.azimuth_deg, rng),
        draw_range(camera.elevation_deg, rng),
    )


def object_of(plan: Plan, index: int) -> ObjectRef:
    """Every object once, in a random order, before any comes again."""
    objects = plan.setting.objects
    turn, place = divmod(index, len(objects))
    order = seeds.generator(plan.setting.seed, f"objects/{plan.key}", turn).permutation(len(objects))
    return objects[int(order[place])]


def draw_dynamics(ranges: DynamicsRanges, task: Task, rng: np.random.Generator) -> HiddenDynamics:
    """The hidden parameters that are always drawn, within `ranges`, with one of the task's direction modes."""
    values = {name: draw_range(ranges[name], rng) for name in ALWAYS_DRAWN}
    return HiddenDynamics(values, task.directions[int(rng.integers(len(task.directions)))])


def draw_arm_base(plan: Plan, index: int, target: ArticulatedObject) -> tuple[float, ...]:
    """Where the base of the arm stands in a rollout: x, y, z and yaw, world frame; empty without an arm.

    It is in front of the object (objects face -x), turned to it, on the floor that the object stands on.
    """
    if plan.setting.collection.arm is None:
        return ()
    rng = seeds.generator(plan.setting.seed, f"arm/{plan.key}", index)
    surface = surface_at(target, target.limits()[:, 0])
    low, high = surface.min(axis=0), surface.max(axis=0)
    middle = (low + high) / 2
    x, y = low[0] - rng.uniform(*ARM_DISTANCE), middle[1] + rng.uniform(-ARM_ASIDE, ARM_ASIDE)
    yaw = np.arctan2(middle[1] - y, middle[0] - x) + rng.uniform(-ARM_TURN, ARM_TURN)
    return float(x), float(y), float(low[2]), float(yaw)


def draw_range(interval: Range, rng: np.random.Generator) -> float:
    """A number within an interval."""
    if interval.log:
        return float(np.exp(rng.uniform(np.log(interval.low), np.log(interval.high))))
    return float(rng.uniform(interval.low, interval.high))
