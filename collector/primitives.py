"""The six gripper primitives: trajectories, the first-contact rule and the success rule (published protocol).

Every primitive is a pure translation of the hand from p - 0.15 d, where d is the approach direction.
"""

from dataclasses import dataclass

import numpy as np

from collector.gripper import FINGER_OPEN
from collector.scene import Scene
from shared.configuration import Fidelity
from shared.vocabulary import Action, Float, Outcome, OutcomeKind, Primitive

START_DISTANCE = 0.15
"""From the hand frame's origin to p at the start, along the approach."""
REACH_DISTANCE = {Primitive.PUSH_LEFT: 0.11, Primitive.PUSH_UP: 0.11}
"""Likewise after the approach; 0.10 where not named."""
SLIDE = 0.05
"""How far the second leg of the sideways primitives goes."""
GRASP_OPENING = 0.01
"""Fingers that together stay open by no more than this hold nothing."""
MOTION_THRESHOLD = 0.01
"""tau: rad or length."""
MOTION_SHARE = 0.5
"""Or this share of the joint's range, for joints whose range is small."""
DIRECTION_COSINE = 0.5
"""The touched point must move within 60 deg of where the primitive means to take it."""
CLEARANCE = 3e-4
"""Free flight ends this far before the object."""
LEAST_SKIP = 4
"""Steps of free flight; to skip fewer would cost more than to simulate them."""
REST_STEPS, REST_MOTION = 8, 1.2e-5
"""A hold may end when hand and object moved by less than the second a step over the first; at the time constant of the
hand's drives (24 steps of the fast approach, 48 of its drag) less than 0.6 mm is then left to come."""
SANE_POSITION = 1e3
"""A joint position beyond this means that the simulation diverged."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Hand displacements from its start, in the hand frame, at the end of each leg.

    Attributes:
        approach: [3], where the first leg ends.
        then: [3], where the second leg ends, or None.
        intended: [3], direction in which the touched point should move, or None for any.
    """

    approach: Float
    then: Float | None
    intended: Float | None


def trajectory(primitive: Primitive) -> Trajectory:
    """The published trajectory of a primitive; hand frame: forward, left, up."""
    approach = np.array([0.0, 0.0, START_DISTANCE - REACH_DISTANCE.get(primitive, 0.10)])
    if primitive is Primitive.PUSH:
        return Trajectory(approach, None, None)
    if primitive is Primitive.PULL:
        return Trajectory(approach, np.zeros(3), np.array([0.0, 0.0, -1.0]))
    sideways = np.array([1.0, 0.0, 0.0] if primitive.value.endswith("left") else [0.0, 1.0, 0.0])
    return Trajectory(approach, approach + SLIDE * sideways, sideways)


def hand_start(action: Action) -> Float:
    """Where the hand frame's origin starts, [3], world."""
    return action.point - START_DISTANCE * action.approach


class _TrialEndedError(Exception):
    """A trial is over before its trajectory is; never leaves this module."""

    def __init__(self, kind: OutcomeKind) -> None:
        super().__init__(kind)
        self.kind = kind


