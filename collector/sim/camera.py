"""Depth cameras: what of an articulated object can be seen from one place, and the cloud that is kept of it.

`noisy` adds the errors of a real depth camera. The noise along the rays is that which Nguyen et al. (3DIMPVT 2012,
"Modeling Kinect sensor noise for improved 3D reconstruction and tracking") measured at one metre: 1.9 mm, and more
where the surface is seen at a slant. Such a camera also measures nothing where rays graze a surface, and beside an edge
it mixes two depths, or measures neither.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
from embreex import rtcore, rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject, Body
from shared.config import CameraConfig
from shared.depth import DepthMap
from shared.geometry import estimated_normals, facing, furthest_first
from shared.types import Float, Observation, round_normals, round_points

NEAR, FAR = 0.1, 100.0
"""Published clipping distances."""
SURROUNDINGS = 255
"""The number, in `DepthImage.bodies`, of what is not the object; objects have fewer bodies."""
LEVEL_M = 0.0019
SLANT_M = 0.0001
"""Standard deviation: LEVEL_M + SLANT_M a^2 / (pi/2 - a)^2 at an angle of incidence a, at a distance of one metre."""
MOST_SLANT_RAD = np.deg2rad(80.0)
GRAZING_RAD = np.deg2rad(75.0)
"""From here to a right angle, the share of rays that measure nothing grows from none to all."""
EDGE_M = 0.03
"""Neighbouring pixels whose depths differ by more are on two sides of an edge."""
EDGE_SHARE = 0.25
"""Of pixels beside an edge: so many measure nothing, and so many others a depth between the two."""


@dataclass(frozen=True, slots=True)
class DepthImage:
    """The pixels of one image that see the object.

    Attributes:
        pixels: [H], row * image width + column.
        depths: [H], distance along the camera's forward axis.
        points: [H, 3], world.
        normals: [H, 3], world, unit, facing the camera.
        bodies: [H], 0 for the root, k for the k-th part, `SURROUNDINGS` for what stands around the object.
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

    Each body has a scene of its own, in its own frame, which is built once for all states and cameras: the rays are
    moved instead of the body, and the nearest hit of all bodies counts.

    Args:
        target: the object.
        world_from_camera: [4, 4].
        config: image size and field of view.
        height: of the image, pixels, if it is not as high as wide; the field of view is then its horizontal one.
        surroundings: what stands around the object, in the world frame; it hides the object, and is seen.
    """

    def __init__(
        self,
        target: ArticulatedObject,
        world_from_camera: Float,
        config: CameraConfig,
        height: int | None = None,
        surroundings: Body | None = None,
    ) -> None:
        self.world_from_camera = world_from_camera
        self._object = target
        self._width, self._height = config.image_size, height or config.image_size
        self._focal = focal_length(config)
        if target not in _SCENES:
            _SCENES[target] = tuple(_BodyScene(body) for body in target.bodies)
        self._bodies = _SCENES[target]
        self._surroundings = None if surroundings is None else _BodyScene(surroundings)

    def capture(self, joint_positions: Float) -> DepthImage:
        """The image with the parts at `joint_positions`, [parts]."""
        return self.capture_bodies(self._object.body_poses(joint_positions))

    def capture_bodies(self, world_from_bodies: Float) -> DepthImage:
        """The image with the bodies, whatever joins them, at these poses, [bodies, 4, 4]."""
        count = self._width * self._height
        depths, normals, bodies = np.full(count, FAR), np.zeros((count, 3)), np.zeros(count, dtype=np.uint8)
        seen_bodies = list(enumerate(zip(self._bodies, world_from_bodies, strict=True)))
        if self._surroundings is not None:
            seen_bodies.append((SURROUNDINGS, (self._surroundings, np.eye(4))))
        for number, (body, world_from_body) in seen_bodies:
            body_from_camera = np.linalg.inv(world_from_body) @ self.world_from_camera
            pixels = self._pixels_around(body.vertices, body_from_camera)
            if len(pixels) == 0:
                continue
            depth, normal = body.cast(body_from_camera[:3, 3], self.directions(pixels) @ body_from_camera[:3, :3].T)
            nearer = (depth > NEAR) & (depth < depths[pixels])
            pixels = pixels[nearer]
            depths[pixels], bodies[pixels] = depth[nearer], number
            normals[pixels] = normal[nearer] @ world_from_body[:3, :3].T
        seen = np.flatnonzero(depths < FAR).astype(np.uint32)
        depths, normals = depths[seen], normals[seen]
        directions = self.directions(seen) @ self.world_from_camera[:3, :3].T
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
        return DepthImage(
            pixels=seen,
            depths=depths,
            points=self.world_from_camera[:3, 3] + directions * depths[:, None],
            normals=normals,
            bodies=bodies[seen],
        )

    def in_shadow(self, points: Float, towards: Float, world_from_bodies: Float) -> NDArray[np.bool_]:
        """Whether the bodies, at these poses, are between points, [P, 3], and a light far away, [3]; world."""
        shadow = np.zeros(len(points), dtype=np.bool_)
        for body, world_from_body in zip(self._bodies, world_from_bodies, strict=True):
            lit = np.flatnonzero(~shadow)
            rotation, origin = world_from_body[:3, :3], world_from_body[:3, 3]
            # Not `@`: on a busy machine, the threads of such long products wait for each other.
            starts = np.einsum("pi,ij->pj", points[lit] - origin, rotation)
            shadow[lit] = body.blocks(starts, towards @ rotation)
        return shadow

    def _pixels_around(self, vertices: Float, body_from_camera: Float) -> NDArray[np.uint32]:
        """Pixels inside the rectangle that holds the projections of all `vertices`, [V, 3], body frame."""
        if len(vertices) == 0:
            return np.zeros(0, dtype=np.uint32)
        seen = (vertices - body_from_camera[:3, 3]) @ body_from_camera[:3, :3]
        ahead = np.maximum(seen[:, :1], NEAR)
        size = np.array([self._width, self._height])
        places = size / 2 - self._focal * seen[:, 1:] / ahead  # Columns grow to the right, rows downwards.
        low = np.clip(np.floor(places.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(places.max(axis=0)), 0, size).astype(int)
        columns, rows = np.arange(low[0], high[0]), np.arange(low[1], high[1])
        return (rows[:, None] * self._width + columns[None, :]).ravel().astype(np.uint32)

    def directions(self, pixels: NDArray[np.uint32]) -> Float:
        """Ray directions [P, 3], camera frame, through pixel centres, of length 1 along the camera's forward axis."""
        rows, columns = np.divmod(pixels.astype(np.int64), self._width)
        left = (self._width / 2 - columns - 0.5) / self._focal
        up = (self._height / 2 - rows - 0.5) / self._focal
        return np.stack([np.ones_like(left), left, up], axis=1)


