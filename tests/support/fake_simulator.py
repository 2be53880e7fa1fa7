"""A simulator that computes no physics, for tests of what happens around one."""

import numpy as np

from collector.objects.articulation import ArticulatedObject, joint_twist
from collector.sim.simulator import PrivilegedState, Simulator, StageClock
from shared.config import CollectionConfig
from shared.extensions import Registry
from shared.tasks import Task
from shared.types import Action, Float, HiddenDynamics, Observation, Outcome, OutcomeKind

MOTION = 0.1
"""Of the first part, by every action above the middle of the cloud."""


class FakeEnvironment:
    """A ball-shaped cloud, all of it on the first part."""

    def __init__(
        self,
        target: ArticulatedObject,
        task: Task,
        collection: CollectionConfig,
        dynamics: HiddenDynamics,
        world_from_camera: Float,
        rng: np.random.Generator,
        clock: StageClock,
    ) -> None:
        self.object, self.primitive = target, task.terms(collection).primitive
        self._positions = target.limits()[:, 0]
        self._pose = world_from_camera
        directions = rng.normal(size=(collection.camera.points, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self._directions = directions.astype(np.float16).astype(np.float32)
        self._seen: dict[tuple[float, ...], Observation] = {}

    def reset(self, rng: np.random.Generator) -> bool:
        self._positions = rng.uniform(*self.object.limits().T)
        return True

    def shows_a_target(self) -> bool:
        return True

    def observe(self) -> Observation:
        count = len(self._directions)
        seen = Observation(
            points=self._directions,
            normals=self._directions,
            part_ids=np.ones(count, np.uint8),
            movable=np.ones(count, np.bool_),
            pixels=np.arange(count, dtype=np.uint32),
            world_from_camera=self._pose,
        )
        return self._seen.setdefault(tuple(self._positions), seen)

    def execute(self, action: Action) -> Outcome:
        moved = MOTION if action.point[2] > 0 else 0.0
        start = self._positions[0]
        self._positions = self._positions + np.eye(len(self._positions))[0] * moved
        return Outcome(OutcomeKind.OK, moved, moved > 0, float(start), float(start + moved), np.zeros(3))

    def state(self) -> Float:
        return self._positions

    def restore(self, state: Float) -> None:
        self._positions = state

    def privileged(self, part: int) -> PrivilegedState:
        joint = self.object.bodies[part].joint
        assert joint is not None
        return PrivilegedState(self._positions, self.object.limits(), joint_twist(joint, np.eye(4)))


FAKE_SIMULATORS = Registry("simulator", Simulator, {"fake": Simulator(FakeEnvironment)})
