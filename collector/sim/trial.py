"""The execution of a primitive: its legs, the first-contact rule and the success rule (published protocol)."""

import math

import numpy as np

from collector.sim.gripper import GRASP_OPENING, frame, still
from collector.sim.scene import REST_MOTION, REST_STEPS, SHORTCUTS, Scene
from shared.config import Fidelity
from shared.geometry import rotation_about_z
from shared.primitives import START_DISTANCE, Leg, PrimitiveSpec, hand_start
from shared.types import Action, Float, Outcome, OutcomeKind

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
JOINT_YIELDS = 3e-6
"""A joint that moves by more than this a step gives way, and the target of the hand moves as its timing says."""
UNMOVED = 1e-4
"""rad or length: by how much joints may creep while a hand that slides along them moves faster."""
SANE_POSITION = 1e3
"""A joint position beyond this means that the simulation diverged."""


def hand_pose(leg: Leg) -> Float:
    """Where a leg ends, [4], as `collector.sim.gripper.Gripper` counts it."""
    forward, left, up = leg.end
    return np.array([forward, left, START_DISTANCE + up, leg.turn_rad])


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

    def __init__(self, scene: Scene, action: Action, target: int, primitive: PrimitiveSpec, fidelity: Fidelity) -> None:
        self.scene = scene
        self.action = action
        self.target = target
        self._judged = scene.holds.judged(target) - 1
        self.primitive = primitive
        self.fidelity = fidelity
        self._shortcuts = SHORTCUTS[fidelity.version]
        self.steps = 0
        self._checked = False
        self._brushed = False
        self._timing = fidelity.approach
        self._clearance = 0.0
        self._flew = False
        self._closed = False
        self._grasps = False
        self._attached = False
        self._positions = np.full(1, np.nan)
        self._stood: tuple[int, Float] | None = None
        self._hand_at = still()
        self._opening = float("nan")
        self._gripped_at: Float | None = None
        self._slides = False
        self._pace = 1

    def run(self) -> Outcome:
        """Execute the primitive and judge it; the scene is left as the trial leaves it, the hand parked."""
        scene = self.scene
        before = scene.joint_positions()
        start = before[self._judged]
        body_from_world = np.linalg.inv(scene.body_pose(self.target))
        local = body_from_world @ np.append(self.action.point, 1.0)
        scene.gripper.place(self.action.rotation, hand_start(self.action), opened=self.primitive.closes_fingers)
        try:
            self._execute()
            kind = self._kind()
        except _TrialEndedError as ended:
            kind = ended.kind
        if kind is OutcomeKind.START_COLLISION:
            # A hand cannot be where something else is; what one step of overlap did to the object never happened.
            scene.put(before)
        end = scene.joint_positions()[self._judged]
        displacement = (scene.body_pose(self.target) @ local)[:3] - self.action.point
        scene.park()
        if not np.isfinite(scene.joint_positions()).all() or np.abs(scene.joint_positions()).max() > SANE_POSITION:
            return Outcome(OutcomeKind.UNSTABLE, 0.0, False, float(start), steps=self.steps)
        return Outcome(
            kind=kind,
            motion=float(abs(end - start)) if kind.is_valid else 0.0,
            success=kind.is_valid and self._succeeded(start, end, displacement),
            start_joint_position=float(start),
            end_joint_position=float(end),
            displacement=displacement,
            grasp_opening=self._opening,
            steps=self.steps,
        )

    def _execute(self) -> None:
        gripper, then = self.scene.gripper, self.primitive.then
        self._leg(hand_pose(self.primitive.approach))
        self._hold(last=then is None)
        if self.primitive.closes_fingers:
            gripper.close()
            self._closed = True
            self._hold(closing=True)
            self._opening = gripper.opening()
            if not gripper.holds():
                raise _TrialEndedError(OutcomeKind.NO_GRASP)
            self._grasps = True
            self._gripped_at = self.scene.coordinates()
        if then is not None:
            self._timing = self.fidelity.drag
            self.scene.set_timing(self._timing)
            self._leg(hand_pose(then))
            self._hold(last=True)

    def _leg(self, end: Float) -> None:
        """Drive the hand to `end`, [4], at constant speed, and faster while it presses on what does not give."""
        gripper, steps = self.scene.gripper, self._timing.leg_steps
        path = np.linspace(self._hand_at, end, steps + 1)
        velocity = (end - self._hand_at) * (self._timing.steps_per_second / steps)
        stride = float(np.linalg.norm(path[1, :3] - path[0, :3]))
        # A hand that turns may come nearer than its way tells.
        flies = self.fidelity.skip_free_flight and stride > 0 and path[0, 3] == path[-1, 3]
        gripper.drive_velocity(velocity)
        self._flew = False
        step, ahead = 0, 1
        while step < steps:
            self._set_pace(ahead if self._slides else 1, velocity)
            step += ahead
            gripper.drive(path[step])
            self._step()
            rests = (
                self._checked
                and ahead == self._pace
                and step // REST_STEPS > (step - ahead) // REST_STEPS
                and self._object_rests()
            )
            if rests and self._grasps and self._shortcuts.follows_fingers and not gripper.holds():
                raise _TrialEndedError(self._kind())
            if (
                flies
                and not self._attached
                and (rests or not self._checked)
                and (skipped := self._free_flight(path, step, stride))
            ):
                step += skipped
                gripper.shift(path[step], velocity * self._pace)
            ahead = min(self._ahead(stride, ahead), steps - step)
        self._set_pace(1, velocity)
        gripper.drive(end)
        gripper.drive_velocity(still())
        self._hand_at = end

    def _set_pace(self, pace: int, velocity: Float) -> None:
        """Let the hand move `pace` times faster than with `velocity`, [4], that of its timing, and at equal forces."""
        if pace != self._pace:
            self._pace = pace
            self.scene.gripper.set_pace(self._timing.pace * pace)
            self.scene.gripper.drive_velocity(velocity * pace)

    def _free_flight(self, path: Float, step: int, stride: float) -> int:
        """How many steps after `step` of the leg along `path`, [steps + 1, 4], will touch and move nothing.

        These need not be simulated. The hand is put ahead by no more than its clearance, so that it cannot pass through
        anything, and only while the object rests: before the first contact, or once the hand has let go of it.

        Args:
            path: of the hand's target.
            step: the present one.
            stride: how far the hand's target moves in a step.
        """
        if self._checked:
            self._clearance = self.scene.contact().clearance
        room = self._clearance - CLEARANCE
        if room / stride < LEAST_SKIP:
            return 0
        most = len(path) - 1 - step
        if self._shortcuts.measures_flight:
            ahead = self._measured_flight(path[step], path[step + 1, :3] - path[step, :3], most) if most else 0
        else:
            ahead = min(int((room - self._lag(path[step])) / stride), most)
        return ahead if ahead >= LEAST_SKIP else 0

    def _measured_flight(self, place: Float, stride: Float, most: int) -> int:
        """How many steps of a leg the hand can fly from `place`, [4]; 0 where that has been asked and is still so.

        Args:
            place: where it should be now.
            stride: [3], what it moves in a step, both counted from where it was placed.
            most: steps that are left.
        """
        if not self._checked:
            # Before the first touch nothing moves, so that a second flight would end where the first one did.
            if self._flew or self._brushed:
                return 0
            self._flew = True
        turn = rotation_about_z(place[3])
        origin = hand_start(self.action) + self.action.rotation @ place[:3]
        world_from_hand = frame(self.action.rotation @ turn, origin)
        return self.scene.free_space.steps(world_from_hand, turn.T @ stride, most, CLEARANCE + self._lag(place))

    def _lag(self, place: Float) -> float:
        """How far the hand is from `place`, [4], m."""
        lag = place[:3] - self.scene.gripper.displacement()
        return math.sqrt(lag @ lag)

    def _ahead(self, stride: float, ahead: int) -> int:
        """How many steps of its leg the target moves at the next step of the engine.

        Twice as many as last time while hand and object stand still, since what holds them up then only bears more, or
        while closed fingers slide along an object that has not moved since they closed; one otherwise. Every fourth
        step is looked at, or every one where the target moves by more.

        Args:
            stride: how far the hand's target moves in a step of the leg.
            ahead: how many it moved last time.
        """
        touched = self._checked or self._brushed
        if not touched or (ahead == 1 and self.steps % 4):
            return 1
        before, now = self._stood, self.scene.coordinates()
        self._stood = self.steps, now
        if before is None:
            return 1
        moved, span = np.abs(now - before[1]), self.steps - before[0]
        joints = len(self.scene.joints)
        prepares = self._timing is self.fidelity.approach and self.primitive.then is not None
        strides = self._shortcuts.preparing if prepares else self._shortcuts.decisive
        stands = moved[joints:].max(initial=0.0) < strides.share * stride * ahead * span
        self._slides = (
            self._shortcuts.sliding > 1
            and self._gripped_at is not None
            and not self._attached
            and bool(np.abs(now - self._gripped_at)[:joints].max() < UNMOVED)
        )
        if moved[:joints].max() >= JOINT_YIELDS * span or not (stands or self._slides):
            return 1
        return min(2 * ahead, self._shortcuts.sliding if self._slides else strides.most)

    def _object_rests(self) -> bool:
        """Whether no joint has moved since this was asked last, `REST_STEPS` ago or more."""
        before, self._positions = self._positions, self.scene.joint_positions()
        return bool(np.abs(self._positions - before).max() < REST_STEPS * REST_MOTION)

    def _hold(self, closing: bool = False, last: bool = False) -> None:
        """Keep all drive targets for a while.

        Args:
            closing: the fingers close; once they hold nothing, all is said.
            last: nothing comes after this hold, so that a hand which has let go of a resting object may move on.
        """
        before, steps = np.zeros(0), self._timing.hold_steps
        opening = float("nan")
        for step in range(steps):
            self._step()
            if not self.fidelity.end_holds_at_rest or step % REST_STEPS:
                continue
            if closing and not self.scene.gripper.holds():
                return
            now = self.scene.coordinates()
            opening, opened = self.scene.gripper.opening() if closing else 0.0, opening
            if step and self._came_to_rest(now - before, last) and self._stays_open(opened, opening, steps - step):
                return
            if last and not self._attached and self._object_rests() and self.scene.contact().clearance > CLEARANCE:
                return
            before = now

    def _came_to_rest(self, moved: Float, last: bool) -> bool:
        """Whether a hold may end when `scene.coordinates` changed by `moved` in `REST_STEPS`."""
        joints = len(self.scene.joints)
        of_hand = REST_MOTION if last else self._shortcuts.followed_motion
        moved = np.abs(moved) / REST_STEPS
        return bool(moved[:joints].max() < REST_MOTION and moved[joints:].max(initial=0.0) < of_hand)

    def _stays_open(self, before: float, now: float, steps: int) -> bool:
        """Whether closing fingers still hold something if their opening goes on from `before` to `now` for `steps`."""
        lost = (before - now) / REST_STEPS * steps
        return not self._shortcuts.follows_fingers or lost <= 0 or now - lost > GRASP_OPENING

    def _step(self) -> None:
        first = self._shortcuts.first_step if self.steps == 0 else None
        if first is not None:
            self.scene.set_timing(first)
        self.scene.step()
        self.steps += 1
        if self._closed:
            self._attached = self.scene.gripper.attached()
            self._brushed = self._brushed or self._attached
        if not self._checked:
            self._check_first_contact()
        if first is not None:
            self.scene.set_timing(self._timing)

    def _kind(self) -> OutcomeKind:
        """Of a trial that went to its end."""
        return OutcomeKind.OK if self._brushed else OutcomeKind.NO_CONTACT

    def _check_first_contact(self) -> None:
        """The published first-contact rule; checking ends with the first valid contact.

        Where the rule does not hold, only the first step can go wrong, so that a touch ends the checking.
        """
        contact = self.scene.contact()
        self._brushed = self._brushed or contact.brushes
        self._clearance = contact.clearance
        if contact.presses:
            if self.steps == 1:
                raise _TrialEndedError(OutcomeKind.START_COLLISION)
            if self.primitive.checks_contact and contact.palm:
                raise _TrialEndedError(OutcomeKind.HAND_CONTACT)
            if self.primitive.checks_contact and contact.finger_on - {self.target}:
                raise _TrialEndedError(OutcomeKind.WRONG_PART)
        self._checked = contact.presses or (not self.primitive.checks_contact and self._brushed)

    def _succeeded(self, start: float, end: float, displacement: Float) -> bool:
        low, high = self.scene.limits[self._judged]
        motion = abs(end - start)
        if not (motion > MOTION_THRESHOLD or motion > MOTION_SHARE * (high - low)):
            return False
        intended = self.primitive.intended
        if intended is None:
            return True
        length = float(np.linalg.norm(displacement))
        return length > 0 and float(displacement @ (self.action.rotation @ intended)) > DIRECTION_COSINE * length
