"""Furthest-point sampling (FPS) of a cloud: exact, in single precision, and the same to the last bit on every machine.

The points are sorted into a k-d tree of 32 leaves. A leaf is computed again only if a new sample may lie nearer to the
furthest point of that leaf than every sample before (bucket-based FPS: Han et al., QuickFPS, IEEE TCAD 2023). Of
several points that are equally far, the one that comes first in the tree is taken. Both are as in the function
`bucket_fps_kdline_sampling` of the package fpsample, which has no wheels for Python 3.13 and later. So stores that were
made with that package keep their digests.

Sums of floating-point numbers are neither reordered nor fused, so the result does not depend on the processor.

Shapes: N points, L leaves, K samples.
"""

import numpy as np
from numpy.typing import NDArray

from shared.compilation import compiled
from shared.types import Float32

TREE_HEIGHT = 5
"""The leaves are 2 to the power of this. It decides which of equally far points is taken, so it is part of the data."""

_FURTHEST = np.float32(np.finfo(np.float32).max)


def furthest_points(points: Float32, count: int) -> NDArray[np.int64]:
    """Indices, [count], of points that are each the furthest from those before, starting with the first in the tree.

    Args:
        points: [N, 3], finite.
        count: how many; 1 to N.
    """
    assert points.shape[1:] == (3,) and 0 < count <= len(points)
    order, bounds = _tree(np.ascontiguousarray(points, dtype=np.float32), TREE_HEIGHT)
    x, y, z = np.ascontiguousarray(points[order].T, dtype=np.float32)
    chosen: NDArray[np.int64] = order[_furthest(x, y, z, bounds, count)]
    return chosen


@compiled()
def _tree(points: Float32, height: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort points into leaves: their order, [N], and where in it each leaf begins, and the end, [L + 1]."""
    order = np.arange(len(points))
    bounds = np.zeros(2**height + 1, dtype=np.int64)
    # Nodes that are still to be looked at, the leftmost last: first, past the last, depth.
    nodes = np.empty((height + 2, 3), dtype=np.int64)
    nodes[0] = 0, len(points), 0
    waiting, leaves = 1, 0
    while waiting:
        waiting -= 1
        left, right, depth = nodes[waiting]
        if depth == height or right - left == 1:
            leaves += 1
            bounds[leaves] = right
        else:
            middle = _split(order, points, left, right)
            nodes[waiting] = middle, right, depth + 1
            nodes[waiting + 1] = left, middle, depth + 1
            waiting += 2
    return order, bounds[: leaves + 1]


@compiled()
def _split(order: NDArray[np.int64], points: Float32, left: int, right: int) -> int:
    """Divide `order[left:right]` at the mean of the widest axis; returns where the right half begins."""
    axis, widest = 0, np.float32(0)
    for candidate in range(3):
        low = high = points[order[left], candidate]
        for place in range(left, right):
            low = min(low, points[order[place], candidate])
            high = max(high, points[order[place], candidate])
        if high - low > widest:
            axis, widest = candidate, high - low
    total = np.float32(0)
    for place in range(left, right):
        total += points[order[place], axis]
    mean = total / np.float32(right - left)
    start, end = left, right - 1
    while True:
        while start <= end and points[order[start], axis] < mean:
            start += 1
        while start <= end and points[order[end], axis] >= mean:
            end -= 1
        if start > end:
            break
        order[start], order[end] = order[end], order[start]
        start += 1
        end -= 1
    # Neither half is empty, even where all points are in one place.
    return min(max(start, left + 1), right - 1)


@compiled()
def _furthest(x: Float32, y: Float32, z: Float32, bounds: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """The samples, [K], of points that stand leaf by leaf; coordinates [N] each, bounds [L + 1]."""
    leaves = len(bounds) - 1
    low, high = np.empty((3, leaves), dtype=np.float32), np.empty((3, leaves), dtype=np.float32)
    for axis, values in enumerate((x, y, z)):
        for leaf in range(leaves):
            low[axis, leaf] = high[axis, leaf] = values[bounds[leaf]]
            for place in range(bounds[leaf], bounds[leaf + 1]):
                low[axis, leaf] = min(low[axis, leaf], values[place])
                high[axis, leaf] = max(high[axis, leaf], values[place])
    squared = np.full(len(x), _FURTHEST, dtype=np.float32)  # Distance of each point to the nearest sample.
    furthest = bounds[:-1].copy()  # Of each leaf, the point with the greatest distance, and that distance.
    greatest = np.full(leaves, _FURTHEST, dtype=np.float32)
    postponed = np.empty((leaves, count), dtype=np.int64)  # Samples that a leaf has not been compared with yet.
    postponements = np.zeros(leaves, dtype=np.int64)
    chosen = np.empty(count, dtype=np.int64)
    for number in range(count):
        sample = furthest[np.argmax(greatest)] if number else 0
        chosen[number] = sample
        for leaf in range(leaves):
            across = x[furthest[leaf]] - x[sample], y[furthest[leaf]] - y[sample], z[furthest[leaf]] - z[sample]
            if across[0] * across[0] + across[1] * across[1] + across[2] * across[2] > greatest[leaf]:
                # The furthest point stays what it is. Others may be nearer to the sample, which can wait.
                gap_x = max(low[0, leaf] - x[sample], x[sample] - high[0, leaf], np.float32(0))
                gap_y = max(low[1, leaf] - y[sample], y[sample] - high[1, leaf], np.float32(0))
                gap_z = max(low[2, leaf] - z[sample], z[sample] - high[2, leaf], np.float32(0))
                if gap_x * gap_x + gap_y * gap_y + gap_z * gap_z < greatest[leaf]:
                    postponed[leaf, postponements[leaf]] = sample
                    postponements[leaf] += 1
                continue
            left, right = bounds[leaf], bounds[leaf + 1]
            for place in range(postponements[leaf]):
                _compare(x, y, z, squared, left, right, postponed[leaf, place])
            postponements[leaf] = 0
            greatest[leaf] = _compare(x, y, z, squared, left, right, sample)
            furthest[leaf] = left
            while squared[furthest[leaf]] != greatest[leaf]:
                furthest[leaf] += 1
    return chosen


# Finite numbers alone: so the greatest of several can be found by vector instructions. Rounding stays as it is.
@compiled(fastmath={"nnan", "nsz"})
def _compare(x: Float32, y: Float32, z: Float32, squared: Float32, left: int, right: int, sample: int) -> np.float32:
    """Lower the distances of the points of a leaf to one sample; returns the greatest that is left."""
    at_x, at_y, at_z = x[sample], y[sample], z[sample]
    greatest = np.float32(-1)
    for place in range(left, right):
        across_x, across_y, across_z = x[place] - at_x, y[place] - at_y, z[place] - at_z
        distance = across_x * across_x + across_y * across_y + across_z * across_z
        nearest = distance if distance < squared[place] else squared[place]
        squared[place] = nearest
        greatest = nearest if nearest > greatest else greatest
    return greatest
