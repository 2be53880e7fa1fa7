"""SAPIEN as this package uses it: CPU physics without a renderer, and links built from convex pieces.

Import SAPIEN from here: its own import warns where no system Vulkan is installed, which nothing here needs.
"""

import warnings
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from collector.objects.articulation import Mesh
from collector.sim.libx11 import without_x11
from shared.types import Float

with warnings.catch_warnings(), without_x11():
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

Link: TypeAlias = physx.PhysxArticulationLinkComponent
DENSITY = 1000.0
"""SAPIEN's default; only the shape of a link's inertia matters, since its mass is drawn."""

__all__ = [
    "DENSITY",
    "Assembly",
    "Link",
    "convex_shapes",
    "cooked",
    "half_spaces",
    "new_scene",
    "physx",
    "pose",
    "sapien",
    "set_mass",
]


def new_scene(solver_iterations: int) -> tuple[sapien.Scene, physx.PhysxCpuSystem]:
    """An empty scene with the published engine settings, and its physics system."""
    config = physx.PhysxSceneConfig()
    config.gravity = np.array([0.0, 0.0, -9.81], dtype=np.float32)
    config.enable_pcm = False
    config.enable_tgs = False
    config.enable_enhanced_determinism = True
    physx.set_scene_config(config)
    body = physx.PhysxBodyConfig()
    body.solver_position_iterations = solver_iterations
    body.solver_velocity_iterations = 1
    body.sleep_threshold = 0.0
    physx.set_body_config(body)
    system = physx.PhysxCpuSystem()
    return sapien.Scene([system]), system


def pose(matrix: Float) -> sapien.Pose:
    """A rigid matrix [4, 4] as SAPIEN's pose."""
    return sapien.Pose(matrix)


class Assembly:
    """Links of one articulation under construction; SAPIEN wants their entities kept alive until all are there.

    Example:
        assembly = Assembly(material)
        root = assembly.add(None, "root", meshes)
        assembly.add(root, "door", meshes, joint="revolute", ...)
        articulation = assembly.finish(scene)
    """

    def __init__(self, material: physx.PhysxMaterial) -> None:
        self._material = material
        self._entities: list[sapien.Entity] = []
        self.links: list[Link] = []

    def add(
        self,
        parent: Link | None,
        name: str,
        meshes: Sequence[Mesh],
        *,
        joint: str = "fixed",
        joint_name: str = "",
        parent_from_joint: Float | None = None,
        child_from_joint: Float | None = None,
        limits: tuple[float, float] = (0.0, 0.0),
        touches_own_kind: bool = True,
    ) -> Link:
        """Add one link.

        Args:
            parent: its parent link; None for the root.
            name: of the link.
            meshes: convex pieces; one that has no volume or cannot be cooked carries no collision.
            joint: "fixed", "revolute" or "prismatic"; SAPIEN's joints move about or along the joint frame's x. A root
                that is "undefined" floats.
            joint_name: of the joint.
            parent_from_joint: [4, 4], of the joint's frame in the parent; identity where None.
            child_from_joint: [4, 4], of the joint's frame in the link; identity where None.
            limits: of the joint position.
            touches_own_kind: whether it collides with other links for which this is false.
        """
        link = Link(parent)
        link.name = name
        for mesh in meshes:
            shape = _convex_shape(mesh, self._material)
            if shape is not None:
                # Shapes that share a bit of the third group and the number in the fourth ignore each other.
                shape.set_collision_groups([1, 1, 0, 0] if touches_own_kind else [1, 1, 1, 1])
                link.attach(shape)
        entity = sapien.Entity()
        entity.name = name
        entity.add_component(link)
        link.joint.name = joint_name
        link.joint.type = joint
        link.joint.pose_in_parent = pose(np.eye(4) if parent_from_joint is None else parent_from_joint)
        link.joint.pose_in_child = pose(np.eye(4) if child_from_joint is None else child_from_joint)
        # The engine's defaults add friction (0.05 of the load) and air drag; ours is a drive of known limit.
        link.joint.friction = 0.0
        link.linear_damping = link.angular_damping = 0.0
        if joint in ("revolute", "prismatic"):
            link.joint.limit = np.array([limits], dtype=np.float32)
        self._entities.append(entity)
        self.links.append(link)
        return link

    def finish(self, scene: sapien.Scene) -> physx.PhysxArticulation:
        """Put the articulation into a scene."""
        for entity in self._entities:
            scene.add_entity(entity)
        return self.links[0].articulation


def _convex_shape(mesh: Mesh, material: physx.PhysxMaterial) -> physx.PhysxCollisionShapeConvexMesh | None:
    """The convex hull of a mesh as a collision shape, or None where PhysX cannot make one."""
    try:
        shape = physx.PhysxCollisionShapeConvexMesh(
            vertices=mesh.vertices.astype(np.float32), scale=np.ones(3, dtype=np.float32), material=material
        )
    except RuntimeError:
        return None
    shape.set_density(DENSITY)
    return shape


def convex_shapes(link: Link) -> tuple[Mesh, ...]:
    """What a link collides as: its convex pieces, in its frame, with outward faces."""
    return tuple(_mesh(shape) for shape in link.collision_shapes)


def half_spaces(piece: Mesh) -> tuple[Float, Float]:
    """A convex piece as n . x <= d: outward normals [F, 3] of its faces and distances [F]."""
    corners = piece.vertices[piece.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], corners[lengths > 0]
    return normals, (normals * corners[:, 0]).sum(axis=1)


def set_mass(link: Link, mass: float) -> None:
    """Give a link a mass; its inertia keeps its shape and scales along."""
    if link.mass > 0:
        inertia = np.asarray(link.inertia, dtype=np.float64) * (mass / link.mass)
    else:
        inertia = np.full(3, mass * 1e-2)
    link.mass = mass
    link.inertia = np.maximum(inertia, 1e-8).astype(np.float32)


def cooked(mesh: Mesh) -> Mesh | None:
    """The convex piece that the engine makes of a mesh, with outward faces; None where it makes none."""
    shape = _convex_shape(mesh, physx.PhysxMaterial(0.0, 0.0, 0.0))
    return None if shape is None else _mesh(shape)


def _mesh(shape: physx.PhysxCollisionShapeConvexMesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.triangles, dtype=np.int32))
