"""Arms that are built in, from their makers' published kinematic parameters; capsules are measured by eye.

Franka Emika Panda: the Craig-convention parameters of the Franka Control Interface documentation; its hand is turned by
-45 degrees on the flange. Universal Robots UR5e: the DH parameters of the maker's support pages, in the frame of its
controller; a hand is mounted on the tool flange without an adapter.
"""

from math import pi

from shared.arms.arm import Arm, ArmJoint, Capsule, Vector


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
