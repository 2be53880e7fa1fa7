"""Cases with one door and controls: Microwave, WashingMachine, ButtonCabinet, HandleCabinet.

Nothing shows which of several controls works the latch of a cabinet's door. Without a hidden latch (`shared.hidden`)
the door is free, and the controls move.
"""

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces
from collector.objects.procedural.cabinets import GAP, knob
from collector.objects.procedural.shapes import (
    BACK,
    FRONT,
    LEFT,
    RIGHT,
    TOP,
    block,
    either,
    grip,
    hinged,
    hollow_box,
    moved,
    rod,
    sliding,
)

BUTTON_TRAVEL = 0.03


def random_microwave(rng: np.random.Generator) -> ObjectModel:
    """One with large buttons and a handle, or a plain one, equally often."""
    return either(rng, _random_large_buttons, _random_plain_microwave)


def _random_plain_microwave(rng: np.random.Generator) -> ObjectModel:
    """A door flush with its case, perhaps with a bar, before a turntable; beside it a panel, perhaps with a knob."""
    width, depth, height = (float(size) for size in rng.uniform((0.9, 0.6, 0.5), (1.4, 0.95, 0.85)))
    wall, thickness = float(rng.uniform(0.025, 0.06)), float(rng.uniform(0.025, 0.07))
    half, split = width / 2, -width / 2 + float(rng.uniform(0.12, 0.32)) * width
    below = float(rng.choice([0.0, rng.uniform(0.05, 0.15) * height]))
    body = (
        *hollow_box((0.0, split, below), (depth, half, height), wall, (FRONT,)),
        block((-thickness, -half, 0.0), (depth, split - GAP, height)),
    )
    if below:
        body += (block((-thickness, split - GAP, 0.0), (depth, half, below - GAP)),)
    low, high = (-GAP - thickness, split + GAP, below), (-GAP, half, height)
    pieces: Pieces = (block(low, high),)
    middle = (low[2] + high[2]) / 2
    if rng.random() < 0.4:
        pieces += grip((low[0], split + 0.07, middle), TOP, FRONT, 0.5 * (high[2] - low[2]), 0.05, 0.01)
    door = hinged("door", pieces, (low[0], half, middle), LEFT, FRONT, float(rng.uniform(1.4, 2.2)))
    parts = [door]
    centre, radius = (
        (depth / 2, (split + half) / 2, below + wall),
        0.42 * min(depth - 2 * wall, half - split - 2 * wall),
    )
    plate = rod(centre, (centre[0], centre[1], centre[2] + 0.02), radius, sides=24)
    parts.append(MovablePart("tray", "revolute", moved((plate,), (0.0, 0.0, 0.004)), centre, TOP, 2 * np.pi))
    if rng.random() < 0.5:
        parts.append(knob("knob", (-thickness, (-half + split) / 2, float(rng.uniform(0.2, 0.8)) * height), 0.05))
    return ObjectModel("Microwave", "microwave_body", body, tuple(parts))


def _random_large_buttons(rng: np.random.Generator) -> ObjectModel:
    """A door hinged at the left, and buttons and perhaps a dial at its right."""
    width, depth, height = float(rng.uniform(1.2, 1.5)), float(rng.uniform(0.8, 1.0)), float(rng.uniform(0.65, 0.85))
    panel, thickness = float(rng.uniform(0.25, 0.35)), 0.05
    half, split = width / 2, -width / 2 + panel
    body = (
        *hollow_box((0.0, split, 0.0), (depth, half, height), 0.04, (FRONT,)),
        block((-thickness, -half, 0.0), (depth, split - GAP, height)),
    )
    low, high = (-GAP - thickness, split + GAP, 0.0), (-GAP, half, height)
    pieces: Pieces = (block(low, high),)
    pieces += grip((low[0], split + 0.09, height / 2), TOP, FRONT, 0.6 * height, 0.08, 0.016)
    door = hinged("door", pieces, (low[0], half, height / 2), LEFT, FRONT, float(rng.uniform(1.5, 2.0)))
    middle = (-half + split) / 2
    rows = np.linspace(0.15, 0.55, int(rng.integers(2, 5))) * height
    # Four rows on a low front would overlap, and never come to rest.
    size = min(0.045, 0.45 * float(rows[1] - rows[0]))
    buttons = [_button(-thickness, middle + y, float(z), size) for z in rows for y in (-0.07, 0.07)]
    dial = [knob("knob", (-thickness, middle, 0.8 * height), 0.07)] if rng.random() < 0.5 else []
    return ObjectModel("Microwave", "microwave_body", body, (door, *buttons, *dial))


