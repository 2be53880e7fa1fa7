"""What a point of a raw scan can be of."""

from enum import IntEnum


class Kind(IntEnum):
    """The classes of the segmentation network."""

    BACKGROUND = 0
    """Floor, walls and other things."""
    BODY = 1
    """The static body of the object."""
    TURNING = 2
    """A part that turns: a door, a lid, a switch."""
    SLIDING = 3
    """A part that slides: a drawer, a button."""


MOVABLE = (Kind.TURNING, Kind.SLIDING)
