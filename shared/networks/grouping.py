"""Neighbour indices of a cloud, which never change: computed once and kept beside it.

Clouds come in furthest-point order, so that the centres of PointNet++'s set abstractions are simply their first points.

Shapes: N points, n centres of a level, m points of the next finer level, k neighbours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from shared.networks.network_config import NetworkConfig
from shared.types import Float32

INTERPOLATED = 3
"""Coarse points that a fine point's feature is interpolated from (PointNet++)."""
MAX_POINTS = np.iinfo(np.int16).max

Indices = NDArray[np.int16]


@dataclass(frozen=True, slots=True)
class Grouping:
    """Which points each level of PointNet++ looks at, from fine to coarse.

    Attributes:
        neighbours: for each level [n, k], indices into the next finer level (the cloud itself, for the first).
        nearest: for each level [m, 3], indices of the centres nearest to each point of the next finer level.
    """

    neighbours: tuple[Indices, ...]
    nearest: tuple[Indices, ...]


def group_cloud(points: Float32, config: NetworkConfig) -> Grouping:
    """Neighbour indices of one cloud.

    Deviation from PointNet++: the k *nearest* points within the radius stand in for the first k that are found there,
    so that the result does not depend on the order of the points. Missing neighbours repeat the nearest, the centre
    itself, which leaves the maximum over the neighbourhood as it is.

    Args:
        points: [N, 3], in furthest-point order.
        config: the sizes; levels larger than the cloud shrink to it.

    Raises:
        ValueError: the cloud is too large for 16-bit indices, empty, or holds a number that is not finite.
    """
    if not 0 < len(points) <= MAX_POINTS:
        raise ValueError(f"a cloud must hold 1 to {MAX_POINTS} points; given {len(points)}")
    if not np.isfinite(points).all():
        raise ValueError("a cloud must hold finite points only")
    neighbours, nearest, fine = [], [], points
    for count, radius in zip(config.centres, config.radii, strict=True):
        centres = fine[: min(count, len(fine))]
        neighbours.append(_within(fine, centres, config.neighbours, radius))
        nearest.append(_nearest(centres, fine))
        fine = centres
    return Grouping(tuple(neighbours), tuple(nearest))


def nearest_points(tree: cKDTree, asked: Float32, count: int) -> NDArray[np.int64]:
    """The `count` nearest of the cloud in a tree to each of some places, [Q, count]; too few repeat the farthest.

    The same as `shared.networks.pointnet2.surroundings` finds for single points of many clouds.
    """
    if not count:
        return np.zeros((len(asked), 0), dtype=np.int64)
    ranks = np.arange(1, min(count, tree.n) + 1)
    found = np.asarray(tree.query(asked, k=ranks)[1])
    return np.pad(found, ((0, 0), (0, count - len(ranks))), mode="edge")


def _within(points: Float32, centres: Float32, count: int, radius: float) -> Indices:
    """The `count` nearest of `points` within `radius` of each centre, [n, count]."""
    _, found = cKDTree(points).query(centres, k=np.arange(1, count + 1), distance_upper_bound=radius)
    return np.where(found == len(points), np.arange(len(centres))[:, None], found).astype(np.int16)


def _nearest(centres: Float32, points: Float32) -> Indices:
    """The three of `centres` nearest to each point, [m, 3]; where there are fewer, the nearest again."""
    found = np.asarray(cKDTree(centres).query(points, k=np.arange(1, INTERPOLATED + 1))[1])
    return np.where(found == len(centres), found[:, :1], found).astype(np.int16)