class _BodyScene:
    """What is visible of one body, in its own frame.

    Attributes:
        vertices: [V, 3], body frame; none where the body has no triangles.
    """

    def __init__(self, body: Body) -> None:
        vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int32)], 0
        for mesh in body.visuals:
            vertices.append(mesh.vertices)
            faces.append(mesh.faces + count)
            count += len(mesh.vertices)
        triangles = np.concatenate(faces)
        self.vertices = np.concatenate(vertices) if len(triangles) else np.zeros((0, 3))
        self._scene = rtcore_scene.EmbreeScene(_embree_device())
        if len(triangles):
            TriangleMesh(self._scene, self.vertices.astype(np.float32), triangles.astype(np.int32))

    def cast(self, origin: Float, directions: Float) -> tuple[Float, Float]:
        """Cast rays from one place.

        Args:
            origin: [3], body frame.
            directions: [P, 3], body frame.

        Returns:
            Depths [P], in lengths of the directions, infinite where nothing is hit; and normals [P, 3], body frame, of
            any length and to either side.
        """
        origins = np.broadcast_to(origin, directions.shape)
        hits = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            output=True,
            dists=None,
        )
        depths = np.where(hits["geomID"] >= 0, hits["tfar"].astype(np.float64), np.inf)
        return depths, hits["Ng"].astype(np.float64)

    def blocks(self, origins: Float, direction: Float) -> NDArray[np.bool_]:
        """Whether rays from `origins`, [P, 3], in one direction, [3], hit the body; body frame."""
        if len(self.vertices) == 0 or len(origins) == 0:
            return np.zeros(len(origins), dtype=np.bool_)
        directions = np.broadcast_to(direction, origins.shape)
        hits = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="OCCLUDED",
        )
        return np.asarray(hits) >= 0


