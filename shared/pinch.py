"""Pinch profiles: what lies between the fingers of a gripper at a point, in steps of a centimetre; not in the paper.

Whether fingers will close on an edge cannot be seen in a cloud of 2,048 points, which are 35 mm apart. It can be in a
depth image, of which a pixel is 7 mm.

Shapes: M points of a dense cloud, S actions at one point p.
"""

import numpy as np
from numpy.typing import NDArray

from shared.types import Float, Float32

BINS = 17
"""Along the closing axis, p in the middle of the middle one."""
BIN_M = 0.01
FINGER_M = 0.0105
"""Half of the width of a finger across the closing axis."""
DEPTH_M = 0.1
"""How far before and behind p, along the approach, a surface counts."""
HAND_M = (0.03, 0.1)
"""Half of the hand's size, forward and along the closing axis: what stands out there is in its way."""
PROFILE_WIDTH = 2 * BINS + 1
"""The nearest surface in each bin, from -1 (`DEPTH_M` before p) to 1 (as far behind it, or no surface); whether there
is one, as 0 or 1; and how far something stands out before p within the hand's size, from 0 to 1 (`DEPTH_M`)."""
REACH_M = float(np.linalg.norm([*HAND_M, DEPTH_M]))
"""No point farther from p counts."""


def pinch_profiles(dense: Float32, point: Float | Float32, rotations: Float) -> Float32:
    """The profiles of actions at one point.

    Turning the gripper about its approach by 180 deg reverses the bins and leaves the rest.

    Args:
        dense: [M, 3], a cloud at the full resolution of its sensor.
        point: p, [3], in the frame of the cloud.
        rotations: R, [S, 3, 3], of the gripper, in this frame; columns forward, left (the closing axis), approach.

    Returns:
        [S, PROFILE_WIDTH].
    """
    offsets = dense[_near(dense, point)] - point
    places = np.einsum("mi,sij->sjm", offsets, rotations, optimize=True)
    forward, across, ahead = places[:, 0], places[:, 1], places[:, 2]
    bins = np.floor(across / BIN_M + BINS / 2).astype(np.int64)
    counted = (np.abs(forward) <= FINGER_M) & (np.abs(ahead) <= DEPTH_M) & (bins >= 0) & (bins < BINS)
    action, where = np.nonzero(counted)
    nearest = np.full(len(rotations) * BINS, np.inf)
    np.minimum.at(nearest, action * BINS + bins[action, where], ahead[action, where])
    surface = nearest.reshape(len(rotations), BINS)
    in_the_way = (np.abs(forward) <= HAND_M[0]) & (np.abs(across) <= HAND_M[1])
    standing_out = np.where(in_the_way, -ahead, 0.0).max(axis=1, initial=0.0)
    profiles = np.concatenate(
        [
            np.minimum(surface, DEPTH_M) / DEPTH_M,
            np.isfinite(surface),
            np.minimum(standing_out, DEPTH_M)[:, None] / DEPTH_M,
        ],
        axis=1,
    )
    return profiles.astype(np.float32)


def _near(dense: Float32, point: Float | Float32) -> NDArray[np.int64]:
    """Indices of the points that may count."""
    near = np.ones(len(dense), dtype=bool)
    for axis in range(3):
        near &= np.abs(dense[:, axis] - point[axis]) <= REACH_M
    found: NDArray[np.int64] = np.flatnonzero(near)
    distances = np.linalg.norm(dense[found] - point, axis=1)
    within: NDArray[np.int64] = found[distances <= REACH_M]
    return within
