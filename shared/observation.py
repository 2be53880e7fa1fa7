"""Selection, normals and rounding of the points of a cloud, so that a proposer sees exactly what the learner will read.

Points are kept as float16 (about 0.5 mm at 1 unit), normals as three signed bytes of 1/127 (within half a degree).
Shapes: N points; any leading shape will do.
"""

import numpy as np
from numpy.typing import NDArray

from shared.types import Float, Float32

NORMAL_STEPS = 127
NORMAL_NEIGHBOURS = 16


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


def estimated_normals(cloud: Float, points: Float) -> Float:
    """Normals of a measured surface: of the planes through the nearest points, [N, 3], of either sign.

    Args:
        cloud: [M, 3], all that was measured.
        points: [N, 3], where.
    """
    from scipy.spatial import cKDTree

    _, near = cKDTree(cloud).query(points, k=min(NORMAL_NEIGHBOURS, len(cloud)))
    near = near.reshape(len(points), -1)
    local = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    normals: Float = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    return normals


def facing(normals: Float, points: Float, camera: Float) -> Float:
    """Unit normals, [N, 3], that face a camera, [3], from `points`, [N, 3]."""
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    towards = (normals * (camera - points)).sum(axis=1, keepdims=True)
    turned: Float = np.where(towards < 0, -normals, normals)
    return turned


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
