"""Arms as URDF files, and small worlds for them."""

from shared.arms.arm import Arm

INERTIA = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def text(numbers: tuple[float, ...]) -> str:
    return " ".join(map(repr, numbers))


def urdf_of(arm: Arm, hand: str = "hand") -> str:
    """A URDF of an arm; MuJoCo's own element keeps the frame of the hand there."""
    links = ["base", *(f"link{k}" for k in range(1, len(arm.joints) + 1)), hand]
    lines = ['<robot name="arm"><mujoco><compiler fusestatic="false"/></mujoco>']
    for number, name in enumerate(links):
        shapes = [
            f'<collision><origin xyz="{text(each.start)}"/><geometry><sphere radius="{each.radius}"/></geometry>'
            "</collision>"
            for each in arm.capsules
            if each.link == number
        ]
        lines.append(f'<link name="{name}">{INERTIA}{"".join(shapes)}</link>')
    for parent, child, joint in zip(links, links[1:], arm.joints, strict=False):
        lines.append(
            f'<joint name="{joint.name}" type="{joint.kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text(joint.xyz)}" rpy="{text(joint.rpy)}"/><axis xyz="{text(joint.axis)}"/>'
            f'<limit lower="{joint.lower}" upper="{joint.upper}" effort="1" velocity="1"/></joint>'
        )
    lines.append(
        f'<joint name="mount" type="fixed"><parent link="{links[-2]}"/><child link="{hand}"/>'
        f'<origin xyz="{text(arm.hand_xyz)}" rpy="{text(arm.hand_rpy)}"/></joint></robot>'
    )
    return "\n".join(lines)
