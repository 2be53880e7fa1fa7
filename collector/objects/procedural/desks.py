"""Tables with drawers under them: free-standing ones, writing tables with slim drawers, and desks on pedestals.

The second and the third follow what the tables of PartNet-Mobility have and the first lack: drawers a few centimetres
high, tops that hide them from above, slender legs, a shelf below, and pedestals with a stack of drawers or a door.
"""

from itertools import pairwise

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces
from collector.objects.procedural.cabinets import Carcass, FrontPanel, random_table
from collector.objects.procedural.shapes import block, either, moved, shifted

WALL = 0.018


def random_table_or_desk(rng: np.random.Generator) -> ObjectModel:
    """A table with drawers as high as a hand, or one of the other two, equally often."""
    return either(rng, random_table, _random_desk)


def _random_desk(rng: np.random.Generator) -> ObjectModel:
    width, depth, height = float(rng.uniform(0.9, 1.8)), float(rng.uniform(0.45, 0.8)), float(rng.uniform(0.65, 0.85))
    slim = float(rng.uniform(0.07, 0.13))
    over = float(rng.uniform(0.01, 0.06))
    inner = Carcass(width - 2 * over, depth - 2 * over, height, WALL, 0.018, 0.0, float(rng.uniform(1.4, 2.0)))
    pedestals = rng.choice(["none", "one", "both"], p=[0.5, 0.2, 0.3])
    handle = bool(rng.random() < 0.7)
    half, foot = inner.width / 2, float(rng.uniform(0.25, 0.35))
    legs_from, legs_to = -half, half
    body: Pieces = (
        block((-over, -width / 2, height), (inner.depth + over, width / 2, height + float(rng.uniform(0.02, 0.045)))),
    )
    parts: tuple[MovablePart, ...] = ()
    if pedestals != "none":
        sides = [-1.0, 1.0] if pedestals == "both" else [float(rng.choice([-1.0, 1.0]))]
        for side in sides:
            pieces, more = _pedestal(inner, side * (half - foot / 2), foot, height, handle, rng)
            body, parts = body + pieces, parts + more
        legs_from, legs_to = (-half + foot if -1.0 in sides else -half), (half - foot if 1.0 in sides else half)
    if pedestals == "none" or rng.random() < 0.6:
        pieces, more = _slim_drawers(inner, legs_from, legs_to, height, slim, handle, rng)
        body, parts = body + pieces, parts + more
    if pedestals != "both":
        body += _legs(inner, legs_from, legs_to, height, pedestals == "none", rng)
    return ObjectModel("Table", "furniture_body", body, parts)


def _pedestal(
    desk: Carcass, y: float, width: float, height: float, handle: bool, rng: np.random.Generator
) -> tuple[Pieces, tuple[MovablePart, ...]]:
    """A carcass below the top with its middle at `y`: a stack of drawers, or a door."""
    low = float(rng.choice([0.0, 0.1]))
    carcass = Carcass(width, desk.depth, height - low, WALL, 0.018, 0.0, desk.opens)
    across = (-width / 2, width / 2)
    if rng.random() < 0.75:
        heights = np.linspace(0.0, carcass.height, int(rng.integers(2, 5)) + 1)
        panels = [FrontPanel("drawer", across, (float(a), float(b)), handle) for a, b in pairwise(heights)]
    else:
        panels = [FrontPanel("door", across, (0.0, carcass.height), handle, "left" if y > 0 else "right")]
    by = (0.0, y, low)
    boards = tuple(board for a, b in pairwise(panels) for board in carcass.board_between(a, b))
    pieces = moved(carcass.shell() + boards, by)
    if low:
        pieces += moved((block((0.05, across[0] + 0.03, -low), (desk.depth - 0.03, across[1] - 0.03, 0.0)),), by)
    return pieces, tuple(shifted(part, by) for part in carcass.front(panels))


def _slim_drawers(
    desk: Carcass, low: float, high: float, height: float, slim: float, handle: bool, rng: np.random.Generator
) -> tuple[Pieces, tuple[MovablePart, ...]]:
    """A row of one to three slim drawers directly below the top, from y = `low` to `high`."""
    carcass = Carcass(high - low, 0.9 * desk.depth, slim, 0.012, 0.015, 0.0)
    columns = np.linspace(-carcass.width / 2, carcass.width / 2, int(rng.integers(1, 4)) + 1)
    panels = [FrontPanel("drawer", (float(a), float(b)), (0.0, slim), handle) for a, b in pairwise(columns)]
    by = (0.0, (low + high) / 2, height - slim)
    dividers = tuple(block((0.0, y - 0.006, 0.012), (carcass.depth, y + 0.006, slim - 0.012)) for y in columns[1:-1])
    return moved(carcass.shell() + dividers, by), tuple(shifted(part, by) for part in carcass.front(panels))


def _legs(desk: Carcass, low: float, high: float, height: float, all_four: bool, rng: np.random.Generator) -> Pieces:
    """Slender legs where no pedestal is, and perhaps a shelf between all four."""
    thick = float(rng.uniform(0.025, 0.06))
    ends = [y for y in (low, high - thick) if all_four or abs(y + thick / 2) > desk.width / 2 - 2 * thick]
    pieces = tuple(block((x, y, 0.0), (x + thick, y + thick, height)) for y in ends for x in (0.02, desk.depth - thick))
    if all_four and rng.random() < 0.3:
        z = float(rng.uniform(0.12, 0.3)) * height
        pieces += (block((0.02 + thick, low + thick, z), (desk.depth - thick, high - thick, z + 0.025)),)
    return pieces
