"""One object and the flying hand in SAPIEN's CPU physics: hidden dynamics, states, contacts.

A scene is built for one rollout, always in the same order, so that a rollout gives the same bits whichever worker runs
it. At rest, the positions of the joints are the whole state of the object.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from collector.objects.articulation import ArticulatedObject, Joint
from collector.sim.engine import Assembly, Link, new_scene, physx, pose, sapien, set_mass
from collector.sim.flight import FreeSpace, pieces_of_object
from collector.sim.grippers import GRIPPERS
from collector.sim.mechanisms import FRICTION_DAMPING, Holds
from shared.config import PANDA, PUBLISHED_TIMING, Fidelity, Timing
from shared.hidden import HIDDEN_PARAMETERS
from shared.primitives import PrimitiveSpec
from shared.types import Direction, Float, HiddenDynamics

CONTACT_RANGE = 0.02
"""The engine lists pairs that are closer than this: the sum of two shapes' contact offsets."""
REST_STEPS, REST_MOTION = 8, 1.2e-5
"""A hold may end when hand and object moved by less than the second a step over the first; at the time constant of the
hand's drives (24 steps of the fast approach, 48 of its drag) less than 0.6 mm is then left to come."""


@dataclass(frozen=True, slots=True)
class Strides:
    """When and by how much the target of a hand that stands still moves faster.

    Attributes:
        most: steps of its leg that the target moves at once, at most.
        share: it does while the hand moves by less than this times what its target moves.
    """

    most: int = 1
    share: float = 0.0


@dataclass(frozen=True, slots=True)
class Shortcuts:
    """The shortcuts of one version.

    Attributes:
        first_step: timing of the first step of a trial; None: that of the approach.
        part_range: two parts of the object are looked at when they are closer than this.
        followed_motion: a hold that another motion follows ends when no coordinate of the hand changed by more than
            this a step.
        follows_fingers: closing fingers are followed as long as they may still close altogether, and a pull whose
            fingers have closed ends once the object rests.
        preparing: at a standstill in a leg that another one follows.
        decisive: at a standstill in the last leg.
        sliding: in the drag of closed fingers, the hand moves up to so many times faster while no joint has moved in
            it.
        measures_flight: free flight ends where the shapes of hand and object could touch, not where the engine lists
            that they are near.
    """

    first_step: Timing | None = None
    part_range: float = CONTACT_RANGE
    followed_motion: float = REST_MOTION
    follows_fingers: bool = False
    preparing: Strides = Strides()
    decisive: Strides = Strides()
    sliding: int = 1
    measures_flight: bool = False


_SECOND = Shortcuts(
    # At the pace of the fast approach: how hard overlapping shapes press in a step depends on its length, and so does
    # which overlap is a start collision.
    first_step=Timing(steps_per_second=PUBLISHED_TIMING.steps_per_second, leg_steps=500, hold_steps=0),
    # Parts of closed furniture are close to each other throughout, and listing them takes more time than all else.
    part_range=0.004,
    # What is left to come of the hand comes during the next motion.
    followed_motion=5e-5,
    follows_fingers=True,
    # Each time step adds 3.3 N or less before another leg, and 0.8 N in the last one, which decides.
    preparing=Strides(16, 0.4),
    decisive=Strides(4, 0.2),
)
_THIRD = replace(_SECOND, sliding=8)
SHORTCUTS = {1: Shortcuts(), 2: _SECOND, 3: _THIRD, 4: replace(_THIRD, measures_flight=True)}
"""By `Fidelity.version`."""


RESTITUTION = 0.01
CONTACT_FORCE = 5.0
"""N. The published rule counts contact points with a squared impulse above 1e-4; at its 1/500 s that is this force."""
TOUCHING = 1e-3
"""Pairs further apart exert no force: until it touches something, the hand moves by a tenth of this a step. (Each force
that is read costs as much as the rest of its pair.)"""
FORGETTING_STEPS = 1
"""Steps with the hand out of reach, after which the engine holds no contact of the trial before."""
PARKED = np.array([0.0, 0.0, 50.0])
"""Where the hand waits while the object settles, out of reach of everything."""


@dataclass(frozen=True, slots=True)
class Contact:
    """The present contacts of the hand, by the published force threshold.

    Attributes:
        finger_on: bodies (0 the root, k the k-th part) that a finger presses on.
        palm: whether the palm presses on anything.
        brushes: whether the hand touches anything, with any force.
        clearance: the least distance between hand and object that the engine lists, within its range. They are not
            nearer to each other if they touch; while they are apart, they may be.
    """

    finger_on: frozenset[int]
    palm: bool
    brushes: bool
    clearance: float

    @property
    def presses(self) -> bool:
        """Whether the hand presses on anything."""
        return self.palm or bool(self.finger_on)


