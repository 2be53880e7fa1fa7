"""What is set into a wall: Door, Window, Switch."""

from typing import Literal

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point
from collector.objects.procedural.cabinets import GAP
from collector.objects.procedural.shapes import (
    BACK,
    BOTTOM,
    FRONT,
    LEFT,
    RIGHT,
    TOP,
    block,
    grip,
    hinged,
    hollow_box,
    ring,
    sliding,
)


def random_door(rng: np.random.Generator) -> ObjectModel:
    """A frame and one door, or two."""
    width, height = float(rng.uniform(0.8, 1.2)), float(rng.uniform(1.4, 1.7))
    depth, post = float(rng.uniform(0.08, 0.12)), 0.08
    half = width / 2
    frame = hollow_box((0.0, -half - post, 0.0), (depth, half + post, height + post), post, (FRONT, BACK, BOTTOM))
    opens = float(rng.uniform(1.4, 1.7))
    if rng.random() < 0.5:
        left = bool(rng.random() < 0.5)
        leaves = [((-half, half), left)]
    else:
        leaves = [((-half, 0.0), False), ((0.0, half), True)]
    doors = tuple(_leaf(y, height, 0.6 * depth, left, opens) for y, left in leaves)
    return ObjectModel("Door", "door_frame", frame, doors)


def random_window(rng: np.random.Generator) -> ObjectModel:
    """A frame with two sashes: casements that turn outward, or one that slides behind the other's plane."""
    width, height, bar = float(rng.uniform(1.0, 1.4)), float(rng.uniform(1.0, 1.4)), 0.06
    half = width / 2
    frame = ring((0.0, -half - bar, -bar), (0.16, half + bar, height + bar), bar)
    if rng.random() < 0.5:
        low, high = (0.0, -half + GAP, GAP), (0.06, -GAP / 2, height - GAP)
        opens = float(rng.uniform(1.0, 1.6))
        sashes: tuple[MovablePart, ...] = tuple(
            _casement(low_y, high_y, height, edge, opens)
            for low_y, high_y, edge in ((low[1], high[1], RIGHT), (-high[1], -low[1], LEFT))
        )
        return ObjectModel("Window", "window_frame", frame, sashes)
    fixed = _sash((0.09, 0.0, 0.0), (0.14, half, height), bar)
    slider = _sash((0.02, -half + GAP, GAP), (0.07, bar, height - GAP), bar)
    slider += grip((0.02, -half + bar, height / 2), TOP, FRONT, 0.25, 0.05, 0.012)
    return ObjectModel("Window", "window_frame", frame + fixed, (sliding("window", slider, LEFT, 0.85 * half),))


def random_switch(rng: np.random.Generator) -> ObjectModel:
    """A plate on a wall with one to three levers, each flipped up or down."""
    count = int(rng.integers(1, 4))
    pitch, height, reach = 0.45, float(rng.uniform(0.9, 1.3)), float(rng.uniform(0.2, 0.35))
    plate = block((0.0, -count * pitch / 2, -height / 2), (0.12, count * pitch / 2, height / 2))
    style: Literal["lever", "rocker"] = "lever" if rng.random() < 0.6 else "rocker"
    middles = (np.arange(count) - (count - 1) / 2) * pitch
    levers = tuple(_lever(float(y), reach, style) for y in middles)
    return ObjectModel("Switch", "switch_frame", (plate,), levers)


def _leaf(y: tuple[float, float], height: float, thickness: float, left: bool, opens: float) -> MovablePart:
    """A door leaf between two sides of its opening, flush with the frame's front, with grips on both faces."""
    low, high = (0.0, y[0] + GAP, GAP), (thickness, y[1] - GAP, height - GAP)
    free = low[1] + 0.1 if left else high[1] - 0.1
    pieces: Pieces = (block(low, high),)
    for x, outward in ((0.0, FRONT), (thickness, BACK)):
        pieces += grip((x, free, 0.47 * height), TOP, outward, 0.25, 0.07, 0.016)
    corner = (0.0, high[1] if left else low[1], height / 2)
    return hinged("rotation_door", pieces, corner, LEFT if left else RIGHT, FRONT, opens)


def _casement(low_y: float, high_y: float, height: float, edge: Point, opens: float) -> MovablePart:
    """A sash flush with the frame's front, with a grip at its free side."""
    pieces = _sash((0.0, low_y, GAP), (0.06, high_y, height - GAP), 0.06)
    hinge, free = (high_y, low_y) if edge == LEFT else (low_y, high_y)
    inward = 0.03 if free < hinge else -0.03
    pieces += grip((0.0, free + inward, height / 2), TOP, FRONT, 0.2, 0.05, 0.012)
    return hinged("window", pieces, (0.0, hinge, height / 2), edge, FRONT, opens)


def _sash(low: Point, high: Point, bar: float) -> Pieces:
    """A frame around a thin pane."""
    middle = (low[0] + high[0]) / 2
    pane = block((middle - 0.005, low[1] + bar, low[2] + bar), (middle + 0.005, high[1] - bar, high[2] - bar))
    return (*ring(low, high, bar), pane)


def _lever(y: float, reach: float, style: Literal["lever", "rocker"]) -> MovablePart:
    """A lever that starts tilted down and is flipped up, about a horizontal axis in the plate's face."""
    tilt, half = 0.4, 0.05 if style == "lever" else 0.14
    stub = block((-reach, -half, -0.05), (-0.002, half, 0.05))
    if style == "rocker":
        stub = block((-0.12, -half, -0.25), (-0.03, half, 0.25))
    cos, sin = np.cos(tilt), np.sin(tilt)
    tilted = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    piece = type(stub)(stub.vertices @ tilted.T + [0.0, y, 0.0], stub.faces)
    return MovablePart("switch", "revolute", (piece,), (0.0, y, 0.0), LEFT, 2 * tilt)
