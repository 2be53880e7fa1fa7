"""Selection and rounding of the points of a cloud, so that a proposer sees exactly what the learner will read.

Points are kept as float16 (about 0.5 mm at 1 unit), normals as three signed bytes of 1/127 (within half a degree).
Shapes: N points; any leading shape will do.
"""

import numpy as np
from numpy.typing import NDArray

from shared.types import Float, Float32

NORMAL_STEPS = 127


def furthest_first(points: Float | Float32, count: int, candidates: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of selected points in furthest-point order, so that any prefix covers the cloud.

    Args:
        points: [M, 3], at least one.
        count: number of selected points; if there are fewer points, some occur twice.
        candidates: number of random points among which the furthest are searched.
        rng: draws the candidates.

    Returns:
        [count].
    """
    # Here, because Numba takes a third of a second to import and only those who observe need it.
    from shared.policies.furthest_points import furthest_points

    chosen = np.arange(len(points))
    if len(points) > candidates:
        chosen = rng.choice(len(points), candidates, replace=False)
    elif len(points) < count:
        chosen = np.concatenate([chosen, rng.integers(len(points), size=count - len(points))])
    kept: NDArray[np.int64] = chosen[furthest_points(points[chosen].astype(np.float32), count)]
    return kept


def round_points(points: Float | Float32) -> Float32:
    """Points, [..., 3], rounded to float16."""
    return points.astype(np.float16).astype(np.float32)


def round_normals(normals: Float | Float32) -> Float32:
    """Unit normals, [..., 3], with each component at the nearest multiple of 1/127."""
    return unpack_normals(pack_normals(normals))


def pack_normals(normals: Float | Float32) -> NDArray[np.int8]:
    """Unit normals, [..., 3], as signed bytes."""
    packed: NDArray[np.int8] = np.rint(np.clip(normals, -1.0, 1.0) * NORMAL_STEPS).astype(np.int8)
    return packed


def unpack_normals(packed: NDArray[np.int8]) -> Float32:
    """The normals, [..., 3], that `pack_normals` kept."""
    return packed.astype(np.float32) / np.float32(NORMAL_STEPS)
