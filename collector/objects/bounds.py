"""Bounds on objects for the engine and the scene; beyond them it is slow, wrong, or crashes."""

from collections.abc import Sequence

import numpy as np

from collector.objects.articulation import Body, Joint, Mesh
from shared.errors import ObjectError
from shared.io.text import short

MAX_PARTS = 150
"""Published objects have fewer. The engine loses joints beyond 254, and time grows with the square of their number."""
MAX_DEPTH = 12
"""Moving joints between a part and the root. Chains of about 30 overlapping links end the process in the engine."""
MAX_SHAPE_PAIRS = 50_000
"""Collision shapes of different bodies, which the engine may have to test against each other at every step."""
MAX_REACH = 20.0
"""Distance from the root's origin that a vertex may come to. Published objects fit into a sphere of radius 1; the
hand waits at a height of 50, and must not be met there."""
MAX_LAYERS = 3000
"""Triangles that a camera's ray may have to be tested against, by the boxes around them as a share of that around a
published object. An image of 448 x 448 pixels takes a second of processor time for 750 layers; published objects have
up to 21."""
USUAL_HALF_SURFACE = 12.0
"""Of the box around a sphere of radius 1."""
MAX_ANGLE = 2 * np.pi
"""The engine wraps the positions of joints that turn further."""


def check_bounds(bodies: Sequence[Body]) -> None:
    """Refuse an object that is out of bounds.

    Args:
        bodies: the root, then the parts, parents before children.

    Raises:
        ObjectError: with one line that has the bound and the value.
    """
    parts = len(bodies) - 1
    if parts > MAX_PARTS:
        raise ObjectError(f"{parts} movable parts; at most {MAX_PARTS} are allowed")
    shapes = [len(body.collisions) for body in bodies]
    pairs = (sum(shapes) ** 2 - sum(count * count for count in shapes)) // 2
    if pairs > MAX_SHAPE_PAIRS:
        raise ObjectError(f"{pairs} pairs of collision shapes of different bodies; at most {MAX_SHAPE_PAIRS}")
    depths, origins = [0], [0.0]
    for body in bodies[1:]:
        assert body.joint is not None
        depths.append(depths[body.joint.parent] + 1)
        origins.append(origins[body.joint.parent] + _offset(body.joint))
        if depths[-1] > MAX_DEPTH:
            raise ObjectError(f"link {short(body.link)} hangs on {depths[-1]} moving joints; at most {MAX_DEPTH}")
    for body, origin in zip(bodies, origins, strict=True):
        reach = origin + _radius(body)
        if not reach <= MAX_REACH:
            raise ObjectError(
                f"link {short(body.link)} can be {reach:.3g} from the root's origin; at most {MAX_REACH:g} is allowed "
                "(published objects fit into a sphere of radius 1; scale meshes in millimetres by 0.001)"
            )
    layers = sum(_layers(mesh) for body in bodies for mesh in body.visuals)
    if layers > MAX_LAYERS:
        raise ObjectError(
            f"so many of its triangles overlap that a ray of the camera meets up to {layers:.0f}; at most {MAX_LAYERS} "
            "are allowed; simplify its meshes"
        )


def _layers(mesh: Mesh) -> float:
    """How many of the mesh's triangles a ray through a published object would meet if they were around its middle."""
    corners = [mesh.vertices[mesh.faces[:, k]] for k in range(3)]
    x, y, z = (np.maximum.reduce(corners) - np.minimum.reduce(corners)).T
    return float(np.minimum((x * y + y * z + z * x) / USUAL_HALF_SURFACE, 1.0).sum())


def _offset(joint: Joint) -> float:
    """How far the body's origin can be from its parent's, after checking the joint's limits."""
    farthest = max(abs(joint.lower), abs(joint.upper))
    if joint.kind == "prismatic":
        return float(np.linalg.norm(joint.parent_from_body[:3, 3])) + farthest
    if farthest > MAX_ANGLE:
        raise ObjectError(
            f"joint {short(joint.name)}: limits {joint.lower:.4g} to {joint.upper:.4g} are beyond one turn either way"
        )
    return float(np.linalg.norm(joint.parent_from_body[:3, 3]))


def _radius(body: Body) -> float:
    """The greatest distance of a vertex from the body's origin."""
    meshes = {id(mesh): mesh for mesh in (*body.visuals, *body.collisions)}.values()
    return max((float(np.linalg.norm(mesh.vertices, axis=1).max(initial=0.0)) for mesh in meshes), default=0.0)
