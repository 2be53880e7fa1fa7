"""Pinch profiles: what lies between the fingers of a gripper at a point, in steps of a centimetre; not in the paper.

Whether fingers will close on an edge cannot be seen in a cloud of 2,048 points, which are 35 mm apart. It can be in a
depth image, of which a pixel is 7 mm.

Shapes: M points of a dense cloud, S actions at one point p.
"""

import numpy as np
from numpy.typing import NDArray

from shared.types import Float32

BINS = 17
"""Along the closing axis, p in the middle of the middle one."""
BIN_M = 0.01
FINGER_M = 0.0105
"""Half of the width of a finger, across the closing axis."""
DEPTH_M = 0.05
"""How far behind p, along the approach, a surface counts."""
OUT_M = 0.1
"""How far before p a surface counts: about as far as the palm is when the fingertips touch p."""
HAND_M = (0.03, 0.1)
"""Half of the size of the hand, forward and along the closing axis: what stands out there is in its way."""
REACH_M = float(np.linalg.norm([*HAND_M, OUT_M]))
"""No point farther from p counts."""
PROFILE_WIDTH = 2 * BINS + 1
"""The nearest surface along the approach in each bin, from -1 (`DEPTH_M` before p, or more) to 1 (as far behind it, or
no surface); whether there is one in each bin, 0 or 1; and how far something stands out before p within the size of the
hand, from 0 to 1 (`OUT_M`)."""


def pinch_profiles(dense: Float32, point: Float32, frames: Float32) -> Float32:
    """The profiles of actions at one point.

    Args:
        dense: [M, 3], a cloud at the full resolution of its sensor.
        point: p, [3], in the frame of the cloud.
        frames: approach and forward, [S, 6], in this frame.

    Returns:
        [S, PROFILE_WIDTH].
    """
    approach, forward = frames[:, :3], frames[:, 3:6]
    rotations = np.stack([forward, np.cross(approach, forward), approach], axis=1)
    offsets = dense[_near(dense, point)] - point
    ahead_of, across, along = np.moveaxis(rotations @ offsets.T, 1, 0)
    bins = np.floor(across / BIN_M + BINS / 2).astype(np.int64)
    counted = (np.abs(ahead_of) <= FINGER_M) & (along <= DEPTH_M) & (along >= -OUT_M) & (bins >= 0) & (bins < BINS)
    action, which = np.nonzero(counted)
    nearest = np.full(len(frames) * BINS, np.inf)
    np.minimum.at(nearest, action * BINS + bins[action, which], along[action, which])
    surface = nearest.reshape(len(frames), BINS)
    in_the_way = (np.abs(ahead_of) <= HAND_M[0]) & (np.abs(across) <= HAND_M[1])
    standing_out = np.where(in_the_way, -along, 0.0).max(axis=1, initial=0.0)
    profiles = np.empty((len(frames), PROFILE_WIDTH), np.float32)
    profiles[:, :BINS] = np.clip(surface / DEPTH_M, -1.0, 1.0)
    profiles[:, BINS : 2 * BINS] = np.isfinite(surface)
    profiles[:, -1] = np.minimum(standing_out / OUT_M, 1.0)
    return profiles


def _near(dense: Float32, point: Float32) -> NDArray[np.int64]:
    """Indices of the points that may count."""
    near = (np.abs(dense - point) <= REACH_M).all(axis=1)
    found: NDArray[np.int64] = np.flatnonzero(near)
    within: NDArray[np.int64] = found[np.linalg.norm(dense[found] - point, axis=1) <= REACH_M]
    return within
