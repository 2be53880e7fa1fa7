"""An arm: a chain of joints that carries the hand, and capsules that stand for its links.

Those that are built in have their makers' published kinematic parameters, and capsules that are measured by eye. Franka
Emika Panda: the Craig-convention parameters of the Franka Control Interface documentation; its hand is turned by -45
degrees on the flange. Universal Robots UR5e: the DH parameters of the maker's support pages, in the frame of its
controller; a hand is mounted on the tool flange without an adapter.
"""

import math
from math import pi
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from shared.config import StrictModel
from shared.errors import ObjectError, UsageError
from shared.extensions import Registry
from shared.io.files import read_named
from shared.types import Float
from shared.urdf import MAX_URDF_BYTES, Shape, Urdf, UrdfJoint, parse_urdf, rotation_from_rpy

URDF = "urdf"
"""What a setting calls an arm that a file defined."""
MAX_JOINTS, MAX_CAPSULES = 16, 256
LINK_RADIUS = 0.06
"""m, of a link whose file has no boxes, cylinders or spheres; it then reaches from its joint to the next."""
MESH_ENDINGS = ("",)
"""Meshes of an arm are not read, so all kinds are allowed."""

Vector = tuple[float, float, float]
Length = Annotated[float, Field(gt=0, le=10)]


class ArmJoint(StrictModel):
    """A joint and the link that it moves, in the frame of the link before; `xyz` and `rpy` as in a URDF."""

    name: str = Field(min_length=1, max_length=200)
    kind: Literal["revolute", "prismatic"] = "revolute"
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float
    """rad or m."""
    upper: float


class Capsule(StrictModel):
    """A part of a link: all that is within `radius` of the line from `start` to `end`, in the link's frame.

    Attributes:
        link: 0 is the base, k what the k-th joint moves.
    """

    link: int = Field(ge=0)
    start: Vector
    end: Vector
    radius: Length