class Trial:
    """One execution of a primitive in a scene.

    Args:
        scene: with the object in its start state.
        action: p and R.
        target: the part (1-based) that p lies on.
        primitive: what to execute.
        fidelity: how finely.
    """

    def __init__(self, scene: Scene, action: Action, target: int, primitive: Primitive, fidelity: Fidelity) -> None:
        self.scene = scene
        self.action = action
        self.target = target
        self.primitive = primitive
        self.fidelity = fidelity
        self.steps = 0
        self._checked = False
        self._brushed = False
        self._timing = fidelity.approach
        self._clearance = 0.0
        self._positions = np.full(1, np.nan)
        self._hand_at = np.zeros(3)
        self._opening = float("nan")

    def run(self) -> Outcome:
        """Execute the primitive and judge it; the scene is left as the trial leaves it, the hand parked."""
        scene = self.scene
        before = scene.joint_positions()
        start = before[self.target - 1]
        body_from_world = np.linalg.inv(scene.body_pose(self.target))
        local = body_from_world @ np.append(self.action.point, 1.0)
        scene.gripper.place(self.action.rotation, hand_start(self.action), FINGER_OPEN * self.primitive.pulls)
        try:
            self._execute()
            kind = OutcomeKind.OK if self._brushed else OutcomeKind.NO_CONTACT
        except _TrialEndedError as ended:
            kind = ended.kind
        if kind is OutcomeKind.START_COLLISION:
            # A hand cannot be where something else is; what one step of overlap did to the object never happened.
            scene.put(before)
        end = scene.joint_positions()[self.target - 1]
        displacement = (scene.body_pose(self.target) @ local)[:3] - self.action.point
        scene.park()
        if not np.isfinite(scene.joint_positions()).all() or np.abs(scene.joint_positions()).max() > SANE_POSITION:
            return Outcome(OutcomeKind.UNSTABLE, 0.0, False, float(start), steps=self.steps)
        valid = kind in (OutcomeKind.OK, OutcomeKind.NO_CONTACT)
        return Outcome(
            kind=kind,
            motion=float(abs(end - start)) if valid else 0.0,
            success=valid and self._succeeded(start, end, displacement),
            start_joint_position=float(start),
            end_joint_position=float(end),
            displacement=displacement,
            grasp_opening=self._opening,
            steps=self.steps,
        )

    def _execute(self) -> None:
        path, gripper = trajectory(self.primitive), self.scene.gripper
        self._leg(path.approach)
        self._hold(last=path.then is None)
        if self.primitive.pulls:
            gripper.drive_fingers(0.0)
            self._hold(closing=True)
            self._opening = gripper.opening()
            if self._opening <= GRASP_OPENING:
                raise _TrialEndedError(OutcomeKind.NO_GRASP)
        if path.then is not None:
            self._timing = self.fidelity.drag
            self.scene.set_timing(self._timing)
            self._leg(path.then)
            self._hold(last=True)

    def _leg(self, end: Float) -> None:
        """Drive the hand along a straight line to `end`, [3], hand frame, at constant speed."""
        gripper, steps = self.scene.gripper, self._timing.leg_steps
        path = np.linspace(self._hand_at, end, steps + 1)
        velocity = (end - self._hand_at) * (self._timing.steps_per_second / steps)
        gripper.drive_velocity(velocity)
        step = 0
        while step < steps:
            step += 1
            gripper.drive(path[step])
            self._step()
            if self.fidelity.skip_free_flight and (skipped := self._free_flight(path, step)):
                step += skipped
                gripper.shift(path[step], velocity)
        gripper.drive(end)
        gripper.drive_velocity(np.zeros(3))
        self._hand_at = end

    def _free_flight(self, path: Float, step: int) -> int:
        """How many steps after `step` of the leg along `path`, [steps + 1, 3], will touch and move nothing.

        These need not be simulated. The hand is put ahead by no more than its clearance, so that it cannot pass through
        anything, and only while the object rests: before the first contact, or once the hand has let go of it.
        """
        if self._checked:
            if step % REST_STEPS or not self._object_rests():
                return 0
            self._clearance = self.scene.contact().clearance
        if self._clearance <= CLEARANCE:
            return 0
        stride = float(np.linalg.norm(path[1] - path[0]))
        lag = float(np.linalg.norm(path[step] - self.scene.gripper.displacement()))
        ahead = min(int((self._clearance - CLEARANCE - lag) / stride), len(path) - 1 - step)
        return ahead if ahead >= LEAST_SKIP else 0

    def _object_rests(self) -> bool:
        """Whether no joint has moved since this was asked last, `REST_STEPS` ago or more."""
        before, self._positions = self._positions, self.scene.joint_positions()
        return bool(np.abs(self._positions - before).max() < REST_STEPS * REST_MOTION)

    def _hold(self, closing: bool = False, last: bool = False) -> None:
        """Keep all drive targets for a while.

        Args:
            closing: the fingers close; once they are so near each other that they hold nothing, all is said.
            last: nothing comes after this hold, so that a hand which has let go of a resting object may move on.
        """
        before = np.zeros(0)
        for step in range(self._timing.hold_steps):
            self._step()
            if not self.fidelity.end_holds_at_rest or step % REST_STEPS:
                continue
            if closing and self.scene.gripper.opening() <= GRASP_OPENING:
                return
            now = self.scene.coordinates()
            if step and np.abs(now - before).max() < REST_STEPS * REST_MOTION:
                return
            if last and self._object_rests() and self.scene.contact().clearance > CLEARANCE:
                return
            before = now

    def _step(self) -> None:
        self.scene.system.step()
        self.steps += 1
        if not self._checked:
            self._check_first_contact()

    def _check_first_contact(self) -> None:
        """The published first-contact rule; checking ends with the first valid contact.

        Only a push can go wrong after the first step, so a pull is checked no longer than until it touches anything.
        """
        contact = self.scene.contact()
        self._brushed = self._brushed or contact.brushes
        self._clearance = contact.clearance
        if contact.presses:
            if self.steps == 1:
                raise _TrialEndedError(OutcomeKind.START_COLLISION)
            if not self.primitive.pulls and contact.palm:
                raise _TrialEndedError(OutcomeKind.HAND_CONTACT)
            if not self.primitive.pulls and contact.finger_on - {self.target}:
                raise _TrialEndedError(OutcomeKind.WRONG_PART)
        self._checked = contact.presses or (self.primitive.pulls and contact.brushes)

    def _succeeded(self, start: float, end: float, displacement: Float) -> bool:
        low, high = self.scene.limits[self.target - 1]
        motion = abs(end - start)
        if not (motion > MOTION_THRESHOLD or motion > MOTION_SHARE * (high - low)):
            return False
        intended = trajectory(self.primitive).intended
        if intended is None:
            return True
        length = float(np.linalg.norm(displacement))
        return length > 0 and float(displacement @ (self.action.rotation @ intended)) > DIRECTION_COSINE * length
