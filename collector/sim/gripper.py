"""The flying hand: what a trial needs of one, and hands with two fingers (figures of the published protocol).

The hand frame's columns are forward, left, up, where *up* is the approach direction. Every hand ends `TIP_DISTANCE`
ahead of its frame's origin when closed, so that primitives mean the same for all of them. There are two ways to make a
hand fly: the free one here, whose palm floats and is driven in all six directions at once, and the published one in
`collector.sim.jointed_gripper`, whose palm is attached to six joints and which costs the engine twice as much for each
step.

Where the hand is, [4], counts from where it was placed: forward, left, up (m) and its turn about up (rad).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from collector.objects.articulation import Mesh
from collector.sim.engine import Assembly, Link, physx, pose, sapien
from shared.geometry import rotation_about_z
from shared.types import Float

TIP_DISTANCE = 0.1124
"""From the hand frame's origin to the end of the hand, along the approach, m."""
GRASP_OPENING = 0.01
"""Fingers that together stay open by no more than this hold nothing, m."""
ARM_STIFFNESS, ARM_DAMPING = 1000.0, 400.0
FINGER_STIFFNESS, FINGER_DAMPING = 200.0, 60.0
ALONG = {
    "x": np.eye(3),
    "y": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "z": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rotations whose first column is the named axis, since SAPIEN's joints move along or about their frame's x."""


class Gripper(Protocol):
    """A hand in a scene.

    Attributes:
        palm: the link whose contact ends a trial under the first-contact rule.
        fingers: the other links, whose contact is intended.
    """

    palm: Link
    fingers: tuple[Link, ...]

    def set_pace(self, pace: float) -> None:
        """Prepare for moving `pace` times faster than published.

        The damping of the drives is divided by `pace`, so that they exert the published forces; slow motions, which
        only depend on forces, stay the same.
        """
        ...

    def place(self, rotation: Float, position: Float, *, opened: bool) -> None:
        """Place the hand at rest, without a grasp; the drives keep it there.

        Args:
            rotation: [3, 3], world_from_hand.
            position: [3], world, of the hand frame's origin.
            opened: whether the fingers are open.
        """
        ...

    def shift(self, place: Float, velocity: Float) -> None:
        """Move the hand to `place`, [4], at once, with `velocity`, [4]."""
        ...

    def displacement(self) -> Float:
        """Translation of the hand since it was placed, [3], hand frame."""
        ...

    def drive(self, place: Float) -> None:
        """Drive the hand to `place`, [4]."""
        ...

    def drive_velocity(self, velocity: Float) -> None:
        """Set the velocity target of the drives, [4]."""
        ...

    def close(self) -> None:
        """Close the fingers, or otherwise make this hand hold what it touches."""
        ...

    def opening(self) -> float:
        """How far all fingers together are open, m; stored in rows as `grasp_opening`."""
        ...

    def holds(self) -> bool:
        """Whether the closed hand may hold something."""
        ...

    def attached(self) -> bool:
        """Whether it is fastened to the object by more than contact, as by vacuum.

        Asked after every step once the hand has closed; a hand that cannot bear its load lets go here.
        """
        ...

    def coordinates(self) -> Float:
        """Everything that moves in the hand, lengths and rad or less: if none of it changes, the hand is at rest."""
        ...


@dataclass(frozen=True, slots=True)
class GripperSpec:
    """One kind of hand.

    Attributes:
        build: builds it into a scene, out of a material, jointed (see `Fidelity.jointed_hand`) or free; a hand that
            flies in one way alone may ignore that. Its drives need no strength until `Gripper.set_pace`.
    """

    build: Callable[[sapien.Scene, physx.PhysxMaterial, bool], Gripper]


def still() -> Float:
    """A position or a velocity, [4], of zeros."""
    return np.zeros(4)


def frame(rotation: Float, origin: Float | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float:
    """A rigid matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, origin
    return matrix


def convex(vertices: list[tuple[float, float, float]]) -> Mesh:
    """The convex hull of some vertices, as collision shapes take it."""
    return Mesh(np.array(vertices), np.zeros((0, 3), dtype=np.int32))


class HandShape(Protocol):
    """The shapes and figures of a hand that can be built to fly in either way."""

    @property
    def palm(self) -> tuple[Mesh, ...]:
        """Convex pieces, hand frame."""
        ...

    @property
    def palm_mass(self) -> float:
        """In kg. The drives are strongly overdamped, so that masses hardly matter."""
        ...

    @property
    def finger_open(self) -> float:
        """How far each finger opens, m; 0 where none does."""
        ...

    def add_fingers(self, assembly: Assembly, hand: Link) -> tuple[Link, ...]:
        """Add the fingers to the palm's link; drives of those that open have no strength until `set_finger_pace`."""
        ...


@dataclass(frozen=True, slots=True)
class TwoFingers:
    """The shapes and figures of a hand with two fingers that slide apart along its frame's left.

    Attributes:
        palm: convex pieces, hand frame.
        finger: convex pieces of the finger that opens towards +y, in its own frame; its pad is at y = 0.
        finger_offset: m, from the hand frame's origin to a finger's, along the approach.
        finger_open: m, how far each finger opens.
        palm_mass: kg. The drives are strongly overdamped, so that masses hardly matter.
        finger_mass: kg.
    """

    palm: tuple[Mesh, ...]
    finger: tuple[Mesh, ...]
    finger_offset: float
    finger_open: float
    palm_mass: float
    finger_mass: float

    def add_fingers(self, assembly: Assembly, hand: Link) -> tuple[Link, Link]:
        """See `HandShape.add_fingers`."""
        left, right = (self._add_finger(assembly, hand, *named) for named in (("left", 1.0), ("right", -1.0)))
        return left, right

    def _add_finger(self, assembly: Assembly, hand: Link, name: str, side: float) -> Link:
        link = assembly.add(
            hand,
            f"finger-{name}",
            self.finger,
            joint="prismatic",
            joint_name=f"finger-{name}",
            parent_from_joint=frame(np.diag([side, side, 1.0]), (0.0, 0.0, self.finger_offset)) @ frame(ALONG["y"]),
            child_from_joint=frame(ALONG["y"]),
            limits=(0.0, self.finger_open),
            touches_own_kind=False,
        )
        make_weightless(link, self.finger_mass)
        return link


class FingeredGripper(Gripper):
    """A hand that holds with fingers alone, in whichever way it flies."""

    def holds(self) -> bool:
        return self.opening() > GRASP_OPENING

    def attached(self) -> bool:
        """See `Gripper.attached`: fingers only touch."""
        return False


class FreeGripper(FingeredGripper):
    """A hand whose palm is a free body, moved to its target by one drive with six degrees of freedom.

    Args:
        shape: of the hand.
        palm: the palm's link, root of an articulation.
        fingers: the fingers' links.
    """

    def __init__(self, shape: HandShape, palm: Link, fingers: tuple[Link, ...]) -> None:
        self.palm, self.fingers = palm, fingers
        self._open = shape.finger_open
        self._finger_joints = opening_joints(fingers)
        self._pace = np.nan
        self._articulation = palm.articulation
        self._still = np.zeros(self._articulation.dof, dtype=np.float32)
        self._opened = np.full_like(self._still, self._open)
        self._drive = physx.PhysxDriveComponent(palm)
        palm.entity.add_component(self._drive)
        self._rotation, self._origin = np.eye(3), np.zeros(3)
        self._target = sapien.Pose()

    def set_pace(self, pace: float) -> None:
        if pace == self._pace:
            return
        self._pace = pace
        for set_property in (
            self._drive.set_drive_property_x,
            self._drive.set_drive_property_y,
            self._drive.set_drive_property_z,
            self._drive.set_drive_property_slerp,
        ):
            set_property(ARM_STIFFNESS, ARM_DAMPING / pace)
        set_finger_pace(self._finger_joints, pace)

    def place(self, rotation: Float, position: Float, *, opened: bool) -> None:
        self._rotation, self._origin = rotation, position
        self._drive.pose_in_parent = at = pose(frame(rotation, position))
        self.drive(still())
        self.drive_velocity(still())
        self._articulation.set_qpos(self._opened if opened else self._still)
        drive_fingers(self._finger_joints, self._open if opened else 0.0)
        self._fly(at, np.zeros(3), np.zeros(3))

    def shift(self, place: Float, velocity: Float) -> None:
        turned = self._rotation @ rotation_about_z(place[3]) if place[3] else self._rotation
        at = pose(frame(turned, self._origin + self._rotation @ place[:3]))
        self._fly(at, self._rotation @ velocity[:3], self._rotation[:, 2] * velocity[3])

    def _fly(self, at: sapien.Pose, linear: Float, angular: Float) -> None:
        """Move the palm to a pose at once, with these velocities, [3] each, world; the fingers do not move in it."""
        self._articulation.set_root_pose(at)
        self._articulation.set_root_linear_velocity(linear)
        self._articulation.set_root_angular_velocity(angular)
        self._articulation.set_qvel(self._still)

    def displacement(self) -> Float:
        return np.asarray((self._articulation.get_root_pose().p - self._origin) @ self._rotation, dtype=np.float64)

    def drive(self, place: Float) -> None:
        if half := place[3] / 2:
            self._drive.set_drive_target(sapien.Pose(place[:3], [np.cos(half), 0.0, 0.0, np.sin(half)]))
        else:
            # To set the position of a pose takes half the time of a new one, and a hand is driven at each step.
            self._target.p = place[:3]
            self._drive.set_drive_target(self._target)

    def drive_velocity(self, velocity: Float) -> None:
        self._drive.set_drive_velocity_target(velocity[:3], [0.0, 0.0, velocity[3]])

    def close(self) -> None:
        drive_fingers(self._finger_joints, 0.0)

    def opening(self) -> float:
        return float(self._articulation.get_qpos().sum())

    def coordinates(self) -> Float:
        """See `Gripper.coordinates`: palm position, its quaternion, the fingers."""
        at = self._articulation.get_root_pose()
        return np.concatenate([at.p, at.q, self._articulation.get_qpos()])


def build_free(shape: HandShape, scene: sapien.Scene, material: physx.PhysxMaterial) -> FreeGripper:
    """Build a free hand into a scene, weightless, as the published gravity compensation makes it."""
    assembly = Assembly(material)
    hand = assembly.add(None, "palm", shape.palm, joint="undefined", touches_own_kind=False)
    fingers = shape.add_fingers(assembly, hand)
    make_weightless(hand, shape.palm_mass)
    assembly.finish(scene)
    return FreeGripper(shape, hand, fingers)


def opening_joints(fingers: tuple[Link, ...]) -> tuple[physx.PhysxArticulationJoint, ...]:
    """The joints of those of the fingers that open."""
    return tuple(link.joint for link in fingers if link.joint.type == "prismatic")


def set_finger_pace(joints: Sequence[physx.PhysxArticulationJoint], pace: float) -> None:
    """See `Gripper.set_pace`; for the joints of `opening_joints`."""
    for joint in joints:
        joint.set_drive_property(FINGER_STIFFNESS, FINGER_DAMPING / pace)


def drive_fingers(joints: Sequence[physx.PhysxArticulationJoint], opening: float) -> None:
    """Drive each finger to `opening`; for the joints of `opening_joints`."""
    for joint in joints:
        joint.set_drive_target(opening)


def make_weightless(link: Link, mass: float) -> None:
    """Give a link of the hand its mass; gravity does not act on it."""
    link.disable_gravity = True
    link.mass = mass
    link.inertia = np.full(3, mass * 1e-3, dtype=np.float32)
