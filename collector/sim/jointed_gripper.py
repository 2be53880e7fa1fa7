"""The flying hand as published: its palm is attached to three sliding and three turning joints, each with a drive.

The reference fidelity uses it, and so does the published protocol against which collection is timed.
"""

import numpy as np

from collector.sim.engine import Assembly, Link, physx, pose, sapien
from collector.sim.gripper import (
    ALONG,
    ARM_DAMPING,
    ARM_STIFFNESS,
    FingeredGripper,
    HandShape,
    drive_fingers,
    frame,
    make_weightless,
    set_finger_pace,
)
from shared.types import Float

CARRIER_MASS = 0.1
"""kg, of each link between the six joints."""
DRIVEN = (0, 1, 2, 5)
"""The joints that move the hand along its axes, and turn it about up."""


class JointedGripper(FingeredGripper):
    """A hand whose pose is a joint position.

    Args:
        shape: of the hand.
        articulation: six joints of the carrier (x, y, z, then turns about x, y, z), then those of fingers that
            open.
        palm: the palm's link.
        fingers: the fingers' links.

    Attributes:
        joints: the same joints.
    """

    def __init__(
        self, shape: HandShape, articulation: physx.PhysxArticulation, palm: Link, fingers: tuple[Link, ...]
    ) -> None:
        self._open = shape.finger_open
        self.articulation = articulation
        self.joints = tuple(articulation.active_joints)
        self._driven = [self.joints[k] for k in DRIVEN]
        self.palm, self.fingers = palm, fingers
        assert all(j.name.startswith("finger-") for j in self.joints[6:]), "joint order is by creation"

    def set_pace(self, pace: float) -> None:
        for joint in self.joints[:6]:
            joint.set_drive_property(ARM_STIFFNESS, ARM_DAMPING / pace)
        set_finger_pace(self.joints[6:], pace)

    def place(self, rotation: Float, position: Float, *, opened: bool) -> None:
        self.articulation.set_root_pose(pose(frame(rotation, position)))
        positions = np.array([0.0] * 6 + [self._open if opened else 0.0] * (len(self.joints) - 6), dtype=np.float32)
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(np.zeros_like(positions))
        for joint, target in zip(self.joints, positions, strict=True):
            joint.set_drive_target(float(target))
            joint.set_drive_velocity_target(0.0)

    def shift(self, place: Float, velocity: Float) -> None:
        positions = self.articulation.get_qpos()
        velocities = np.zeros_like(positions)
        positions[:6] = on_arm(place)
        velocities[:6] = on_arm(velocity)
        self.articulation.set_qpos(positions)
        self.articulation.set_qvel(velocities)

    def displacement(self) -> Float:
        return np.asarray(self.articulation.get_qpos()[:3], dtype=np.float64)

    def drive(self, place: Float) -> None:
        for joint, target in zip(self._driven, place, strict=True):
            joint.set_drive_target(target)

    def drive_velocity(self, velocity: Float) -> None:
        for joint, target in zip(self._driven, velocity, strict=True):
            joint.set_drive_velocity_target(target)

    def close(self) -> None:
        drive_fingers(self.joints[6:], 0.0)

    def opening(self) -> float:
        return float(self.articulation.get_qpos()[6:].sum())

    def coordinates(self) -> Float:
        """See `Gripper.coordinates`: the positions of the joints."""
        return np.asarray(self.articulation.get_qpos(), dtype=np.float64)


def on_arm(place: Float) -> Float:
    """A position or a velocity, [4], for the six joints of the carrier."""
    arm = np.zeros(6)
    arm[list(DRIVEN)] = place
    return arm


def build_jointed(shape: HandShape, scene: sapien.Scene, material: physx.PhysxMaterial) -> JointedGripper:
    """Build the published hand into a scene; see `collector.sim.gripper.build_free`."""
    assembly = Assembly(material)
    link = assembly.add(None, "hand-root", ())
    make_weightless(link, CARRIER_MASS)
    for kind in ("prismatic", "revolute"):
        for axis, along in ALONG.items():
            is_palm = kind == "revolute" and axis == "z"
            link = assembly.add(
                link,
                "palm" if is_palm else f"carrier-{kind}-{axis}",
                shape.palm if is_palm else (),
                joint=kind,
                joint_name=f"hand-{kind}-{axis}",
                parent_from_joint=frame(along),
                child_from_joint=frame(along),
                limits=(-10.0, 10.0),
                touches_own_kind=False,
            )
            make_weightless(link, shape.palm_mass if is_palm else CARRIER_MASS)
    fingers = shape.add_fingers(assembly, link)
    return JointedGripper(shape, assembly.finish(scene), link, fingers)
