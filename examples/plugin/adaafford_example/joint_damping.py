"""Joint damping: a moving part loses speed at a rate that no camera shows, as a door with a closer does."""

from shared.hidden import HiddenParameter, HiddenTarget


def damp(target: HiddenTarget, rate: float) -> None:
    """Let every movable part lose its speed at `rate`, 1/s; the handles are SAPIEN's."""
    for link in target.links:
        link.linear_damping = link.angular_damping = rate


JOINT_DAMPING = HiddenParameter(
    name="joint_damping",
    description="rate at which a moving part loses speed",
    unit="1/s",
    low=0.0,
    high=20.0,
    log=False,
    default=0.0,
    apply=damp,
)
