"""Faucets: a column, a spout, and one or two switches whose turning direction cannot be seen."""

from itertools import pairwise

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point
from collector.objects.procedural.shapes import BOTTOM, LEFT, RIGHT, TOP, block, either, moved, rod


def random_faucet(rng: np.random.Generator) -> ObjectModel:
    """A faucet whose switches turn about the vertical, or one whose switches are at its sides, equally often."""
    return either(rng, _upright_faucet, _side_faucet)


def _upright_faucet(rng: np.random.Generator) -> ObjectModel:
    """One switch on top of the column, or two on pedestals beside it; the sense of each axis is drawn."""
    height, radius = float(rng.uniform(0.7, 1.1)), float(rng.uniform(0.08, 0.13))
    reach = float(rng.uniform(0.7, 1.0))
    twin = bool(rng.random() < 0.5)
    spout_height = height if twin else height * float(rng.uniform(0.55, 0.75))
    spout = _spout(reach, spout_height, 0.6 * radius)
    style = rng.choice(["lever", "cross", "knob"])
    if twin:
        half, low = float(rng.uniform(0.4, 0.55)), float(rng.uniform(0.15, 0.3))
        stands = [(0.0, half, low), (0.0, -half, low)]
        plate = block((-0.18, -half - 0.18, -0.06), (0.18, half + 0.18, 0.0))
        pedestals = tuple(rod((x, y, 0.0), (x, y, z), 0.8 * radius, 0.6 * radius) for x, y, z in stands)
    else:
        stands = [(0.0, 0.0, height)]
        plate = rod((0.0, 0.0, -0.06), (0.0, 0.0, 0.0), 2.0 * radius, sides=24)
        pedestals = ()
    body: Pieces = (plate, rod((0.0, 0.0, 0.0), (0.0, 0.0, height), radius, 0.9 * radius), *pedestals)
    size, upper = float(rng.uniform(0.25, 0.4)), float(rng.uniform(0.5, 1.0) * np.pi)
    # A lever points back or forward, so that neither sense of turning is the likelier.
    heading = 0.0 if twin or rng.random() < 0.5 else np.pi
    switches = [_switch(str(style), stand, size, heading, upper, rng) for stand in stands]
    if twin and rng.random() < 0.4:
        turning = MovablePart("spout", "revolute", spout, (0.0, 0.0, height), TOP, np.pi / 2)
        return ObjectModel("Faucet", "faucet_base", body, (*switches, turning))
    return ObjectModel("Faucet", "faucet_base", body + spout, tuple(switches))


def _side_faucet(rng: np.random.Generator) -> ObjectModel:
    """A bent spout on a column, and switches that turn about horizontal axes at one side of it or at both."""
    radius, height = float(rng.uniform(0.06, 0.1)), float(rng.uniform(0.3, 0.5))
    middle, arm = height * float(rng.uniform(0.4, 0.75)), float(rng.uniform(0.05, 0.2))
    body: Pieces = (
        rod((0.0, 0.0, -0.05), (0.0, 0.0, 0.0), 1.6 * radius, sides=24),
        rod((0.0, 0.0, 0.0), (0.0, 0.0, height), radius),
    )
    style = rng.choice(["lever", "lever", "cross"])
    length, upper = float(rng.uniform(0.18, 0.35)), float(rng.uniform(0.4, 1.0) * np.pi)
    switches = []
    for side in (1.0, -1.0) if rng.random() < 0.4 else (1.0 if rng.random() < 0.5 else -1.0,):
        stand = (0.0, side * (radius + arm), middle)
        body += (rod((0.0, side * 0.8 * radius, middle), stand, 0.55 * radius),)
        hub = rod((0.0, side * 0.005, 0.0), (0.0, side * 0.1, 0.0), 0.6 * radius)
        # A lever that leans would fall one way only, and so show which way it turns.
        angles = [0.0] if style == "lever" else list(np.pi * (np.arange(4) / 2 + 0.25))
        reach = length if style == "lever" else 0.5 * length
        start = (0.0, side * 0.07, 0.0)
        arms = tuple(
            rod(start, (reach * float(np.sin(a)), side * 0.09, reach * float(np.cos(a))), 0.025, 0.022, sides=10)
            for a in angles
        )
        axis = LEFT if rng.random() < 0.5 else RIGHT
        switches.append(MovablePart("switch", "revolute", moved((hub, *arms), stand), stand, axis, upper))
    spout = _bent_spout(height, float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.14, 0.26)), 0.5 * radius)
    if rng.random() < 0.5:
        turning = MovablePart("spout", "revolute", spout, (0.0, 0.0, height), TOP, np.pi / 2)
        return ObjectModel("Faucet", "faucet_base", body, (*switches, turning))
    return ObjectModel("Faucet", "faucet_base", body + spout, tuple(switches))


def _bent_spout(height: float, rise: float, bend: float, radius: float) -> Pieces:
    """A pipe up from the column's top, half a circle forward, and down to its mouth."""
    top = height + rise
    angles = np.pi * np.arange(9) / 8
    points = [(bend * (float(np.cos(a)) - 1.0), 0.0, top + bend * float(np.sin(a))) for a in angles]
    points = [(0.0, 0.0, height + 0.005), *points, (-2.0 * bend, 0.0, top - 0.5 * rise)]
    return tuple(rod(start, end, radius, sides=10) for start, end in pairwise(points))


def _spout(reach: float, height: float, radius: float) -> Pieces:
    """A pipe forward from the column, and its mouth."""
    tip = (-reach, 0.0, height)
    return (
        rod((0.0, 0.0, height - 0.06), tip, radius),
        rod((-reach + radius, 0.0, height), (-reach + radius, 0.0, height - 0.15), 0.8 * radius),
    )


def _switch(
    style: str, stand: Point, size: float, heading: float, upper: float, rng: np.random.Generator
) -> MovablePart:
    """A switch that turns about the vertical through `stand`.

    Args:
        style: "lever", "cross" or "knob".
        stand: top of what it stands on.
        size: how far it reaches from its axis.
        heading: azimuth of a lever, from -x, rad.
        upper: how far it turns, rad.
        rng: draws the sense of turning.
    """
    hub = rod((0.0, 0.0, 0.005), (0.0, 0.0, 0.1), 0.07, 0.06)
    if style == "lever":
        arms = _arms(size, heading, 1)
    elif style == "cross":
        arms = _arms(0.7 * size, heading + np.pi / 4, 4)
    else:
        grips = _arms(0.45 * size, heading + np.pi / 5, 5)
        arms = (rod((0.0, 0.0, 0.1), (0.0, 0.0, 0.2), 0.35 * size, sides=20), *moved(grips, (0.0, 0.0, 0.02)))
    axis = TOP if rng.random() < 0.5 else BOTTOM
    return MovablePart("switch", "revolute", moved((hub, *arms), stand), stand, axis, upper)


def _arms(length: float, heading: float, count: int) -> Pieces:
    """`count` arms spread evenly about the z axis, rising a little, the first at azimuth `heading` from -x."""
    angles = heading + 2 * np.pi * np.arange(count) / count
    return tuple(
        rod((0.0, 0.0, 0.09), (-length * float(np.cos(a)), -length * float(np.sin(a)), 0.13), 0.035, 0.03, sides=10)
        for a in angles
    )