@cache
def _embree_device() -> rtcore.EmbreeDevice:
    """The device of all scenes of this process: each device has threads of its own, and some 1,500 crash Embree."""
    return rtcore.EmbreeDevice()


_SCENES: WeakKeyDictionary[ArticulatedObject, tuple[_BodyScene, ...]] = WeakKeyDictionary()
"""Of the objects that somebody still holds."""


def observation_from(
    image: DepthImage,
    world_from_camera: Float,
    qualifying: tuple[int, ...],
    config: CameraConfig,
    rng: np.random.Generator,
) -> Observation | None:
    """The cloud that is kept of an image, in furthest-point order; None where no pixel sees the object.

    Of an image with errors the normals are estimated.

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
    bodies, points, normals = image.bodies[kept], image.points[kept], image.normals[kept]
    if config.noise:
        normals = facing(estimated_normals(image.points, points), points, world_from_camera[:3, 3])
    dense = None
    if config.keep_depth:
        dense = DepthMap.of(image.pixels, image.depths, config.image_size, focal_length(config), world_from_camera)
    return Observation(
        points=round_points(points),
        normals=round_normals(normals),
        part_ids=bodies,
        movable=np.isin(bodies, np.array(qualifying, dtype=np.uint8)),
        pixels=image.pixels[kept],
        world_from_camera=world_from_camera,
        dense=dense,
    )


def focal_length(config: CameraConfig) -> float:
    """Of a camera's images, pixels."""
    return float(config.image_size / 2 / np.tan(np.deg2rad(config.field_of_view_deg) / 2))


def noisy(image: DepthImage, image_size: int, camera: Float, strength: float, rng: np.random.Generator) -> DepthImage:
    """An image as a real depth camera might have taken it.

    Args:
        image: as it was rendered.
        image_size: width and height, pixels.
        camera: [3], where it stood, world.
        strength: factor of all errors; 0: none, 1: a structured-light camera at one metre.
        rng: draws the errors.

    Returns:
        The pixels that were measured. Normals remain those of the true surface.
    """
    if strength == 0 or len(image.pixels) == 0:
        return image
    rays = (image.points - camera) / image.depths[:, None]
    cosine = -(rays * image.normals).sum(axis=1) / np.linalg.norm(rays, axis=1)
    angle = np.arccos(np.clip(cosine, 0.0, 1.0))
    slant = np.minimum(angle, MOST_SLANT_RAD)
    deviation = strength * (LEVEL_M + SLANT_M * slant**2 / (np.pi / 2 - slant) ** 2)
    beyond, beside = _across_edges(image, image_size)
    drawn = rng.random(len(angle))
    share = min(EDGE_SHARE * strength, 0.5)
    lost = beside & (drawn < share)
    lost |= rng.random(len(angle)) < strength * (angle - GRAZING_RAD) / (np.pi / 2 - GRAZING_RAD)
    mixed = beside & (drawn >= share) & (drawn < 2 * share)
    depths = image.depths + np.where(mixed, rng.random(len(angle)) * (beyond - image.depths), 0.0)
    depths = np.maximum(depths + deviation * rng.standard_normal(len(angle)), 1e-3)[~lost]
    return replace(
        image,
        pixels=image.pixels[~lost],
        depths=depths,
        points=camera + rays[~lost] * depths[:, None],
        normals=image.normals[~lost],
        bodies=image.bodies[~lost],
    )


def _across_edges(image: DepthImage, size: int) -> tuple[Float, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Of each pixel the depth of the neighbour that differs the most, [H], and whether that is across an edge, [H]."""
    padded = np.full((size + 2, size + 2), np.nan)
    rows, columns = np.divmod(image.pixels.astype(np.int64), size)
    padded[rows + 1, columns + 1] = image.depths
    near = np.stack([padded[rows + 1 + dy, columns + 1 + dx] for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))])
    apart = np.nan_to_num(np.abs(near - image.depths), nan=-1.0)
    chosen = apart.argmax(axis=0)
    most = np.take_along_axis(apart, chosen[None], axis=0)[0]
    beyond = np.where(most >= 0, np.take_along_axis(near, chosen[None], axis=0)[0], image.depths)
    # Beside the silhouette there is nothing to mix with, but a ray may be lost.
    return beyond, (most > EDGE_M) | np.isnan(near).any(axis=0)
