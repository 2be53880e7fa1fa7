"""The simplest articulated objects, made of boxes, whose right answers are known by hand."""

from dataclasses import replace

import numpy as np

from collector.objects.articulation import ArticulatedObject, Body, Joint, Mesh
from shared.plan import ObjectRef
from shared.types import Float

_FACES = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ],
    dtype=np.int32,
)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """A box between two corners."""
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return Mesh(corners, _FACES)


def _translation(x: float, y: float, z: float) -> Float:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def door(*, hinge: float = 0.3, lower: float = 0.0, upper: float = 1.5, overhang: float = 0.05) -> ArticulatedObject:
    """A slab of 0.6 x 0.6 in the plane x = -0.3, hung at y = `hinge`, before a smaller carcass; it opens towards -x.

    Args:
        hinge: 0.3 or -0.3, the side that it hangs on.
        lower: joint limit.
        upper: joint limit.
        overhang: how far the slab stands out beyond the carcass.
    """
    side = np.sign(hinge)
    inner = 0.3 - overhang
    slab = box((-0.02, min(0.0, -2 * hinge), -0.3), (0.0, max(0.0, -2 * hinge), 0.3))
    carcass = box((-0.25, -inner, -inner), (0.3, inner, inner))
    joint = Joint("hinge", "revolute", 0, _translation(-0.3, hinge, 0.0), np.array([0.0, 0.0, -side]), lower, upper)
    return base_with(carcass, Body("slab", "rotation_door", joint, (slab,), (slab,)))


def drawer() -> ArticulatedObject:
    """A block of 0.4 x 0.4 x 0.4 that slides along +x from x = 0, without anything in its way."""
    block = box((0.0, -0.2, -0.2), (0.4, 0.2, 0.2))
    joint = Joint("slide", "prismatic", 0, np.eye(4), np.array([1.0, 0.0, 0.0]), 0.0, 0.5)
    return base_with(box((0.0, 1.0, 0.0), (0.1, 1.1, 0.1)), Body("block", "drawer", joint, (block,), (block,)))


def latched_door() -> ArticulatedObject:
    """The door of `door`, a lever on it that turns by up to 1 rad, and below it a button that goes in by up to 0.02."""
    base, slab = door().bodies
    lever = box((-0.06, -0.04, -0.04), (0.0, 0.1, 0.04))
    turn = Joint("turn", "revolute", 1, _translation(-0.03, -0.5, 0.0), np.array([1.0, 0.0, 0.0]), 0.0, 1.0)
    button = box((-0.04, -0.05, -0.05), (0.0, 0.05, 0.05))
    press = Joint("press", "prismatic", 0, _translation(-0.3, 0.0, -0.5), np.array([1.0, 0.0, 0.0]), 0.0, 0.02)
    handles = (Body("lever", "lever", turn, (lever,), (lever,)), Body("button", "button", press, (button,), (button,)))
    return replace(base_with(base.visuals[0], slab), bodies=(base, slab, *handles))


def base_with(root: Mesh, part: Body) -> ArticulatedObject:
    body = Body("base", "furniture_body", None, (root,), (root,))
    return ArticulatedObject(
        ObjectRef(id="hand-made", category="StorageFurniture", content_hash="0" * 64), (body, part)
    )
