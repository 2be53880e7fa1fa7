"""Where an imported object stands: its front towards -x, up towards z, centred at the origin, and of the usual size."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from collector.objects.articulation import ends_at_zero
from collector.objects.model import ObjectModel, bounding_box, transformed
from shared.errors import ObjectError, UsageError
from shared.io.text import short
from shared.types import Float

Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
USUAL_SIZE = 2.0
"""Diagonal of the bounding box of published objects, at joint position 0."""
AS_IT_IS: Direction = "-x"
"""The direction that the front of our own objects has."""


@dataclass(frozen=True, slots=True)
class Placement:
    """How a file's frame becomes ours.

    Attributes:
        front: the direction in the file's frame that the object's front faces.
        up: the direction that is up.
        scale: by which lengths are multiplied; None: `size` decides.
        size: diagonal of the object's bounding box afterwards, at joint position 0.
    """

    front: Direction = AS_IT_IS
    up: Direction = "+z"
    scale: float | None = None
    size: float = USUAL_SIZE

    def rotation(self) -> Float:
        """[3, 3], ours from the file's.

        Raises:
            UsageError: front and up are along one axis.
        """
        front, up = _vector(self.front), _vector(self.up)
        if front @ up:
            raise UsageError(f"--front {self.front} and --up {self.up} are along one axis; name two different axes")
        theirs = np.stack([front, up, np.cross(up, front)], axis=1)
        ours = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
        rotation: Float = ours @ theirs.T
        return rotation


def settled(model: ObjectModel, placement: Placement) -> ObjectModel:
    """`model` where `placement` puts it.

    Raises:
        ObjectError: it has no extent.
        UsageError: see `Placement.rotation`.
    """
    low, high = bounding_box(model)
    diagonal = float(np.linalg.norm(high - low))
    if not diagonal > 0:
        raise ObjectError("it has no shape that can be seen")
    scale = placement.size / diagonal if placement.scale is None else placement.scale
    return transformed(model, placement.rotation(), scale, (low + high) / 2)


def opening_upwards(model: ObjectModel) -> tuple[ObjectModel, list[str]]:
    """`model` in which joints that the file closes at their upper limit close at their lower one; and which these are.

    Our tasks take the lower limit of a door as closed. A joint from -2 to 0 becomes one from 0 to 2 about the opposite
    axis, which is the same motion.
    """
    parts, turned = [], []
    for part in model.parts:
        if ends_at_zero(part.lower, part.upper):
            turned.append(short(part.name))
            x, y, z = part.axis
            part = replace(part, axis=(-x, -y, -z), lower=0.0, upper=-part.lower)
        parts.append(part)
    return replace(model, parts=tuple(parts)), turned


def _vector(direction: Direction) -> Float:
    assert direction in get_args(Direction)
    vector = np.zeros(3)
    vector["xyz".index(direction[1])] = 1.0 if direction[0] == "+" else -1.0
    return vector
