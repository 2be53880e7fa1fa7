"""Depth cameras: what of an articulated object can be seen from one place, and the cloud that is kept of it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from collector.articulation import ArticulatedObject
from shared.configuration import CameraConfig
from shared.observation import furthest_first, round_normals, round_points
from shared.vocabulary import Float, Observation

NEAR, FAR = 0.1, 100.0
"""Published clipping distances."""


@dataclass(frozen=True, slots=True)
class DepthImage:
    """The pixels of one image that see the object.

    Attributes:
        pixels: [H], row * image width + column.
        depths: [H], distance along the camera's forward axis.
        points: [H, 3], world.
        normals: [H, 3], world, unit, facing the camera.
        bodies: [H], 0 for the root, k for the k-th part.
    """

    pixels: NDArray[np.uint32]
    depths: Float
    points: Float
    normals: Float
    bodies: NDArray[np.uint8]


class Camera(Protocol):
    """Anything that takes depth images of one object from one place."""

    world_from_camera: Float
    """[4, 4], x forward, y left, z up."""

    def capture(self, joint_positions: Float) -> DepthImage:
        """The image with the parts at `joint_positions`, [parts]."""
        ...


class EmbreeCamera:
    """Casts one ray a pixel on the CPU; needs no graphics driver.

    Args:
        target: the object.
        world_from_camera: [4, 4].
        config: image size and field of view.
    """

    def __init__(self, target: ArticulatedObject, world_from_camera: Float, config: CameraConfig) -> None:
        self.world_from_camera = world_from_camera
        self._object = target
        self._size = config.image_size
        self._focal = config.image_size / 2 / np.tan(np.deg2rad(config.field_of_view_deg) / 2)

    def capture(self, joint_positions: Float) -> DepthImage:
        """The image with the parts at `joint_positions`, [parts]."""
        scene, vertices = self._build(self._object.body_poses(joint_positions))
        pixels = self._pixels_around(vertices)
        directions = self._directions(pixels)
        origins = np.broadcast_to(self.world_from_camera[:3, 3], directions.shape)
        hits = scene.run(
            np.ascontiguousarray(origins, dtype=np.float32), directions.astype(np.float32), output=True, dists=None
        )
        depths = hits["tfar"].astype(np.float64)
        seen = (hits["geomID"] >= 0) & (depths > NEAR) & (depths < FAR)
        normals = hits["Ng"][seen].astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        directions, depths = directions[seen], depths[seen]
        normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
        return DepthImage(
            pixels=pixels[seen],
            depths=depths,
            points=self.world_from_camera[:3, 3] + directions * depths[:, None],
            normals=normals,
            bodies=hits["geomID"][seen].astype(np.uint8),
        )

    def _build(self, body_poses: Float) -> tuple[rtcore_scene.EmbreeScene, Float]:
        """An Embree scene with one geometry a body, and all its vertices [V, 3], world."""
        scene, everything = rtcore_scene.EmbreeScene(), []
        for body, world_from_body in zip(self._object.bodies, body_poses, strict=True):
            vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int32)], 0
            for mesh in body.visuals:
                vertices.append(mesh.vertices)
                faces.append(mesh.faces + count)
                count += len(mesh.vertices)
            world = np.concatenate(vertices) @ world_from_body[:3, :3].T + world_from_body[:3, 3]
            everything.append(world)
            triangles = np.concatenate(faces)
            if len(triangles) == 0:  # Embree numbers geometries by order, so a body without triangles keeps its place.
                world, triangles = np.full((3, 3), 1e6), np.array([[0, 1, 2]], dtype=np.int32)
            TriangleMesh(scene, world.astype(np.float32), triangles.astype(np.int32))
        return scene, np.concatenate(everything)

    def _pixels_around(self, vertices: Float) -> NDArray[np.uint32]:
        """Pixels inside the rectangle that holds the projections of all vertices."""
        camera_from_world = np.linalg.inv(self.world_from_camera)
        seen = vertices @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        ahead = np.maximum(seen[:, :1], NEAR)
        places = self._size / 2 - self._focal * seen[:, 1:] / ahead  # Columns grow to the right, rows downwards.
        low = np.clip(np.floor(places.min(axis=0)), 0, self._size).astype(int)
        high = np.clip(np.ceil(places.max(axis=0)), 0, self._size).astype(int)
        columns, rows = np.arange(low[0], high[0]), np.arange(low[1], high[1])
        return (rows[:, None] * self._size + columns[None, :]).ravel().astype(np.uint32)

    def _directions(self, pixels: NDArray[np.uint32]) -> Float:
        """Ray directions [P, 3], world, through pixel centres, of length 1 along the camera's forward axis."""
        rows, columns = np.divmod(pixels.astype(np.int64), self._size)
        left = (self._size / 2 - columns - 0.5) / self._focal
        up = (self._size / 2 - rows - 0.5) / self._focal
        return np.stack([np.ones_like(left), left, up], axis=1) @ self.world_from_camera[:3, :3].T


def observation_from(
    image: DepthImage,
    world_from_camera: Float,
    qualifying: tuple[int, ...],
    config: CameraConfig,
    rng: np.random.Generator,
) -> Observation | None:
    """The cloud that is kept of an image, in furthest-point order; None where no pixel sees the object.

    Args:
        image: what the camera saw.
        world_from_camera: [4, 4], where it stood.
        qualifying: parts (1-based) that the task may act on.
        config: how many points to keep, and of how many candidates.
        rng: draws the candidates.
    """
    if len(image.pixels) == 0:
        return None
    # A small object fills few pixels: then every one is kept, and some stand twice.
    kept = furthest_first(image.points, config.points, config.candidates, rng)
    bodies = image.bodies[kept]
    return Observation(
        points=round_points(image.points[kept]),
        normals=round_normals(image.normals[kept]),
        part_ids=bodies,
        movable=np.isin(bodies, np.array(qualifying, dtype=np.uint8)),
        pixels=image.pixels[kept],
        world_from_camera=world_from_camera,
    )
