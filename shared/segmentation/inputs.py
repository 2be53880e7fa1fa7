"""What the segmentation network is given of a raw scan: what is left without floor and walls, thinned and described.

Floor and walls are large planes with nothing behind them (RANSAC).

The frame of the network has z up and x away from the camera; its origin is on the floor, in the middle of what is left.
Shapes: M points of a scan, N points that the network is given.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from shared import seeds
from shared.errors import UsageError
from shared.geometry import furthest_first
from shared.types import Float, Float32

TOLERANCE_M = 0.015
"""What is so near a plane is on it; a depth camera errs by some millimetres."""
HYPOTHESES, SAMPLE = 600, 2500
"""Planes through three random points, and the random points on which they are judged."""
MOST_TILT = 0.17
"""A floor is level and a wall upright within asin of this, 10 deg."""
BEHIND = 0.06
"""The largest share of the points behind a floor or wall: what is seen over a wall, and what was measured wrongly."""
LEAST_SHARE = 0.04
"""The smallest share of the points on a floor or wall."""
LEAST_WIDTH = 0.5
"""A wall is at least as wide as this share of the scan, floor included; fronts of objects are narrower."""
MOST_WALLS = 2
_PLANES_AT_ONCE = 32
CONSIDERED = 20
"""The hypotheses with the most points, of which the first that is wide enough is the wall."""


def floor_and_walls(points: Float, camera: Float, rng: np.random.Generator) -> tuple[NDArray[np.bool_], float]:
    """Which points are on, below or behind the floor and the walls.

    Args:
        points: [M, 3], z up.
        camera: [3], in the same frame.
        rng: draws hypotheses.

    Returns:
        [M], whether a point belongs to the floor or to a wall; and the height of the floor below the other points, or
        the lowest height where there is no floor.
    """
    left = np.ones(len(points), dtype=bool)
    floor = _plane(points, points, camera, rng, upright=False)
    if floor is None:
        return ~left, float(points[:, 2].min())
    normal, offset = floor
    left &= points @ normal - offset > TOLERANCE_M
    if not left.any():
        return ~left, offset
    for _ in range(MOST_WALLS):
        wall = _plane(points[left], points, camera, rng, upright=True)
        if wall is None:
            break
        behind = points @ wall[0] - wall[1] <= TOLERANCE_M
        if (left & behind).sum() == left.sum():
            break
        left &= ~behind
    middle = np.median(points[left], axis=0)
    return ~left, float((offset - normal[:2] @ middle[:2]) / normal[2])


def _plane(
    points: Float, scan: Float, camera: Float, rng: np.random.Generator, *, upright: bool
) -> tuple[Float, float] | None:
    """The floor of a scan, or a wall: its normal, [3], towards the camera, and its offset; None where there is none."""
    if len(points) < 3:
        return None
    sample = points[rng.integers(len(points), size=min(SAMPLE, len(points)))]
    corners = sample[rng.integers(len(sample), size=(HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= lengths[:, None]
        steep = np.abs(normals[:, 2])
        fits = (lengths > 1e-6) & ((steep < MOST_TILT) if upright else (steep > np.sqrt(1 - MOST_TILT**2)))
    normals, corners = normals[fits], corners[fits, 0]
    normals *= np.sign((normals * (camera - corners)).sum(axis=1, keepdims=True))
    offsets = (normals * corners).sum(axis=1)
    on, behind = _shares(sample, normals, offsets)
    on = np.where((behind <= BEHIND) & (on >= LEAST_SHARE), on, 0.0)
    best = None
    for number in np.argsort(-on)[: CONSIDERED if upright else 1]:
        if on[number] > 0 and (not upright or _is_wide(normals[number], offsets[number], sample, scan, rng)):
            best = int(number)
            break
    if best is None:
        return None
    normal, corner = normals[best], corners[best]
    for _ in range(2):
        near = points[np.abs(points @ normal - corner @ normal) <= TOLERANCE_M]
        corner = near.mean(axis=0)
        around = near - corner
        fitted: Float = np.linalg.eigh(around.T @ around)[1][:, 0]
        normal = fitted * np.sign(fitted @ normal)
    return normal, float(normal @ corner)


def _shares(sample: Float, normals: Float, offsets: Float) -> tuple[Float, Float]:
    """The shares of a sample, [S, 3], that are on each of some planes, and behind it, [P]."""
    on, behind = np.zeros(len(normals)), np.zeros(len(normals))
    # So few planes at a time that their heights stay in the cache of the processor.
    for start in range(0, len(normals), _PLANES_AT_ONCE):
        some = slice(start, start + _PLANES_AT_ONCE)
        heights = normals[some] @ sample.T - offsets[some, None]
        behind[some] = np.count_nonzero(heights < -2 * TOLERANCE_M, axis=1)
        on[some] = np.count_nonzero(np.abs(heights, out=heights) <= TOLERANCE_M, axis=1)
    return on / len(sample), behind / len(sample)


def _is_wide(normal: Float, offset: float, sample: Float, scan: Float, rng: np.random.Generator) -> bool:
    """Whether an upright plane is as wide as a wall.

    Args:
        normal: [3], of the plane.
        offset: of it along the normal.
        sample: [S, 3], points on the plane and elsewhere.
        scan: [M, 3].
        rng: draws the points of the scan that say how wide it is.
    """
    along = np.array([-normal[1], normal[0]])
    room = scan[rng.integers(len(scan), size=SAMPLE), :2] @ along
    on = np.abs(sample @ normal - offset) <= TOLERANCE_M
    width = np.ptp(np.percentile(sample[on, :2] @ along, [1, 99]))
    return bool(width >= LEAST_WIDTH * np.ptp(np.percentile(room, [1, 99])))


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

    def back(self, points: Float) -> Float:
        """Points of the frame of the network, [..., 3], in the frame that they came from."""
        found: Float = points @ self.rotation + self.origin
        return found


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
    _, near = cKDTree(cloud, balanced_tree=False).query(points, k=min(NEIGHBOURS, len(cloud)), workers=-1)
    middles = cloud[near].mean(axis=1)
    local = cloud[near] - middles[:, None]
    variances, axes = np.linalg.eigh(local.transpose(0, 2, 1) @ local / local.shape[1])
    normals = axes[:, :, 0]
    normals *= np.where(((camera - points) * normals).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    offsets = middles - points
    heights = (offsets * normals).sum(axis=1, keepdims=True)
    aside = np.linalg.norm(offsets - heights * normals, axis=1, keepdims=True)
    rough = np.sqrt(np.maximum(variances[:, :1], 0.0))
    return points + heights * normals, np.concatenate([normals, rough / ROUGHNESS_M, aside / ASIDE_M], axis=1)