def random_washing_machine(rng: np.random.Generator) -> ObjectModel:
    """A round door before an opening in the front; a dial and buttons above it."""
    width, depth, height = float(rng.uniform(0.95, 1.1)), float(rng.uniform(0.8, 1.0)), float(rng.uniform(1.2, 1.4))
    half, radius, middle = width / 2, 0.36 * width, 0.48 * height
    hole = 0.7 * radius
    body = (
        *hollow_box((0.0, -half, 0.0), (depth, half, height), 0.04, (FRONT,)),
        block((0.0, -half + 0.04, 0.04), (0.04, half - 0.04, middle - hole)),
        block((0.0, -half + 0.04, middle + hole), (0.04, half - 0.04, height - 0.04)),
        block((0.0, -half + 0.04, middle - hole), (0.04, -hole, middle + hole)),
        block((0.0, hole, middle - hole), (0.04, half - 0.04, middle + hole)),
    )
    left, face = bool(rng.random() < 0.5), -GAP - 0.06
    side = 1.0 if left else -1.0
    disc: Pieces = (rod((-GAP, 0.0, middle), (face, 0.0, middle), radius, 0.95 * radius, sides=32),)
    disc += grip((face, -0.75 * side * radius, middle), TOP, FRONT, 0.3 * radius + 0.1, 0.07, 0.015)
    corner = (face, side * radius, middle)
    door = hinged("door", disc, corner, LEFT if left else RIGHT, FRONT, float(rng.uniform(1.5, 2.2)))
    dial = knob("knob", (0.0, 0.2 * width, 0.93 * height), 0.05)
    buttons = [_button(0.0, -y * width, 0.93 * height, 0.03) for y in (0.0, 0.12, 0.24)]
    return ObjectModel("WashingMachine", "washing_machine_body", body, (door, dial, *buttons))


def _button(face: float, y: float, z: float, half: float) -> MovablePart:
    """A button on a front at x = `face`, which goes in when it is pressed."""
    piece = block((face - BUTTON_TRAVEL, y - half, z - half), (face - 0.002, y + half, z + half))
    return sliding("button", (piece,), BACK, 0.9 * BUTTON_TRAVEL)


PRESS, PULL_OUT = 0.012, 0.03
"""How far a button goes in, and how far a handle comes out."""
TILT = 0.12
"""rad: how far a paddle tilts."""
PLATE = 0.04
"""Thickness of door and panel."""


def random_button_cabinet(rng: np.random.Generator) -> ObjectModel:
    """A door without any grip, and beside it a panel with three or four buttons, or paddles that tilt inward."""
    width, depth, height = float(rng.uniform(0.75, 0.9)), float(rng.uniform(0.4, 0.6)), float(rng.uniform(1.15, 1.3))
    side = 1.0 if rng.random() < 0.5 else -1.0
    half, split = width / 2, side * (width / 2 - 0.4)
    panel, opening = sorted((split, side * half)), sorted((split, -side * half))
    body = (
        *hollow_box((0.0, -half, 0.0), (depth, half, height), 0.03, (FRONT,)),
        block((-PLATE, panel[0] + GAP / 2, 0.0), (0.0, panel[1], height)),
    )
    low, high = (-GAP - PLATE, opening[0] + GAP / 2, 0.0), (-GAP, opening[1] - GAP / 2, height)
    hinge = (low[0], high[1] if side < 0 else low[1], height / 2)
    door = hinged("door", (block(low, high),), hinge, LEFT if side < 0 else RIGHT, FRONT, float(rng.uniform(1.4, 1.8)))
    count, middle = int(rng.integers(3, 5)), (panel[0] + panel[1]) / 2
    make = _large_button if rng.random() < 0.5 else _paddle
    heights = (np.arange(count) + 0.5) / count * (height - 0.1) + 0.05
    return ObjectModel("ButtonCabinet", "cabinet_body", body, (door, *(make(middle, float(z)) for z in heights)))


def random_handle_cabinet(rng: np.random.Generator) -> ObjectModel:
    """A door that carries two or three bars, each of which comes out a little when it is pulled."""
    width, depth, height = float(rng.uniform(0.8, 1.1)), float(rng.uniform(0.5, 0.7)), float(rng.uniform(1.0, 1.4))
    half, left = width / 2, bool(rng.random() < 0.5)
    body = hollow_box((0.0, -half, 0.0), (depth, half, height), 0.03, (FRONT,))
    low, high = (-GAP - PLATE, -half, 0.0), (-GAP, half, height)
    hinge = (low[0], half if left else -half, height / 2)
    door = hinged("door", (block(low, high),), hinge, LEFT if left else RIGHT, FRONT, float(rng.uniform(1.4, 1.8)))
    count, free = int(rng.integers(2, 4)), (-1.0 if left else 1.0) * (half - 0.12)
    heights = (np.arange(count) + 0.5) / count * (height - 0.1) + 0.05
    bars = (grip((low[0] - GAP, free, float(z)), TOP, FRONT, 0.24, 0.07, 0.016) for z in heights)
    handles = (MovablePart("handle", "prismatic", bar, (0.0, 0.0, 0.0), FRONT, PULL_OUT, parent=0) for bar in bars)
    return ObjectModel("HandleCabinet", "cabinet_body", body, (door, *handles))


def _large_button(y: float, z: float) -> MovablePart:
    """A button on the panel, which goes in when it is pressed."""
    face = -PLATE - GAP - PRESS
    return sliding("button", (block((face - 0.04, y - 0.13, z - 0.11), (face, y + 0.13, z + 0.11)),), BACK, PRESS)


def _paddle(y: float, z: float) -> MovablePart:
    """A plate before the panel, whose lower edge goes in when it is pressed."""
    face = -PLATE - 0.04
    pieces: Pieces = (block((face - 0.025, y - 0.13, z - 0.12), (face, y + 0.13, z + 0.1)),)
    return MovablePart("lever", "revolute", pieces, (face, y, z + 0.1), RIGHT, TILT)
