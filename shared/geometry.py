"""Frames and rotations, and clouds. Matrices are written target_from_source and act on columns.

The *view* frame is where networks work: the world turned about z so that the camera looks along +x, origin kept at the
object's. It keeps gravity pointing down and forgets the azimuth, which carries no information.
"""

import numpy as np
from numpy.typing import NDArray

from shared.types import Float, Float32, Observation

NORMAL_NEIGHBOURS = 16


def camera_pose(azimuth_deg: float, elevation_deg: float, distance: float) -> Float:
    """world_from_camera, [4, 4], of a camera that looks at the origin: x forward, y left, z up.

    Args:
        azimuth_deg: of the camera's place about z, from +x.
        elevation_deg: of the camera's place above the horizon, in (-90, 90).
        distance: from the origin.
    """
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    place = distance * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    forward = -place / np.linalg.norm(place)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = forward, left, np.cross(forward, left), place
    return pose


def rotation_about_z(angle: float) -> Float:
    """The rotation [3, 3] by an angle, rad, about z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def view_from_world(world_from_camera: Float) -> Float:
    """The rotation [3, 3] into the view frame of a camera.

    If the camera looks straight down, its *up* direction replaces forward.
    """
    forward = world_from_camera[:3, 0]
    if np.hypot(forward[0], forward[1]) < 1e-6:
        forward = world_from_camera[:3, 2]
    cos, sin = forward[:2] / np.hypot(forward[0], forward[1])
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def points_in_view(observation: Observation) -> NDArray[np.float32]:
    """The observation's cloud in the view frame, [N, 3]."""
    rotation = view_from_world(observation.world_from_camera)
    return (observation.points @ rotation.T.astype(np.float32)).astype(np.float32)


def cross(a: Float, b: Float) -> Float:
    """The cross product of two vectors, [3] each; the bits of `numpy.cross`, in a tenth of its time."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def gripper_rotation(approach: Float, roll_reference: Float) -> Float:
    """R = [forward, left, up], [3, 3], with *up* the approach direction.

    Args:
        approach: [3], unit.
        roll_reference: [3], any vector not parallel to `approach`; *forward* is its part normal to `approach`.
    """
    left = cross(approach, roll_reference)
    left /= np.linalg.norm(left)
    return np.stack([cross(left, approach), left, approach], axis=1)


def quaternion_from_rotation(rotation: Float) -> Float:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix [3, 3]."""
    m = rotation
    # Bar-Itzhack: the dominant eigenvector is stable for every rotation, unlike the four-case formulas.
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    quaternion = np.linalg.eigh(k)[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion


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
