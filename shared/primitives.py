"""Primitives: motions of the hand at a point. One record describes each; `PRIMITIVES` finds them by name.

Lengths are metres. The *start frame* is the hand frame (forward, left, up, where *up* is the approach direction d) as
it stands when the trial starts, with its origin moved to the touched point p; so (0, 0, -0.10) is 0.10 before p.
"""

from dataclasses import dataclass

from shared.extensions import Registry
from shared.types import Action, Float

START_DISTANCE = 0.15
"""From the hand frame's origin to p at the start, along the approach."""


@dataclass(frozen=True, slots=True)
class Leg:
    """One motion of the hand along a straight line, at constant speed.

    Attributes:
        end: [3], start frame, where the hand frame's origin ends.
        turn_rad: how far the hand is then turned about its approach axis from how it started, from forward towards left
            where positive. The hand turns at constant speed; keep it below pi.
    """

    end: tuple[float, float, float]
    turn_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class PrimitiveSpec:
    """One primitive: the hand starts at p - 0.15 d, approaches, may close its fingers, and may move once more.

    Attributes:
        approach: the first leg.
        then: the second leg, at the slower timing of `Fidelity.drag`; None: there is none.
        intended: [3], start frame, the unit direction in which the touched point must move, up to 60 deg; None: any.
            Whatever it is, the joint must move by more than 0.01 rad or m, or half of its range.
        closes_fingers: whether the hand closes after the approach: fingers that started open, or the valve of a
            suction cup. A trial in which it then holds nothing ends ("no-grasp").
        checks_contact: whether a first contact of the palm, or of a finger with another part than the target, ends the
            trial ("hand-contact", "wrong-part").
        needs_friction: whether friction between hand and part carries the part along, so that the engine takes the
            solver iterations of `Fidelity.solver_iterations` instead of `Fidelity.push_solver_iterations`.
    """

    approach: Leg
    then: Leg | None = None
    intended: tuple[float, float, float] | None = None
    closes_fingers: bool = False
    checks_contact: bool = True
    needs_friction: bool = True


_FORWARD, _LEFT, _BACK = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)
_NEAR = Leg((0.0, 0.0, -0.10))
_NEAR_TO_SLIDE = Leg((0.0, 0.0, -0.11))

# The six of Where2Act. Its "left" is the hand frame's forward, and its "up" the hand frame's left.
PRIMITIVES = Registry(
    "primitive",
    PrimitiveSpec,
    {
        "push": PrimitiveSpec(_NEAR, needs_friction=False),
        "push-left": PrimitiveSpec(_NEAR_TO_SLIDE, Leg((0.05, 0.0, -0.11)), _FORWARD),
        "push-up": PrimitiveSpec(_NEAR_TO_SLIDE, Leg((0.0, 0.05, -0.11)), _LEFT),
        "pull": PrimitiveSpec(
            _NEAR, Leg((0.0, 0.0, -START_DISTANCE)), _BACK, closes_fingers=True, checks_contact=False
        ),
        "pull-left": PrimitiveSpec(_NEAR, Leg((0.05, 0.0, -0.10)), _FORWARD, closes_fingers=True, checks_contact=False),
        "pull-up": PrimitiveSpec(_NEAR, Leg((0.0, 0.05, -0.10)), _LEFT, closes_fingers=True, checks_contact=False),
    },
)


def hand_start(action: Action) -> Float:
    """Where the hand frame's origin starts, [3], world."""
    return action.point - START_DISTANCE * action.approach
