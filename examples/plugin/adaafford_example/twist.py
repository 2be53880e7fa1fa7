"""A primitive: pinch what is at the point, and turn the hand about its approach axis, as one turns a knob."""

from shared.primitives import Leg, PrimitiveSpec

TWIST = PrimitiveSpec(
    approach=Leg((0.0, 0.0, -0.10)),
    then=Leg((0.0, 0.0, -0.10), turn_rad=1.0),
    closes_fingers=True,
    checks_contact=False,
)
