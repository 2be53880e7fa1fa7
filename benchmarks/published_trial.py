"""The published protocol as its authors run it: one process and one scene for every trial.

This file as a process reads one `PublishedRequest` as JSON from standard input, and prints one
`PublishedTiming` as JSON. Facts of Where2Act's public code that cost time and are kept: the object settles until it was
still for 5,000 steps of at most 20,000, with contacts read at every step; each step of a leg computes joint velocities
by the pseudo-inverse of the hand's Jacobian and sets every joint's drive anew; each step of a hold computes passive
forces; contacts are read until the first. Left out, which flatters the published protocol: cameras, and the files of
a trial.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from collector.objects.readers import read_object
from collector.sim.jointed_gripper import JointedGripper, on_arm
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from shared.config import FIDELITIES, PUBLISHED_TIMING, StrictModel
from shared.primitives import PRIMITIVES
from shared.types import Action, Direction, Float, HiddenDynamics, OutcomeKind

STILL_STEPS, MOST_STEPS = 5000, 20_000
"""Where2Act's settling."""
SHORT_STILL_STEPS, SHORT_MOST_STEPS = 150, 200
"""AdaAfford's settling, which is timed on the way."""
STILL_MOTION, STILL_IMPULSE_SQUARED = 1e-6, 1e-4
TWIST_EVERY_STEPS = 100
"""Steps after which the way that is left is looked at again."""
SINGULAR = 1e-2
"""Singular values of the Jacobian below this share of the largest count as zero."""


class PublishedRequest(StrictModel):
    """One stored interaction, as much of it as a replay needs."""

    folder: Path
    """Of the object."""
    hidden: dict[str, float]
    """Values of the hidden parameters."""
    direction: Direction
    joint_positions: tuple[float, ...]
    point: tuple[float, float, float]
    rotation: tuple[float, ...]
    """R, row by row."""
    target_part: int
    primitive: str


class PublishedTiming(StrictModel):
    """CPU seconds of the process, by what they went to, and what came of the trial."""

    start: float
    """Python, and the modules that a trial needs."""
    load: float
    """The object's files, and the scene."""
    settle: float
    settle_short: float
    """The part of `settle` that AdaAfford's settling would have taken."""
    trial: float
    success: bool
    kind: OutcomeKind


class PublishedTrial(Trial):
    """A trial whose every step is controlled from Python, as the authors' robot is."""

    def _leg(self, end: Float) -> None:
        """Drive the hand to `end`, [4], by velocities of its joints that are computed at every step."""
        gripper, steps, rate = _jointed(self.scene), PUBLISHED_TIMING.leg_steps, PUBLISHED_TIMING.steps_per_second
        hand, arm = gripper.articulation, gripper.joints[:6]
        palm, model = hand.links.index(gripper.palm), hand.create_pinocchio_model()
        targets, twist = on_arm(self._hand_at), np.zeros(6)
        for step in range(steps):
            positions = hand.get_qpos()
            if step % TWIST_EVERY_STEPS == 0:
                twist[:3] = (end[:3] - positions[:3]) * (rate / (steps - step))
            jacobian = model.compute_single_link_local_jacobian(positions, palm)[:, :6]
            velocities = np.linalg.pinv(jacobian, rcond=SINGULAR) @ twist
            targets += velocities / rate
            for joint, velocity, target in zip(arm, velocities, targets, strict=True):
                joint.set_drive_velocity_target(velocity)
                joint.set_drive_target(target)
            hand.set_qf(hand.compute_passive_force(gravity=False, coriolis_and_centrifugal=True))
            self._step()
        self._hand_at = end

    def _hold(self, closing: bool = False, last: bool = False) -> None:
        """Keep all drive targets for a while."""
        gripper = _jointed(self.scene)
        hand = gripper.articulation
        for joint in gripper.joints[:6]:
            joint.set_drive_velocity_target(0.0)
        for _ in range(PUBLISHED_TIMING.hold_steps):
            hand.set_qf(hand.compute_passive_force(gravity=False, coriolis_and_centrifugal=True))
            self._step()
        hand.set_qf(np.zeros(len(gripper.joints), dtype=np.float32))


def run(request: PublishedRequest) -> PublishedTiming:
    """Load, settle and try, and time each.

    Raises:
        ObjectError: the object cannot be read.
    """
    started = time.process_time()
    fidelity = FIDELITIES["reference"]
    dynamics = HiddenDynamics(request.hidden, request.direction)
    primitive = PRIMITIVES.get(request.primitive)
    scene = Scene(read_object(request.folder), dynamics, fidelity, primitive)
    positions = np.array(request.joint_positions)
    scene.restrict(positions)
    scene.put(positions)
    loaded = time.process_time()
    with _without_hand(scene):
        short = _settle(scene)
    scene.put(positions)  # The stored trial's start, whatever a longer wait has made of it.
    settled = time.process_time()
    action = Action(0, np.array(request.point), np.array(request.rotation).reshape(3, 3))
    outcome = PublishedTrial(scene, action, request.target_part, primitive, fidelity).run()
    return PublishedTiming(
        start=started,
        load=loaded - started,
        settle=settled - loaded,
        settle_short=short,
        trial=time.process_time() - settled,
        success=outcome.success,
        kind=outcome.kind,
    )


@contextmanager
def _without_hand(scene: Scene) -> Iterator[None]:
    """The authors load their robot once the object has settled."""
    entities = [link.entity for link in _jointed(scene).articulation.links]
    world = entities[0].scene
    for entity in entities:
        world.remove_entity(entity)
    yield
    for entity in entities:
        world.add_entity(entity)


def _jointed(scene: Scene) -> JointedGripper:
    assert isinstance(scene.gripper, JointedGripper), "the reference fidelity has the published hand"
    return scene.gripper


def _settle(scene: Scene) -> float:
    """Wait as Where2Act does; returns the CPU seconds after which AdaAfford would have waited enough."""
    begun, short = time.process_time(), 0.0
    before, still = scene.joint_positions(), 0
    for step in range(1, MOST_STEPS + 1):
        scene.step()
        now = scene.joint_positions()
        pressed = any(
            float(point.impulse @ point.impulse) > STILL_IMPULSE_SQUARED
            for contact in scene.system.get_contacts()
            for point in contact.points
        )
        still = still + 1 if np.abs(now - before).max() < STILL_MOTION and not pressed else 0
        before = now
        if not short and (still == SHORT_STILL_STEPS or step == SHORT_MOST_STEPS):
            short = time.process_time() - begun
        if still == STILL_STEPS:
            break
    return short


if __name__ == "__main__":
    print(run(PublishedRequest.model_validate_json(sys.stdin.read())).model_dump_json())