class Scene:
    """The simulated world of one rollout.

    Args:
        target: the object.
        dynamics: the hidden draw, applied to every movable part by the records of its parameters.
        fidelity: time step, solver iterations, and how the hand flies.
        primitive: the primitive that will be executed.
        gripper: the name of the hand.

    Attributes:
        system: SAPIEN's physics system.
        gripper: the flying hand.
        holds: what resists the motion of the joints.
    """

    def __init__(
        self,
        target: ArticulatedObject,
        dynamics: HiddenDynamics,
        fidelity: Fidelity,
        primitive: PrimitiveSpec,
        gripper: str = PANDA,
    ) -> None:
        self.object = target
        self.dynamics = dynamics
        iterations = fidelity.solver_iterations if primitive.needs_friction else fidelity.push_solver_iterations
        self._scene, self.system = new_scene(iterations)
        self._material = physx.PhysxMaterial(0.0, 0.0, RESTITUTION)
        self._articulation, self._links = _add_object(self._scene, target, self._material)
        joints = {joint.name: joint for joint in self._articulation.active_joints}
        self._joints = [joints[_joint_name(k)] for k in range(1, len(self._links))]
        names = [joint.name for joint in self._articulation.active_joints]
        self._order = np.array([names.index(joint.name) for joint in self._joints], dtype=np.int64)
        self._bodies = {link: k for k, link in enumerate(self._links)}
        self.holds = Holds(target, self._joints)
        self._mechanisms: list[Callable[[Float], None]] = []
        for name, value in dynamics.values.items():
            HIDDEN_PARAMETERS.get(name).apply(self, value)
        self.gripper = GRIPPERS.get(gripper).build(self._scene, self._material, fidelity.jointed_hand)
        self._hand = {self.gripper.palm, *self.gripper.fingers}
        self._fidelity = fidelity
        self._set_ranges(SHORTCUTS[fidelity.version].part_range)
        self._impulse_squared = 0.0
        self.limits = target.limits()
        self.park()

    @cached_property
    def free_space(self) -> FreeSpace:
        """Around the object, for the hand to fly in."""
        pieces = pieces_of_object(self.object, self._links)
        return FreeSpace([self.gripper.palm, *self.gripper.fingers], self._links, pieces)

    @property
    def links(self) -> list[Link]:
        """SAPIEN's links of the movable parts, in part order."""
        return self._links[1:]

    @property
    def joints(self) -> list[physx.PhysxArticulationJoint]:
        """SAPIEN's joints of the movable parts, in part order."""
        return self._joints

    def _set_ranges(self, of_parts: float) -> None:
        """Let parts of the object look out for each other from `of_parts`, and for the hand from `CONTACT_RANGE`."""
        own = of_parts / 2
        for links, offset in ((self._links, own), (self._hand, CONTACT_RANGE - own)):
            for shape in (shape for link in links for shape in link.collision_shapes):
                shape.contact_offset = offset

    def set_part_mass(self, mass: float) -> None:
        """Set the mass of every movable part, kg, and scale its inertia."""
        for link in self.links:
            set_mass(link, mass)

    def set_joint_friction(self, limit: float) -> None:
        """Set the Coulomb friction of every movable joint: N m if it turns, N if it slides."""
        self.holds.friction = limit
        for joint in self.joints:
            joint.set_drive_property(0.0, FRICTION_DAMPING, force_limit=limit)

    def set_surface_friction(self, coefficient: float) -> None:
        """Set the static and dynamic friction coefficient of the surfaces of hand and object."""
        self._material.static_friction = self._material.dynamic_friction = coefficient

    def set_catch(self, breakaway: float) -> None:
        """See `shared.hidden.HiddenTarget`."""
        self.holds.catch = breakaway
        self.before_step(self.holds)

    def set_latch(self, travel: float | None = None, handle: float | None = None) -> None:
        """See `shared.hidden.HiddenTarget`."""
        self.holds.latch_travel = self.holds.latch_travel if travel is None else travel
        self.holds.latch_handle = self.holds.latch_handle if handle is None else handle
        self.before_step(self.holds)

    def before_step(self, mechanism: Callable[[Float], None]) -> None:
        """See `shared.hidden.HiddenTarget`."""
        if mechanism not in self._mechanisms:
            self._mechanisms.append(mechanism)

    def step(self) -> None:
        """Advance time by one step; mechanisms act first."""
        if self._mechanisms:
            positions = self.joint_positions()
            for mechanism in self._mechanisms:
                mechanism(positions)
        self.system.step()

    def set_timing(self, timing: Timing) -> None:
        """Use `timing` for the time step and for the hand from now on."""
        self.system.set_timestep(1.0 / timing.steps_per_second)
        self._impulse_squared = (CONTACT_FORCE / timing.steps_per_second) ** 2
        self.gripper.set_pace(timing.pace)

    def park(self) -> None:
        """Move the hand away, and reset the time step."""
        self.set_timing(self._fidelity.approach)
        self.gripper.place(np.eye(3), PARKED, opened=False)

    def joint_positions(self) -> Float:
        """[parts], in part order."""
        return np.asarray(self._articulation.get_qpos(), dtype=np.float64)[self._order]

    def coordinates(self) -> Float:
        """Everything that moves: the joint positions of the object, then the coordinates of the hand."""
        return np.concatenate([self._articulation.get_qpos(), self.gripper.coordinates()])

    def put(self, positions: Float) -> None:
        """Set the joints to `positions`, [parts], at rest, and move the hand away.

        One step in between removes the contacts of the previous trial from the engine, so that a trial does not depend
        on the trials before it.
        """
        self.park()
        for _ in range(FORGETTING_STEPS):
            self._set_joint_positions(positions)
            self.step()
        self._set_joint_positions(positions)

    def _set_joint_positions(self, positions: Float) -> None:
        packed = np.zeros(len(positions), dtype=np.float32)
        packed[self._order] = positions
        self._articulation.set_qpos(packed)
        self._articulation.set_qvel(np.zeros_like(packed))

    def restrict(self, positions: Float) -> None:
        """Apply the hidden direction mode, relative to `positions`, [parts].

        The range of travel is that of the joint's own limits; as built, nothing changes.
        """
        self.limits = restricted_limits(self.object.limits(), positions, self.dynamics.direction)
        for joint, (low, high) in zip(self._joints, self.limits, strict=True):
            joint.set_limits(np.array([[low, high]], dtype=np.float32))

    def body_pose(self, body: int) -> Float:
        """world_from_body, [4, 4], of the root (0) or a part."""
        return np.asarray(self._links[body].entity_pose.to_transformation_matrix(), dtype=np.float64)

    def settle(self, still_steps: int, most_steps: int) -> bool:
        """Simulate until the object rests, with the hand away.

        Returns:
            Whether it did: every joint moved less than 1e-6 a step and nothing pressed on anything for `still_steps`
            steps on end, within `most_steps`.
        """
        self.park()
        before, still = self.joint_positions(), 0
        for _ in range(most_steps):
            self.step()
            now = self.joint_positions()
            moved = np.abs(now - before).max(initial=0.0) >= 1e-6
            still = 0 if moved or (still % 16 == 0 and self._presses()) else still + 1
            before = now
            if still >= still_steps:
                return bool(np.isfinite(now).all())
        return False

    def contact(self) -> Contact:
        """The contacts of the hand after the last step."""
        finger_on, palm, brushes, clearance = set(), False, False, CONTACT_RANGE
        for contact in self.system.get_contacts():
            first, second = contact.bodies
            if (of_hand := first in self._hand) == (second in self._hand):
                continue
            strongest = 0.0
            for point in contact.points:
                separation = point.separation
                clearance = min(clearance, separation)
                if separation < TOUCHING:
                    impulse = point.impulse
                    strongest = max(strongest, float(impulse @ impulse))
            brushes = brushes or strongest > 0.0
            if strongest <= self._impulse_squared:
                continue
            hand, other = (first, second) if of_hand else (second, first)
            if hand == self.gripper.palm:
                palm = True
            else:
                finger_on.add(self._bodies[other])
        return Contact(frozenset(finger_on), palm, brushes, clearance)

    def _presses(self) -> bool:
        """Whether anything presses on anything."""
        return any(self._counts(contact) for contact in self.system.get_contacts())

    def _counts(self, contact: physx.PhysxContact) -> bool:
        return any(float(p.impulse @ p.impulse) > self._impulse_squared for p in contact.points)


