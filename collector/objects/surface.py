"""Points of the surface of an object, as obstacles of an arm."""

from functools import lru_cache

import numpy as np

from collector.objects.articulation import ArticulatedObject, Mesh
from shared.types import Float

POINTS = 4096
"""Of a whole object: a point every few centimetres, closer than the links of an arm are thick."""


def surface_at(target: ArticulatedObject, joint_positions: Float) -> Float:
    """Points of an object's visible surface, [POINTS, 3], world frame, at joint positions, [parts]."""
    poses = target.body_poses(joint_positions)
    return np.concatenate(
        [points @ pose[:3, :3].T + pose[:3, 3] for points, pose in zip(_samples(target), poses, strict=True)]
    )


@lru_cache(maxsize=4)
def _samples(target: ArticulatedObject) -> tuple[Float, ...]:
    """Points of each body, in its frame, as many as its share of the area; always the same ones."""
    triangles = [_triangles(body.visuals or body.collisions) for body in target.bodies]
    areas = [np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) for t in triangles]
    rng = np.random.default_rng(0)
    cumulated = np.cumsum(np.concatenate(areas))
    chosen = np.searchsorted(cumulated, rng.uniform(0, cumulated[-1], POINTS), side="right").clip(0, len(cumulated) - 1)
    corner, edge = rng.uniform(size=(2, POINTS, 1))
    a, b, c = np.concatenate(triangles)[chosen].transpose(1, 0, 2)
    points = (1 - np.sqrt(corner)) * a + np.sqrt(corner) * ((1 - edge) * b + edge * c)
    of_body = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])[chosen]
    return tuple(points[of_body == body] for body in range(len(triangles)))


def _triangles(meshes: tuple[Mesh, ...]) -> Float:
    """The corners of the triangles of some meshes, [F, 3, 3]."""
    return np.concatenate([np.empty((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)])
