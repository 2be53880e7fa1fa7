"""SAPIEN's own renderer as a depth camera, where a Vulkan device exists; Embree's is the default and needs none."""

from functools import cache

import numpy as np

from collector.objects.articulation import ArticulatedObject, Body
from collector.sim import libx11
from collector.sim.camera import FAR, NEAR, DepthImage
from collector.sim.engine import pose, sapien
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.types import Float

SHADERS = "minimal"
"""SAPIEN's set that renders positions, normals and ids without any lighting."""
HOW_TO_GET_ONE = (
    "a software device will do: on Debian, mesa-vulkan-drivers (24.3 or newer, from backports) and libvulkan1"
)


@cache
def why_unavailable() -> str:
    """Why SAPIEN cannot render on this machine, in one line; "" if it can."""
    if not libx11.is_installed():
        return "no library libX11.so.6, which SAPIEN's renderer calls; on Debian, libx11-6"
    try:
        sapien.render.RenderSystem()
    except RuntimeError as error:
        return f"no Vulkan device ({' '.join(str(error).split())}); {HOW_TO_GET_ONE}"
    return ""


class SapienCamera:
    """Rasterises the object by Vulkan; implements `collector.sim.camera.Camera`.

    Args:
        target: the object.
        world_from_camera: [4, 4].
        config: image size and field of view.

    Raises:
        UsageError: this machine has no Vulkan device.
    """

    def __init__(self, target: ArticulatedObject, world_from_camera: Float, config: CameraConfig) -> None:
        if problem := why_unavailable():
            raise UsageError(f"camera.renderer 'sapien': {problem}; or set it to 'embree'")
        self.world_from_camera = world_from_camera
        self._object = target
        self._scene = sapien.Scene([sapien.render.RenderSystem()])
        self._entities = [self._entity(body) for body in target.bodies]
        self._camera = self._eye(config)

    def capture(self, joint_positions: Float) -> DepthImage:
        """The image with the parts at `joint_positions`, [parts]."""
        for entity, world_from_body in zip(self._entities, self._object.body_poses(joint_positions), strict=True):
            entity.set_pose(pose(world_from_body))
        self._scene.update_render()
        self._camera.take_picture()
        ids = self._camera.get_picture("Segmentation")[..., 1].ravel()
        places = self._camera.get_picture("Position").reshape(-1, 4)[:, :3].astype(np.float64)
        normals = self._camera.get_picture("Normal").reshape(-1, 4)[:, :3].astype(np.float64)
        depths = -places[:, 2]
        pixels = np.flatnonzero((ids > 0) & (depths > NEAR) & (depths < FAR))
        # The renderer's camera looks along -z with y up; ours along x with z up.
        points, normals = (values[pixels][:, [2, 0, 1]] * [-1.0, -1.0, 1.0] for values in (places, normals))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        normals *= -np.sign((normals * points).sum(axis=1, keepdims=True))
        rotation, centre = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        body_of_id = np.zeros(max(entity.per_scene_id for entity in self._entities) + 1, dtype=np.uint8)
        body_of_id[[entity.per_scene_id for entity in self._entities]] = np.arange(len(self._entities))
        return DepthImage(
            pixels=pixels.astype(np.uint32),
            depths=depths[pixels],
            points=centre + points @ rotation.T,
            normals=normals @ rotation.T,
            bodies=body_of_id[ids[pixels]],
        )

    def _entity(self, body: Body) -> sapien.Entity:
        """A body as the renderer draws it, in its own frame."""
        entity, drawn = sapien.Entity(), sapien.render.RenderBodyComponent()
        material = sapien.render.RenderMaterial()
        for mesh in body.visuals:
            corners = mesh.vertices[mesh.faces]
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            size = np.linalg.norm(across, axis=1, keepdims=True)
            corners, normals = corners[size[:, 0] > 0], (across / np.maximum(size, 1e-300))[size[:, 0] > 0]
            if len(corners) == 0:
                continue
            # Triangles are seen from both sides, as rays see them; each has its own corners, so that it is flat.
            both = np.concatenate([corners, corners[:, ::-1]]).reshape(-1, 3)
            facing = np.repeat(np.concatenate([normals, -normals]), 3, axis=0)
            drawn.attach(
                sapien.render.RenderShapeTriangleMesh(
                    both.astype(np.float32),
                    np.arange(len(both), dtype=np.uint32).reshape(-1, 3),
                    facing.astype(np.float32),
                    np.zeros((len(both), 2), dtype=np.float32),
                    material,
                )
            )
        entity.add_component(drawn)
        self._scene.add_entity(entity)
        return entity

    def _eye(self, config: CameraConfig) -> "sapien.render.RenderCameraComponent":
        before = sapien.render.get_camera_shader_dir()
        sapien.render.set_camera_shader_dir(SHADERS)
        try:
            camera = sapien.render.RenderCameraComponent(config.image_size, config.image_size)
        finally:
            sapien.render.set_camera_shader_dir(before)
        camera.set_fovy(float(np.deg2rad(config.field_of_view_deg)), True)
        camera.near, camera.far = NEAR, FAR
        entity = sapien.Entity()
        entity.add_component(camera)
        entity.set_pose(pose(self.world_from_camera))
        self._scene.add_entity(entity)
        return camera
