"""The flying Franka Panda hand: its collision shapes and drives (figures of the published protocol).

The hand frame's columns are forward, left, up, where *up* is the approach direction. There are two ways to make it fly:
the free one here, whose palm floats and is driven in all six directions at once, and the published one in
`collector.jointed_gripper`, whose palm hangs on six joints and which costs the engine twice as much a step.
"""

from typing import Protocol

import numpy as np

from collector.articulation import Mesh
from collector.engine import Assembly, Link, physx, pose, sapien
from shared.vocabulary import Float

FINGER_OFFSET = 0.0584
"""From the hand frame to a finger's, along the approach."""
FINGER_OPEN = 0.04
"""How far each finger opens."""
ARM_STIFFNESS, ARM_DAMPING = 1000.0, 400.0
FINGER_STIFFNESS, FINGER_DAMPING = 200.0, 60.0
HAND_MASS, FINGER_MASS = 0.73, 0.015
"""kg. The drives are strongly overdamped, so these hardly matter."""
ALONG = {
    "x": np.eye(3),
    "y": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "z": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rotations whose first column is the named axis, since SAPIEN's joints move along or about their frame's x."""

_NO_FACES = np.zeros((0, 3), dtype=np.int32)


class Gripper(Protocol):
    """The hand in a scene, however it flies."""

    palm: Link
    fingers: tuple[Link, Link]

    def set_pace(self, pace: float) -> None:
        """Prepare for moving `pace` times faster than published.

        The dampers of the drives become weaker by as much, so that they exert the published forces: what is slow enough
        to be governed by forces alone then comes out the same.
        """
        ...

    def place(self, rotation: Float, position: Float, opening: float) -> None:
        """Put the hand somewhere at rest, each finger open by `opening`, with the drives holding it there.

        Args:
            rotation: [3, 3], world_from_hand.
            position: [3], world, of the hand frame's origin; displacements count from here.
            opening: of each finger.
        """
        ...

    def shift(self, displacement: Float, velocity: Float) -> None:
        """Put the hand at `displacement`, [3], from where it was placed, hand frame, moving at `velocity`, [3]."""
        ...

    def displacement(self) -> Float:
        """Where the hand is, [3], from where it was placed, hand frame."""
        ...

    def drive(self, displacement: Float) -> None:
        """Drive the hand to `displacement`, [3], from where it was placed, hand frame."""
        ...

    def drive_velocity(self, velocity: Float) -> None:
        """Let the drives aim at `velocity`, [3], hand frame, as well."""
        ...

    def drive_fingers(self, opening: float) -> None:
        """Drive each finger to `opening`."""
        ...

    def opening(self) -> float:
        """How far both fingers together are open."""
        ...

    def coordinates(self) -> Float:
        """Everything that moves in the hand, lengths and rad or less: if none of it changes, the hand is at rest."""
        ...


def frame(rotation: Float, origin: Float | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float:
    """A rigid matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, origin
    return matrix


def _corners(x: float, y_low: float, y_high: float, z: float) -> list[tuple[float, float, float]]:
    """The corners of a rectangle at height z that is symmetric in x."""
    return [(s * x, y, z) for s in (-1.0, 1.0) for y in (y_low, y_high)]


def palm() -> Mesh:
    """The convex palm, hand frame. Its flange, below z = 0, is round with the radius of the wrist."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    flange = [(0.0316 * np.cos(a), 0.0316 * np.sin(a), -0.026) for a in angles]
    body = [corner for z in (0.0, 0.03) for corner in _corners(0.032, -0.104, 0.100, z)]
    top = [corner for z in (0.06, 0.066) for corner in _corners(0.019, -0.104, 0.100, z)]
    return Mesh(np.array(flange + body + top), _NO_FACES)


def finger() -> Mesh:
    """The convex finger that opens towards +y, in its own frame; its pad is at y = 0."""
    return Mesh(
        np.array(
            _corners(0.0104, 0.0025, 0.026, 0.0)
            + _corners(0.0104, 0.015, 0.026, 0.019)
            + _corners(0.0087, 0.0, 0.014, 0.036)
            + _corners(0.0087, 0.0, 0.014, 0.051)
            + _corners(0.0055, 0.0, 0.014, 0.054)
        ),
        _NO_FACES,
    )


class FreeGripper:
    """A hand whose palm floats freely, drawn to its target by one drive with six degrees of freedom.

    Args:
        palm: the palm's link, root of an articulation.
        fingers: the two fingers' links.
    """

    def __init__(self, palm: Link, fingers: tuple[Link, Link]) -> None:
        self.palm, self.fingers = palm, fingers
        self._articulation = palm.articulation
        self._drive = physx.PhysxDriveComponent(palm)
        palm.entity.add_component(self._drive)
        self._rotation, self._origin = np.eye(3), np.zeros(3)

    def set_pace(self, pace: float) -> None:
        """See `Gripper.set_pace`."""
        for set_property in (
            self._drive.set_drive_property_x,
            self._drive.set_drive_property_y,
            self._drive.set_drive_property_z,
            self._drive.set_drive_property_slerp,
        ):
            set_property(ARM_STIFFNESS, ARM_DAMPING / pace)
        set_finger_pace(self.fingers, pace)

    def place(self, rotation: Float, position: Float, opening: float) -> None:
        """See `Gripper.place`."""
        self._rotation, self._origin = rotation, position
        self._drive.pose_in_parent = pose(frame(rotation, position))
        self.drive(np.zeros(3))
        self.drive_velocity(np.zeros(3))
        self._articulation.set_qpos(np.full(2, opening, dtype=np.float32))
        self.drive_fingers(opening)
        self.shift(np.zeros(3), np.zeros(3))

    def shift(self, displacement: Float, velocity: Float) -> None:
        """See `Gripper.shift`."""
        self._articulation.set_root_pose(pose(frame(self._rotation, self._origin + self._rotation @ displacement)))
        self._articulation.set_root_linear_velocity(self._rotation @ velocity)
        self._articulation.set_root_angular_velocity(np.zeros(3))
        self._articulation.set_qvel(np.zeros(2, dtype=np.float32))

    def displacement(self) -> Float:
        """See `Gripper.displacement`."""
        return np.asarray((self._articulation.get_root_pose().p - self._origin) @ self._rotation, dtype=np.float64)

    def drive(self, displacement: Float) -> None:
        """See `Gripper.drive`."""
        self._drive.set_drive_target(sapien.Pose(displacement))

    def drive_velocity(self, velocity: Float) -> None:
        """See `Gripper.drive_velocity`."""
        self._drive.set_drive_velocity_target(velocity, np.zeros(3))

    def drive_fingers(self, opening: float) -> None:
        """See `Gripper.drive_fingers`."""
        for finger_link in self.fingers:
            finger_link.joint.set_drive_target(opening)

    def opening(self) -> float:
        """See `Gripper.opening`."""
        return float(self._articulation.get_qpos().sum())

    def coordinates(self) -> Float:
        """See `Gripper.coordinates`: palm position, its quaternion, the fingers."""
        at = self._articulation.get_root_pose()
        return np.concatenate([at.p, at.q, self._articulation.get_qpos()])


def add_gripper(scene: sapien.Scene, material: physx.PhysxMaterial) -> FreeGripper:
    """Build the free hand into a scene, weightless, as the published gravity compensation makes it.

    Its drives have no strength until `set_pace`.
    """
    assembly = Assembly(material)
    hand = assembly.add(None, "palm", (palm(),), joint="undefined", touches_own_kind=False)
    fingers = add_fingers(assembly, hand)
    make_weightless(hand, HAND_MASS)
    assembly.finish(scene)
    return FreeGripper(hand, fingers)


def add_fingers(assembly: Assembly, hand: Link) -> tuple[Link, Link]:
    """Hang the two fingers on the palm's link `hand`; their drives have no strength until `set_finger_pace`."""
    left, right = (_add_finger(assembly, hand, *named) for named in (("left", 1.0), ("right", -1.0)))
    return left, right


def _add_finger(assembly: Assembly, hand: Link, name: str, side: float) -> Link:
    link = assembly.add(
        hand,
        f"finger-{name}",
        (finger(),),
        joint="prismatic",
        joint_name=f"finger-{name}",
        parent_from_joint=frame(np.diag([side, side, 1.0]), (0.0, 0.0, FINGER_OFFSET)) @ frame(ALONG["y"]),
        child_from_joint=frame(ALONG["y"]),
        limits=(0.0, FINGER_OPEN),
        touches_own_kind=False,
    )
    make_weightless(link, FINGER_MASS)
    return link


def set_finger_pace(fingers: tuple[Link, Link], pace: float) -> None:
    """See `Gripper.set_pace`."""
    for link in fingers:
        link.joint.set_drive_property(FINGER_STIFFNESS, FINGER_DAMPING / pace)


def make_weightless(link: Link, mass: float) -> None:
    """Give a link of the hand its mass; gravity does not act on it."""
    link.disable_gravity = True
    link.mass = mass
    link.inertia = np.full(3, mass * 1e-3, dtype=np.float32)
