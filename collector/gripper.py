"""The flying Franka Panda hand: its collision shapes, joints and drives (figures of the published protocol).

The hand frame's columns are forward, left, up, where *up* is the approach direction. The hand hangs on three sliding
and three turning joints, so that its place is a joint position and its drives are those of the published robot.
"""

from dataclasses import dataclass

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
HAND_MASS, FINGER_MASS, CARRIER_MASS = 0.73, 0.015, 0.1
"""kg. The drives are strongly overdamped, so these hardly matter; the carriers are the links between the six joints."""

_NO_FACES = np.zeros((0, 3), dtype=np.int32)
_ALONG = {
    "x": np.eye(3),
    "y": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "z": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rotations whose first column is the named axis, since SAPIEN's joints move along or about their frame's x."""


def _frame(rotation: Float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float:
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


@dataclass(frozen=True, slots=True)
class Gripper:
    """The hand in a scene.

    Attributes:
        articulation: six joints of the carrier (x, y, z, then turns about x, y, z), then the two fingers.
        joints: the same eight joints.
        palm: the palm's link.
        fingers: the two fingers' links.
    """

    articulation: physx.PhysxArticulation
    joints: tuple[physx.PhysxArticulationJoint, ...]
    palm: Link
    fingers: tuple[Link, Link]

    def place(self, rotation: Float, position: Float, opening: float) -> None:
        """Put the hand somewhere at rest, each finger open by `opening`, with the drives holding it there.

        Args:
            rotation: [3, 3], world_from_hand.
            position: [3], world, of the hand frame's origin; joint positions count from here.
            opening: of each finger.
        """
        self.articulation.set_root_pose(pose(_frame(rotation, tuple(position))))
        positions = np.array([0.0] * 6 + [opening] * 2, dtype=np.float32)
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(np.zeros(8, dtype=np.float32))
        for joint, target in zip(self.joints, positions, strict=True):
            joint.set_drive_target(float(target))
            joint.set_drive_velocity_target(0.0)

    def shift(self, displacement: Float, velocity: Float) -> None:
        """Put the hand at `displacement`, [3], from where it was placed, hand frame, moving at `velocity`, [3]."""
        positions, velocities = self.articulation.get_qpos(), np.zeros(8, dtype=np.float32)
        positions[:6] = np.append(displacement, np.zeros(3))
        velocities[:3] = velocity
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(velocities)

    def drive_fingers(self, opening: float) -> None:
        """Drive each finger to `opening`."""
        for joint in self.joints[6:]:
            joint.set_drive_target(opening)

    def opening(self) -> float:
        """How far both fingers together are open."""
        return float(self.articulation.get_qpos()[6:].sum())


def add_gripper(scene: sapien.Scene, material: physx.PhysxMaterial) -> Gripper:
    """Build the hand into a scene, weightless, as the published gravity compensation makes it."""
    assembly = Assembly(material)
    link = assembly.add(None, "hand-root", ())
    for kind in ("prismatic", "revolute"):
        for axis, along in _ALONG.items():
            is_palm = kind == "revolute" and axis == "z"
            link = assembly.add(
                link,
                "palm" if is_palm else f"carrier-{kind}-{axis}",
                (palm(),) if is_palm else (),
                joint=kind,
                joint_name=f"hand-{kind}-{axis}",
                parent_from_joint=_frame(along),
                child_from_joint=_frame(along),
                limits=(-10.0, 10.0),
                touches_own_kind=False,
            )
    hand = link
    for name, side in (("left", 1.0), ("right", -1.0)):
        assembly.add(
            hand,
            f"finger-{name}",
            (finger(),),
            joint="prismatic",
            joint_name=f"finger-{name}",
            parent_from_joint=_frame(np.diag([side, side, 1.0]), (0.0, 0.0, FINGER_OFFSET)) @ _frame(_ALONG["y"]),
            child_from_joint=_frame(_ALONG["y"]),
            limits=(0.0, FINGER_OPEN),
            touches_own_kind=False,
        )
    left, right = assembly.links[-2:]
    for link in assembly.links:
        link.disable_gravity = True
        link.mass = HAND_MASS if link is hand else FINGER_MASS if link in (left, right) else CARRIER_MASS
        link.inertia = np.full(3, link.mass * 1e-3, dtype=np.float32)
    articulation = assembly.finish(scene)
    joints = tuple(articulation.active_joints)
    assert [j.name for j in joints[6:]] == ["finger-left", "finger-right"], "joint order is by creation"
    for joint in joints[:6]:
        joint.set_drive_property(ARM_STIFFNESS, ARM_DAMPING)
    for joint in joints[6:]:
        joint.set_drive_property(FINGER_STIFFNESS, FINGER_DAMPING)
    return Gripper(articulation, joints, hand, (left, right))
