"""The interface between a rollout and a simulator, and the registry of simulators."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from collector.objects.articulation import ArticulatedObject
from shared.config import SAPIEN, CollectionConfig
from shared.extensions import Registry
from shared.tasks import Task
from shared.types import Environment, Float, HiddenDynamics


class StageClock:
    """Sums wall time by stage.

    Example:
        clock = StageClock()
        with clock.stage("simulate"):
            ...
        clock.seconds["simulate"]
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the duration of the block to a stage."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - begun


@dataclass(frozen=True, slots=True)
class PrivilegedState:
    """Data of the present state that no camera sees.

    Attributes:
        joint_positions: [parts], rad or m, in part order.
        joint_limits: [parts, 2], lower and upper, with the hidden direction mode.
        joint_twist: [6], (w, v) of the joint of one part, world (see `collector.objects.articulation.joint_twist`).
    """

    joint_positions: Float
    joint_limits: Float
    joint_twist: Float


class SimEnvironment(Environment, Protocol):
    """One object with its hidden dynamics before one camera, for one rollout.

    The same arguments and the same calls give the same bits, in any process.

    Attributes:
        object: the object.
        primitive: name of the primitive that `execute` executes.
    """

    object: ArticulatedObject
    primitive: str

    def reset(self, rng: np.random.Generator) -> bool:
        """Draw a new start state and let it settle; whether it came to rest.

        The first state fixes the limits of the hidden direction mode for the whole rollout.
        """
        ...

    def shows_a_target(self) -> bool:
        """Whether the camera sees a point that the task may act on."""
        ...

    def state(self) -> Float:
        """The present state, in the simulator's own format, for `restore`."""
        ...

    def restore(self, state: Float) -> None:
        """Restore a state, at rest."""
        ...

    def privileged(self, part: int) -> PrivilegedState:
        """Data that no camera sees, with the joint twist of `part` (1-based)."""
        ...


class MakeEnvironment(Protocol):
    """Makes the environment of one rollout."""

    def __call__(
        self,
        target: ArticulatedObject,
        task: Task,
        collection: CollectionConfig,
        dynamics: HiddenDynamics,
        world_from_camera: Float,
        rng: np.random.Generator,
        clock: StageClock,
    ) -> SimEnvironment:
        """See `collector.sim.environment.SapienEnvironment`."""
        ...


@dataclass(frozen=True, slots=True)
class Simulator:
    """One simulator.

    Attributes:
        make: makes environments.
    """

    make: MakeEnvironment


def _sapien(*args: Any, **named: Any) -> SimEnvironment:
    # Loads the engine, which rollouts of other simulators do not need.
    from collector.sim.environment import SapienEnvironment

    return SapienEnvironment(*args, **named)


SIMULATORS = Registry("simulator", Simulator, {SAPIEN: Simulator(_sapien)})