class Arm(StrictModel):
    """An arm from its base to the frame of the hand (forward, left, approach), which the last link carries."""

    joints: tuple[ArmJoint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    hand_xyz: Vector = (0.0, 0.0, 0.0)
    hand_rpy: Vector = (0.0, 0.0, 0.0)
    capsules: tuple[Capsule, ...] = Field((), max_length=MAX_CAPSULES)

    @model_validator(mode="after")
    def _consistent(self) -> "Arm":
        if any(np.linalg.norm(joint.axis) < 1e-9 or joint.lower > joint.upper for joint in self.joints):
            raise ValueError("each joint needs an axis other than 0 0 0, and lower <= upper")
        if any(capsule.link > len(self.joints) for capsule in self.capsules):
            raise ValueError(f"capsules are on links 0 to {len(self.joints)}")
        return self

    @property
    def limits(self) -> tuple[list[float], list[float]]:
        """Lower and upper limits of the joints, rad or m."""
        return [joint.lower for joint in self.joints], [joint.upper for joint in self.joints]


ARMS = Registry("arm", Arm, {"panda": "shared.arms.arm:PANDA", "ur5e": "shared.arms.arm:UR5E"})
"""Arms by name: ours, and those of other packages."""


def arm_of(told: str) -> Arm:
    """The arm of a name, or of a file FILE.urdf or FILE.urdf#LINK, where LINK carries the hand.

    Raises:
        UsageError: there is no such arm, or the file cannot be read, or has none that can be used.
    """
    file, _, link = told.partition("#")
    if not file.endswith(".urdf"):
        return ARMS.get(told)
    try:
        data = read_named(Path(file), MAX_URDF_BYTES, f"name an arm ({', '.join(ARMS.names())}) or a URDF")
        return arm_from_urdf(parse_urdf(data, file, MESH_ENDINGS), link)
    except ObjectError as error:
        raise UsageError(str(error) if str(error).startswith(file) else f"{file}: {error}") from None


def arm_from_urdf(urdf: Urdf, hand: str = "") -> Arm:
    """The chain of a URDF from its root to a link.

    Args:
        urdf: of the whole robot; joints beside the chain are left out, as are those that cannot move.
        hand: the link that carries the hand: its frame is the hand's; "": the only link that carries no other.

    Raises:
        ObjectError: there is no such link, or no joint moves it, or another joint moves one of these.
    """
    parents = {joint.child: joint for joint in urdf.joints}
    ends = [name for name in urdf.links if name not in {joint.parent for joint in urdf.joints}]
    if (hand or len(ends) != 1) and hand not in urdf.links:
        names = ", ".join(list(urdf.links)[-8:])
        raise ObjectError(f"say which link carries the hand, as FILE.urdf#LINK; the last links are {names}")
    chain: list[UrdfJoint] = []
    at = hand or ends[0]
    while at != urdf.root:
        chain.insert(0, parents[at])
        at = parents[at].parent
    joints, capsules = list[ArmJoint](), list[Capsule]()
    pose, moved = np.eye(4), 0
    capsules += _capsules(urdf.links[urdf.root].collisions, pose, 0)
    for number, joint in enumerate(chain):
        pose = pose @ joint.parent_from_child
        if joint.mimics and joint.kind != "fixed":
            raise ObjectError(f"joint {joint.name} follows another (<mimic>); an arm's joints move freely")
        if joint.kind != "fixed" and joint.lower < joint.upper:
            joints.append(
                ArmJoint(
                    name=joint.name,
                    kind="prismatic" if joint.kind == "prismatic" else "revolute",
                    xyz=_vector(pose[:3, 3]),
                    rpy=_rpy(pose[:3, :3]),
                    axis=_vector(joint.axis),
                    # Two turns either way are as good as no limit.
                    lower=max(joint.lower, -2 * math.pi) if joint.kind != "prismatic" else max(joint.lower, -10.0),
                    upper=min(joint.upper, 2 * math.pi) if joint.kind != "prismatic" else min(joint.upper, 10.0),
                )
            )
            moved, pose = moved + 1, np.eye(4)
        own = _capsules(urdf.links[joint.child].collisions, pose, moved)
        if not own and number + 1 < len(chain) and moved:
            end = (pose @ chain[number + 1].parent_from_child)[:3, 3]
            own = [Capsule(link=moved, start=_vector(pose[:3, 3]), end=_vector(end), radius=LINK_RADIUS)]
        capsules += own
    if not joints:
        raise ObjectError("no joint moves the hand; name the link that carries it, as FILE.urdf#LINK")
    if len(joints) > MAX_JOINTS or len(capsules) > MAX_CAPSULES:
        raise ObjectError(
            f"{len(joints)} joints and {len(capsules)} shapes up to the hand; at most {MAX_JOINTS} and {MAX_CAPSULES}"
        )
    return Arm(
        joints=tuple(joints), hand_xyz=_vector(pose[:3, 3]), hand_rpy=_rpy(pose[:3, :3]), capsules=tuple(capsules)
    )


def _capsules(shapes: tuple[Shape, ...], pose: Float, link: int) -> list[Capsule]:
    """Boxes, cylinders and spheres as capsules about their longest axis; meshes are left out."""
    found = []
    for shape in shapes:
        place = pose @ shape.link_from_shape
        if shape.kind == "mesh":
            continue
        if shape.kind == "box":
            axis = int(shape.size.argmax())
            radius, half = float(np.linalg.norm(np.delete(shape.size, axis))) / 2, float(shape.size[axis]) / 2
        else:
            axis, radius = 2, float(shape.size[0])
            half = float(shape.size[1]) / 2 if shape.kind == "cylinder" else 0.0
        along = max(half - radius / 2, 0.0) * place[:3, axis]
        start, end = _vector(place[:3, 3] - along), _vector(place[:3, 3] + along)
        found.append(Capsule(link=link, start=start, end=end, radius=min(radius, 10.0)))
    return found


def pose_of(xyz: Vector, rpy: Vector) -> Float:
    """[4, 4], of a translation and of roll, pitch, yaw about fixed axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_rpy(*rpy), xyz
    return pose


def _rpy(rotation: Float) -> Vector:
    """Roll, pitch, yaw of a rotation, [3, 3]."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:
        return math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0
    return math.atan2(rotation[2, 1], rotation[2, 2]), pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _vector(numbers: Float) -> Vector:
    x, y, z = numbers.tolist()
    return x, y, z


def _capsule(link: int, start: Vector, end: Vector, radius: float) -> Capsule:
    return Capsule(link=link, start=start, end=end, radius=radius)


PANDA = Arm(
    joints=(
        ArmJoint(name="panda_joint1", xyz=(0, 0, 0.333), lower=-2.8973, upper=2.8973),
        ArmJoint(name="panda_joint2", rpy=(-pi / 2, 0, 0), lower=-1.7628, upper=1.7628),
        ArmJoint(name="panda_joint3", xyz=(0, -0.316, 0), rpy=(pi / 2, 0, 0), lower=-2.8973, upper=2.8973),
        ArmJoint(name="panda_joint4", xyz=(0.0825, 0, 0), rpy=(pi / 2, 0, 0), lower=-3.0718, upper=-0.0698),
        ArmJoint(name="panda_joint5", xyz=(-0.0825, 0.384, 0), rpy=(-pi / 2, 0, 0), lower=-2.8973, upper=2.8973),
        ArmJoint(name="panda_joint6", rpy=(pi / 2, 0, 0), lower=-0.0175, upper=3.7525),
        ArmJoint(name="panda_joint7", xyz=(0.088, 0, 0), rpy=(pi / 2, 0, 0), lower=-2.8973, upper=2.8973),
    ),
    hand_xyz=(0, 0, 0.107),
    hand_rpy=(0, 0, -pi / 4),
    capsules=(
        _capsule(0, (-0.06, 0, 0.06), (0, 0, 0.06), 0.08),
        _capsule(1, (0, 0, -0.19), (0, 0, 0), 0.07),
        _capsule(2, (0, 0, 0), (0, -0.19, 0), 0.07),
        _capsule(3, (0, 0, -0.12), (0, 0, 0), 0.065),
        _capsule(3, (0.0825, -0.03, 0), (0.0825, 0.03, 0), 0.06),
        _capsule(4, (0, 0, 0), (-0.0825, 0.1, 0), 0.06),
        _capsule(5, (0, 0, -0.27), (0, 0, -0.13), 0.06),
        _capsule(5, (0, 0.07, -0.13), (0, 0.07, 0), 0.05),
        _capsule(6, (0, 0, 0), (0.088, 0, 0), 0.055),
        _capsule(7, (0, 0, 0), (0, 0, 0.05), 0.05),
    ),
)
UR5E = Arm(
    joints=(
        ArmJoint(name="shoulder_pan_joint", lower=-2 * pi, upper=2 * pi),
        ArmJoint(name="shoulder_lift_joint", xyz=(0, 0, 0.1625), rpy=(pi / 2, 0, 0), lower=-2 * pi, upper=2 * pi),
        ArmJoint(name="elbow_joint", xyz=(-0.425, 0, 0), lower=-pi, upper=pi),
        ArmJoint(name="wrist_1_joint", xyz=(-0.3922, 0, 0), lower=-2 * pi, upper=2 * pi),
        ArmJoint(name="wrist_2_joint", xyz=(0, 0, 0.1333), rpy=(pi / 2, 0, 0), lower=-2 * pi, upper=2 * pi),
        ArmJoint(name="wrist_3_joint", xyz=(0, 0, 0.0997), rpy=(-pi / 2, 0, 0), lower=-2 * pi, upper=2 * pi),
    ),
    hand_xyz=(0, 0, 0.0996),
    capsules=(
        _capsule(0, (0, 0, 0.04), (0, 0, 0.06), 0.07),
        _capsule(1, (0, 0, 0.12), (0, 0, 0.1625), 0.065),
        _capsule(2, (0, 0, 0.05), (0, 0, 0.138), 0.06),
        _capsule(2, (0, 0, 0.138), (-0.425, 0, 0.138), 0.06),
        _capsule(3, (0, 0, 0.01), (-0.3922, 0, 0.01), 0.055),
        _capsule(4, (0, 0, 0.06), (0, 0, 0.1333), 0.045),
        _capsule(5, (0, 0, 0), (0, 0, 0.0997), 0.045),
        _capsule(6, (0, 0, 0.04), (0, 0, 0.06), 0.04),
    ),
)
