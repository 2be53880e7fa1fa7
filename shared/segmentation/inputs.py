"""What the segmentation network is given of a raw scan: what is left without floor and walls, thinned and described.

The frame of the network has z up and x away from the camera; its origin is on the floor, in the middle of what is left.
Shapes: M points of a scan, N points that the network is given.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from shared import seeds
from shared.errors import UsageError
from shared.observation import furthest_first
from shared.segmentation.planes import floor_and_walls
from shared.types import Float, Float32

POINTS, CANDIDATES = 3072, 30_000
"""Points of a scan that the network is given, and random ones among which they are chosen."""
LEAST_POINTS = 64
NEIGHBOURS = 24
"""Points around each point whose local plane is fitted."""
EXTRA = 5
"""Inputs of a point beside its place: normal, roughness, and how far it is from the middle of its neighbours."""
ROUGHNESS_M, ASIDE_M = 0.005, 0.02
"""What roughness and distance are divided by."""


@dataclass(frozen=True, slots=True)
class SegmentationInput:
    """What the network is given of a scan.

    Attributes:
        points: [N, 3], frame of the network, furthest-point order; errors along the normal are averaged out.
        extra: [N, EXTRA].
        rows: [N], which points of the scan these are.
        left: [any], the points of the scan that are on neither floor nor wall.
    """

    points: Float32
    extra: Float32
    rows: NDArray[np.int64]
    left: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class NetworkFrame:
    """The transformation into the frame of the network.

    Attributes:
        origin: [3], in the frame of the points.
        rotation: [3, 3], about z.
    """

    origin: Float
    rotation: Float

    def place(self, points: Float) -> Float:
        """Points, [..., 3], in the frame of the network."""
        placed: Float = (points - self.origin) @ self.rotation.T
        return placed


def network_input(points: Float, camera: Float, seed: int = 0) -> tuple[SegmentationInput, NetworkFrame]:
    """The input of a scan.

    Args:
        points: [M, 3], z up.
        camera: [3], in the same frame.
        seed: of the random choices.

    Raises:
        UsageError: hardly anything is left beside floor and walls.
    """
    rng = seeds.generator(seed, "segmentation")
    planes, floor = floor_and_walls(points, camera, rng)
    left = np.flatnonzero(~planes)
    if len(left) < LEAST_POINTS:
        raise UsageError(
            f"the scan has {len(left)} points beside floor and walls, and at least {LEAST_POINTS} are needed; move the "
            "camera so that it sees the object"
        )
    middle = np.median(points[left], axis=0)
    ahead = (middle - camera)[:2] / max(float(np.linalg.norm((middle - camera)[:2])), 1e-9)
    rotation = np.array([[ahead[0], ahead[1], 0.0], [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
    frame = NetworkFrame(np.array([middle[0], middle[1], floor]), rotation)
    near = left if len(left) <= CANDIDATES else rng.choice(left, CANDIDATES, replace=False)
    placed = frame.place(points[near])
    kept = furthest_first(placed, POINTS, CANDIDATES, rng)
    smooth, extra = _described(placed, placed[kept], frame.place(camera))
    return SegmentationInput(smooth.astype(np.float32), extra.astype(np.float32), near[kept], left), frame


def _described(cloud: Float, points: Float, camera: Float) -> tuple[Float, Float]:
    """Points on their local planes, [N, 3], and their further inputs, [N, EXTRA]."""
    _, near = cKDTree(cloud).query(points, k=min(NEIGHBOURS, len(cloud)))
    middles = cloud[near].mean(axis=1)
    local = cloud[near] - middles[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local) / local.shape[1])
    normals = axes[:, :, 0]
    normals *= np.where(((camera - points) * normals).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    offsets = middles - points
    heights = (offsets * normals).sum(axis=1, keepdims=True)
    aside = np.linalg.norm(offsets - heights * normals, axis=1, keepdims=True)
    rough = np.sqrt(np.maximum(variances[:, :1], 0.0))
    return points + heights * normals, np.concatenate([normals, rough / ROUGHNESS_M, aside / ASIDE_M], axis=1)
