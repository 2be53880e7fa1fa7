"""What each version of the timing `fast` does not simulate as finely as it could; docs/physics.md gives the reasons."""

from dataclasses import dataclass, replace

from shared.config import PUBLISHED_TIMING, Timing

CONTACT_RANGE = 0.02
"""The engine lists pairs that are closer than this: the sum of two shapes' contact offsets."""
REST_STEPS, REST_MOTION = 8, 1.2e-5
"""A hold may end when hand and object moved by less than the second a step over the first; at the time constant of the
hand's drives (24 steps of the fast approach, 48 of its drag) less than 0.6 mm is then left to come."""


@dataclass(frozen=True, slots=True)
class Strides:
    """When and by how much the target of a hand that stands still moves faster.

    Attributes:
        most: steps of its leg that the target moves at once, at most.
        share: it does while the hand moves by less than this times what its target moves.
    """

    most: int = 1
    share: float = 0.0


@dataclass(frozen=True, slots=True)
class Shortcuts:
    """The shortcuts of one version.

    Attributes:
        first_step: timing of the first step of a trial; None: that of the approach.
        part_range: two parts of the object are looked at when they are closer than this.
        followed_motion: a hold that another motion follows ends when no coordinate of the hand changed by more than
            this a step.
        follows_fingers: closing fingers are followed as long as they may still close altogether, and a pull whose
            fingers have closed ends once the object rests.
        preparing: at a standstill in a leg that another one follows.
        decisive: at a standstill in the last leg.
        sliding: in the drag of closed fingers, the hand moves up to so many times faster while no joint has moved in
            it.
        measures_flight: free flight ends where the shapes of hand and object could touch, not where the engine lists
            that they are near.
    """

    first_step: Timing | None = None
    part_range: float = CONTACT_RANGE
    followed_motion: float = REST_MOTION
    follows_fingers: bool = False
    preparing: Strides = Strides()
    decisive: Strides = Strides()
    sliding: int = 1
    measures_flight: bool = False


_SECOND = Shortcuts(
    # At the pace of the fast approach: how hard overlapping shapes press in a step depends on its length, and so does
    # which overlap is a start collision.
    first_step=Timing(steps_per_second=PUBLISHED_TIMING.steps_per_second, leg_steps=500, hold_steps=0),
    # Parts of closed furniture are close to each other throughout, and listing them takes more time than all else.
    part_range=0.004,
    # What is left to come of the hand comes during the next motion.
    followed_motion=5e-5,
    follows_fingers=True,
    # Each time step adds 3.3 N or less before another leg, and 0.8 N in the last one, which decides.
    preparing=Strides(16, 0.4),
    decisive=Strides(4, 0.2),
)
_THIRD = replace(_SECOND, sliding=8)
SHORTCUTS = {1: Shortcuts(), 2: _SECOND, 3: _THIRD, 4: replace(_THIRD, measures_flight=True)}
"""By `Fidelity.version`."""
