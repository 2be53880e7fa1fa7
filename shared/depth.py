"""Depth maps: the whole of what a depth camera measured of an object, in whole steps, as the store keeps it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.types import Float, Float32, round_points

DEPTH_STEP = 0.00025
"""m, from one depth to the next. Depths are told from the depth of the world's origin, so that 16 bits reach 8 m."""
NOTHING = 0
"""The number of a pixel that saw nothing."""
ORIGIN = 1 << 15
"""The number of a pixel that is as deep as the world's origin."""


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Implements `shared.types.DenseGeometry` for a square image of a camera without distortion.

    Attributes:
        steps: [S, S], depth along the camera's forward axis in `DEPTH_STEP`; see `NOTHING` and `ORIGIN`.
        focal: [1], focal length in pixels; the optical axis goes through the middle of the image.
        world_from_camera: [4, 4], x forward, y left, z up.
    """

    steps: NDArray[np.uint16]
    focal: Float
    world_from_camera: Float

    @classmethod
    def of(
        cls, pixels: NDArray[np.uint32], depths: Float, size: int, focal: float, world_from_camera: Float
    ) -> "DepthMap":
        """The map of what some pixels saw; surfaces more than 8 m from the object's origin are left out.

        Args:
            pixels: [H], row * size + column.
            depths: [H], m, along the camera's forward axis.
            size: S.
            focal: pixels.
            world_from_camera: [4, 4].
        """
        numbers = np.rint((depths - _origin_depth(world_from_camera)) / DEPTH_STEP) + ORIGIN
        numbers[(numbers <= NOTHING) | (numbers > np.iinfo(np.uint16).max)] = NOTHING
        steps = np.full(size * size, NOTHING, np.uint16)
        steps[pixels] = numbers.astype(np.uint16)
        return cls(steps.reshape(size, size), np.array([focal]), world_from_camera)

    def points(self) -> Float32:
        """The surface at every pixel that saw the object, [M, 3], world frame, rounded as clouds are."""
        size = len(self.steps)
        rows, columns = np.nonzero(self.steps)
        depths = (self.steps[rows, columns].astype(np.float64) - ORIGIN) * DEPTH_STEP
        depths += _origin_depth(self.world_from_camera)
        left, up = ((size / 2 - places - 0.5) / self.focal for places in (columns, rows))
        directions = np.stack([np.ones_like(left), left, up], axis=1)
        places = self.world_from_camera[:3, 3] + (directions * depths[:, None]) @ self.world_from_camera[:3, :3].T
        return round_points(places)


def pack_steps(steps: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Depth maps, [..., S, S], as what each pixel differs by from the plane through three neighbours.

    Surfaces are mostly flat, so that these numbers are small and compress well.
    """
    differences = steps.copy()
    differences[..., 1:, :] -= steps[..., :-1, :]
    across = differences.copy()
    across[..., 1:] -= differences[..., :-1]
    signed = across.view(np.int16)
    # Numbers of either sign as 0, -1, 1, -2, ...: so the upper byte is 0 nearly everywhere.
    return ((signed << 1) ^ (signed >> 15)).view(np.uint16)


def unpack_steps(packed: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """The depth maps, [..., S, S], that `pack_steps` packed."""
    differences = (packed >> 1) ^ (np.uint16(0) - (packed & 1))
    down: NDArray[np.uint16] = np.cumsum(differences, axis=-1, dtype=np.uint16)
    return np.cumsum(down, axis=-2, dtype=np.uint16)


def _origin_depth(world_from_camera: Float) -> float:
    """Depth of the world's origin along the camera's forward axis, m."""
    return float(-world_from_camera[:3, 0] @ world_from_camera[:3, 3])
