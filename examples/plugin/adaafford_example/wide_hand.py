"""A gripper: two flat fingers that open to 140 mm, in the manner of Robotiq's 2F-140, made of boxes."""

from collector.sim.gripper import TIP_DISTANCE, TwoFingers, convex
from collector.sim.grippers import two_fingered

PALM_END = 0.05
"""From the hand frame's origin to where the fingers begin, m."""


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> list[tuple[float, float, float]]:
    return [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]


WIDE = two_fingered(
    TwoFingers(
        palm=(convex(_box((-0.035, -0.09, -0.03), (0.035, 0.09, PALM_END - 0.005))),),
        finger=(convex(_box((-0.011, 0.0, 0.0), (0.011, 0.015, TIP_DISTANCE - PALM_END))),),
        finger_offset=PALM_END,
        finger_open=0.07,
        palm_mass=0.9,
        finger_mass=0.05,
    )
)
