"""The flying hand as published: its palm hangs on three sliding and three turning joints, each with a drive.

The reference fidelity uses it, and so does the published protocol against which collection is timed.
"""

import numpy as np

from collector.engine import Assembly, Link, physx, pose, sapien
from collector.gripper import (
    ALONG,
    ARM_DAMPING,
    ARM_STIFFNESS,
    HAND_MASS,
    add_fingers,
    frame,
    make_weightless,
    palm,
    set_finger_pace,
)
from shared.vocabulary import Float

CARRIER_MASS = 0.1
"""kg, of each link between the six joints."""


class JointedGripper:
    """A hand whose place is a joint position.

    Args:
        articulation: six joints of the carrier (x, y, z, then turns about x, y, z), then the two fingers.
        palm: the palm's link.
        fingers: the two fingers' links.

    Attributes:
        joints: the same eight joints.
    """

    def __init__(self, articulation: physx.PhysxArticulation, palm: Link, fingers: tuple[Link, Link]) -> None:
        self.articulation = articulation
        self.joints = tuple(articulation.active_joints)
        self.palm, self.fingers = palm, fingers
        assert [j.name for j in self.joints[6:]] == ["finger-left", "finger-right"], "joint order is by creation"

    def set_pace(self, pace: float) -> None:
        """See `Gripper.set_pace`."""
        for joint in self.joints[:6]:
            joint.set_drive_property(ARM_STIFFNESS, ARM_DAMPING / pace)
        set_finger_pace(self.fingers, pace)

    def place(self, rotation: Float, position: Float, opening: float) -> None:
        """See `Gripper.place`."""
        self.articulation.set_root_pose(pose(frame(rotation, position)))
        positions = np.array([0.0] * 6 + [opening] * 2, dtype=np.float32)
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(np.zeros(8, dtype=np.float32))
        for joint, target in zip(self.joints, positions, strict=True):
            joint.set_drive_target(float(target))
            joint.set_drive_velocity_target(0.0)

    def shift(self, displacement: Float, velocity: Float) -> None:
        """See `Gripper.shift`."""
        positions, velocities = self.articulation.get_qpos(), np.zeros(8, dtype=np.float32)
        positions[:6] = np.append(displacement, np.zeros(3))
        velocities[:3] = velocity
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(velocities)

    def displacement(self) -> Float:
        """See `Gripper.displacement`."""
        return np.asarray(self.articulation.get_qpos()[:3], dtype=np.float64)

    def drive(self, displacement: Float) -> None:
        """See `Gripper.drive`."""
        for joint, target in zip(self.joints, displacement, strict=False):
            joint.set_drive_target(target)

    def drive_velocity(self, velocity: Float) -> None:
        """See `Gripper.drive_velocity`."""
        for joint, target in zip(self.joints, velocity, strict=False):
            joint.set_drive_velocity_target(target)

    def drive_fingers(self, opening: float) -> None:
        """See `Gripper.drive_fingers`."""
        for joint in self.joints[6:]:
            joint.set_drive_target(opening)

    def opening(self) -> float:
        """See `Gripper.opening`."""
        return float(self.articulation.get_qpos()[6:].sum())

    def coordinates(self) -> Float:
        """See `Gripper.coordinates`: the positions of the eight joints."""
        return np.asarray(self.articulation.get_qpos(), dtype=np.float64)


def add_jointed_gripper(scene: sapien.Scene, material: physx.PhysxMaterial) -> JointedGripper:
    """Build the published hand into a scene; see `collector.gripper.add_gripper`."""
    assembly = Assembly(material)
    link = assembly.add(None, "hand-root", ())
    make_weightless(link, CARRIER_MASS)
    for kind in ("prismatic", "revolute"):
        for axis, along in ALONG.items():
            is_palm = kind == "revolute" and axis == "z"
            link = assembly.add(
                link,
                "palm" if is_palm else f"carrier-{kind}-{axis}",
                (palm(),) if is_palm else (),
                joint=kind,
                joint_name=f"hand-{kind}-{axis}",
                parent_from_joint=frame(along),
                child_from_joint=frame(along),
                limits=(-10.0, 10.0),
                touches_own_kind=False,
            )
            make_weightless(link, HAND_MASS if is_palm else CARRIER_MASS)
    fingers = add_fingers(assembly, link)
    return JointedGripper(assembly.finish(scene), link, fingers)
