"""The simulated environment: one object with its hidden dynamics, seen by one camera, acted upon by one primitive."""

from dataclasses import replace

import numpy as np

from collector.objects.articulation import ArticulatedObject, joint_twist
from collector.objects.catalogue import qualifying_parts
from collector.sim.camera import Camera, EmbreeCamera, noisy, observation_from
from collector.sim.sapien_camera import SapienCamera
from collector.sim.scene import Scene
from collector.sim.simulator import PrivilegedState, SimEnvironment, StageClock
from collector.sim.trial import Trial
from shared.config import CameraConfig, CollectionConfig
from shared.errors import UsageError
from shared.primitives import PRIMITIVES
from shared.tasks import Task
from shared.types import Action, Direction, Float, HiddenDynamics, Observation, Outcome

SETTLE_STEPS, SETTLE_MOST = 60, 480
"""At 1/240 s: still for a quarter of a second, within two seconds. AdaAfford: 150 of at most 200 steps of 1/500 s."""
SAME_STATE = 1e-4
"""rad or length: joints that differ by less give the same cloud for every purpose."""
CLOSED_SHARE = 0.5
"""Published mixture: half of all states are closed altogether; in the others each joint is closed with equal odds."""


class SapienEnvironment:
    """Implements `collector.sim.simulator.SimEnvironment` with SAPIEN's physics and a depth camera.

    All interactions of a rollout are on one part, because z describes how one door or switch moves. The part is drawn
    from those that the first observation shows and the task allows, in proportion to its visible points. Where there is
    a latch, a door and its handles are one target, as far as the task allows them (`collector.sim.mechanisms.Holds`).

    Args:
        target: the object.
        task: gives the target parts and the start states.
        collection: primitive, gripper, fidelity and camera.
        dynamics: the hidden draw.
        world_from_camera: [4, 4].
        rng: draws which of the hit pixels become candidates for the cloud, and which part is the target.
        clock: sums wall time by stage ("load", "settle", "observe", "simulate").
    """

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
        self.object = target
        self.task = task
        self.primitive = task.terms(collection).primitive
        self.parts = qualifying_parts(target, task)
        self._spec, self._fidelity = PRIMITIVES.get(self.primitive), collection.fidelity
        with clock.stage("load"):
            self.scene = Scene(target, dynamics, self._fidelity, self._spec, collection.gripper)
        self._camera_config = collection.camera
        self._camera = camera_for(target, world_from_camera, self._camera_config)
        self._rng, self._errors = rng, rng.spawn(1)[0]  # What is drawn from one does not depend on the other.
        self._observed: Observation | None = None
        self._chosen = False
        self._known: list[tuple[Float, Observation]] = []
        self._restricted = dynamics.direction is Direction.AS_BUILT
        self._disturbed = False
        self._clock = clock

    def reset(self, rng: np.random.Generator) -> bool:
        """Draw a new start state and let it settle.

        Returns:
            Whether it came to rest.
        """
        positions = draw_state(self.object.limits(), self.task.closed, rng)
        if not self._restricted:
            # The hidden direction is a property of the rollout: it is fixed by the first state and then kept.
            self.scene.restrict(positions)
            self._restricted = True
        self.scene.put(positions)
        return self._settle()

    def observe(self) -> Observation:
        """Look at the object once it has come to rest; a state that was seen before is not rendered again.

        Raises:
            LookupError: no pixel sees the object.
        """
        if self._disturbed:
            self._settle()
        positions = self.scene.joint_positions()
        same = (seen for known, seen in self._known if np.abs(known - positions).max(initial=0.0) < SAME_STATE)
        self._observed = next(same, None)
        if self._observed is None:
            with self._clock.stage("observe"):
                self._observed = self._look(positions)
            self._known.append((positions, self._observed))
        return self._observed

    def shows_a_target(self) -> bool:
        """Whether the camera sees a point that the task may act on."""
        try:
            return bool(self.observe().movable.any())
        except LookupError:
            return False

    def execute(self, action: Action) -> Outcome:
        """Execute the action on the part of its point in the last observation."""
        assert self._observed is not None, "observe before you act"
        part = int(self._observed.part_ids[action.point_index])
        self._disturbed = True
        with self._clock.stage("simulate"):
            return Trial(self.scene, action, part, self._spec, self._fidelity).run()

    def state(self) -> Float:
        """The joint positions, [parts], for `restore`."""
        return self.scene.joint_positions()

    def restore(self, state: Float) -> None:
        """Restore a state, at rest."""
        self.scene.put(state)
        self._disturbed = False

    def privileged(self, part: int) -> PrivilegedState:
        """See `SimEnvironment.privileged`."""
        joint = self.object.bodies[part].joint
        assert joint is not None
        twist = joint_twist(joint, self.scene.body_pose(part))
        return PrivilegedState(self.scene.joint_positions(), self.scene.limits.copy(), twist)

    def _look(self, positions: Float) -> Observation:
        config, pose = self._camera_config, self._camera.world_from_camera
        image = self._camera.capture(positions)
        if config.noise:
            image = noisy(image, config.image_size, pose[:3, 3], config.noise, self._errors)
        seen = observation_from(image, pose, self.parts, config, self._rng)
        if seen is None:
            raise LookupError(f"no pixel sees object {self.object.ref.id}")
        if not self._chosen and seen.movable.any():
            several = len(self.parts) > 1
            part = int(self._rng.choice(seen.part_ids[seen.movable])) if several else self.parts[0]
            together = self.scene.holds.target_of(part)
            self.parts, self._chosen = tuple(k for k in self.parts if k in together), True
            seen = replace(seen, movable=np.isin(seen.part_ids, self.parts))
        return seen

    def _settle(self) -> bool:
        rate = self._fidelity.approach.steps_per_second / 240
        self._disturbed = False
        with self._clock.stage("settle"):
            return self.scene.settle(round(SETTLE_STEPS * rate), round(SETTLE_MOST * rate))


def only_sapien(environment: SimEnvironment) -> SapienEnvironment:
    """The environment, for code that needs access to SAPIEN's scene.

    Raises:
        UsageError: it is of another simulator.
    """
    if not isinstance(environment, SapienEnvironment):
        raise UsageError("this measures SAPIEN's physics alone; leave collection.simulator at 'sapien', without an arm")
    return environment


def camera_for(target: ArticulatedObject, world_from_camera: Float, config: CameraConfig) -> Camera:
    """The camera of the configuration.

    Raises:
        UsageError: this machine does not support it.
    """
    if config.renderer == "sapien":
        return SapienCamera(target, world_from_camera, config)
    return EmbreeCamera(target, world_from_camera, config)


def draw_state(limits: Float, closed: bool, rng: np.random.Generator) -> Float:
    """Joint positions [parts] by the published mixture; closed is the lower limit.

    Args:
        limits: [parts, 2].
        closed: whether the task requires every joint to be closed.
        rng: draws the state.
    """
    all_closed = rng.random() < CLOSED_SHARE
    each_closed = rng.random(len(limits)) < CLOSED_SHARE
    anywhere = rng.uniform(limits[:, 0], limits[:, 1])
    return limits[:, 0].copy() if closed or all_closed else np.where(each_closed, limits[:, 0], anywhere)