def restricted_limits(limits: Float, positions: Float, direction: Direction) -> Float:
    """Joint limits [parts, 2] under a direction mode, from the joint positions, [parts].

    Seen along the joint's axis, clockwise is towards greater positions.
    """
    if direction is Direction.AS_BUILT:
        return limits
    travel = limits[:, 1] - limits[:, 0]
    low = positions - (0.0 if direction is Direction.CLOCKWISE else travel)
    high = positions + (0.0 if direction is Direction.COUNTER_CLOCKWISE else travel)
    return np.stack([low, high], axis=1)


def _joint_name(part: int) -> str:
    """Names within the scene; those of the URDF need not be unique across merged links."""
    return f"part-{part}"


def _add_object(
    scene: sapien.Scene, target: ArticulatedObject, material: physx.PhysxMaterial
) -> tuple[physx.PhysxArticulation, list[Link]]:
    """The object, its root fixed at the origin; returns its links in body order."""
    assembly = Assembly(material)
    assembly.add(None, "root", target.bodies[0].collisions)
    for k, body in enumerate(target.parts, start=1):
        joint = body.joint
        assert joint is not None
        along = _joint_frame(joint)
        assembly.add(
            assembly.links[joint.parent],
            f"part-{k}",
            body.collisions,
            joint=joint.kind,
            joint_name=_joint_name(k),
            parent_from_joint=joint.parent_from_body @ along,
            child_from_joint=along,
            limits=(joint.lower, joint.upper),
        )
    articulation = assembly.finish(scene)
    articulation.set_root_pose(pose(np.eye(4)))
    return articulation, assembly.links


def _joint_frame(joint: Joint) -> Float:
    """A frame [4, 4] at the body's origin whose x is the joint's axis."""
    helper = np.eye(3)[np.argmin(np.abs(joint.axis))]
    second = np.cross(joint.axis, helper)
    second /= np.linalg.norm(second)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = joint.axis, second, np.cross(joint.axis, second)
    return frame
