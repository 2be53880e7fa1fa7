"""The registry of hands."""

import numpy as np

from collector.sim.engine import physx, sapien
from collector.sim.gripper import Gripper, GripperSpec, TwoFingers, build_free, convex
from collector.sim.jointed_gripper import build_jointed
from collector.sim.suction import build_suction
from shared.extensions import Registry


def two_fingered(shape: TwoFingers) -> GripperSpec:
    """A hand with two fingers, jointed or free."""

    def build(scene: sapien.Scene, material: physx.PhysxMaterial, jointed: bool) -> Gripper:
        return build_jointed(shape, scene, material) if jointed else build_free(shape, scene, material)

    return GripperSpec(build)


def _corners(x: float, y_low: float, y_high: float, z: float) -> list[tuple[float, float, float]]:
    """The corners of a rectangle at height z that is symmetric in x."""
    return [(s * x, y, z) for s in (-1.0, 1.0) for y in (y_low, y_high)]


def panda_shape() -> TwoFingers:
    """The Franka Panda hand. Its flange, below z = 0, is round with the radius of the wrist."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    flange = [(0.0316 * np.cos(a), 0.0316 * np.sin(a), -0.026) for a in angles]
    body = [corner for z in (0.0, 0.03) for corner in _corners(0.032, -0.104, 0.100, z)]
    top = [corner for z in (0.06, 0.066) for corner in _corners(0.019, -0.104, 0.100, z)]
    finger = (
        _corners(0.0104, 0.0025, 0.026, 0.0)
        + _corners(0.0104, 0.015, 0.026, 0.019)
        + _corners(0.0087, 0.0, 0.014, 0.036)
        + _corners(0.0087, 0.0, 0.014, 0.051)
        + _corners(0.0055, 0.0, 0.014, 0.054)
    )
    return TwoFingers((convex(flange + body + top),), (convex(finger),), 0.0584, 0.04, 0.73, 0.015)


GRIPPERS = Registry(
    "gripper", GripperSpec, {"panda": two_fingered(panda_shape()), "suction": GripperSpec(build_suction)}
)
