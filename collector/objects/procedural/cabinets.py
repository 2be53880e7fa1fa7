"""Things with a carcass and a front of doors and drawers: StorageFurniture, Refrigerator, Table, Safe.

A front is a grid of cells. Its panels lie on the carcass (*overlay*), so what they hide cannot be seen: the side that a
door without a handle turns about. Such a door's edges stand proud of the carcass, so that a gripper can pinch them.

Besides free-standing tables there are writing tables with slim drawers, and desks on pedestals. They follow what the
tables of PartNet-Mobility have and the first lack: drawers a few centimetres high, tops that hide them from above,
slender legs, a shelf below, and pedestals with a stack of drawers or a door.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point
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
    shifted,
    sliding,
)

GAP = 0.006
"""Between a panel and what it lies on, and between neighbours."""


@dataclass(frozen=True, slots=True)
class FrontPanel:
    """One door or drawer of a front.

    Attributes:
        kind: what it is.
        y: [low, high] of its cell.
        z: likewise.
        handle: whether it has a grip.
        hinge: the side that a door turns about, seen from the front.
    """

    kind: Literal["door", "drawer"]
    y: tuple[float, float]
    z: tuple[float, float]
    handle: bool = True
    hinge: Literal["left", "right"] = "left"


@dataclass(frozen=True, slots=True)
class Carcass:
    """A box from (0, -width / 2, 0) to (depth, width / 2, height), open at the front.

    Attributes:
        wall: thickness of its walls.
        thickness: of the panels before it.
        overhang: how far panels reach beyond its outline.
        opens: how far doors open, rad.
        door_name: semantic name of a door.
    """

    width: float
    depth: float
    height: float
    wall: float
    thickness: float
    overhang: float
    opens: float = np.pi / 2
    door_name: str = "rotation_door"

    def shell(self) -> Pieces:
        """Its walls."""
        half = self.width / 2
        return hollow_box((0.0, -half, 0.0), (self.depth, half, self.height), self.wall, (FRONT,))

    def front(self, panels: Sequence[FrontPanel]) -> tuple[MovablePart, ...]:
        """The panels as parts."""
        return tuple(self._door(panel) if panel.kind == "door" else self._drawer(panel) for panel in panels)

    def board_between(self, lower: FrontPanel, upper: FrontPanel) -> Pieces:
        """A shelf where one panel ends and the next begins."""
        z = (lower.z[1] + upper.z[0]) / 2
        half = self.width / 2 - self.wall
        return (block((0.0, -half, z - self.wall / 2), (self.depth - self.wall, half, z + self.wall / 2)),)

    def _plate(self, panel: FrontPanel) -> tuple[Point, Point]:
        """Corners of a panel's plate: over the carcass's edge where it ends there, else short of its neighbour."""

        def end(value: float, outline: float, sign: float) -> float:
            return value + sign * (self.overhang if np.isclose(value, outline) else -GAP / 2)

        y = end(panel.y[0], -self.width / 2, -1), end(panel.y[1], self.width / 2, 1)
        z = end(panel.z[0], 0.0, -1), end(panel.z[1], self.height, 1)
        return (-GAP - self.thickness, y[0], z[0]), (-GAP, y[1], z[1])

    def _door(self, panel: FrontPanel) -> MovablePart:
        low, high = self._plate(panel)
        left = panel.hinge == "left"
        pieces: Pieces = (block(low, high),)
        if panel.handle:
            inset = min(0.08, 0.2 * (high[1] - low[1]))
            y = low[1] + inset if left else high[1] - inset
            length = min(0.45, 0.5 * (high[2] - low[2]))
            pieces += grip((low[0], y, (low[2] + high[2]) / 2), TOP, FRONT, length, 0.07, 0.014)
        corner = (low[0], high[1] if left else low[1], (low[2] + high[2]) / 2)
        return hinged(self.door_name, pieces, corner, LEFT if left else RIGHT, FRONT, self.opens)

    def _drawer(self, panel: FrontPanel) -> MovablePart:
        low, high = self._plate(panel)
        pieces: Pieces = (block(low, high),)
        if panel.handle:
            centre = (low[0], (low[1] + high[1]) / 2, (low[2] + high[2]) / 2)
            pieces += grip(centre, LEFT, FRONT, min(0.4, 0.5 * (high[1] - low[1])), 0.07, 0.014)
        clear = self.wall + 2 * GAP
        length = 0.85 * (self.depth - self.wall)
        tray_low = (-GAP, panel.y[0] + clear, panel.z[0] + clear)
        tray_high = (length, panel.y[1] - clear, panel.z[1] - clear - 0.2 * (panel.z[1] - panel.z[0]))
        pieces += hollow_box(tray_low, tray_high, self.wall / 2, (TOP, FRONT))
        return sliding("drawer", pieces, FRONT, 0.8 * length)


def storage_furniture(
    hinge: Literal["left", "right"], width: float = 1.0, depth: float = 0.7, height: float = 1.4, overhang: float = 0.03
) -> ObjectModel:
    """A cabinet with one closed overlay door without a handle: nothing to be seen tells the hinge's side."""
    carcass = Carcass(width, depth, height, 0.03, 0.03, overhang)
    door = FrontPanel("door", (-width / 2, width / 2), (0.0, height), handle=False, hinge=hinge)
    return ObjectModel("StorageFurniture", "furniture_body", carcass.shell(), carcass.front([door]))


def random_storage_furniture(rng: np.random.Generator) -> ObjectModel:
    """A cabinet of one of five layouts; two in five hide the hinge's side of a single door."""
    layout = rng.choice(["hidden", "hidden", "doors", "drawers", "mixed"])
    carcass = _random_carcass(rng)
    if layout == "hidden":
        return storage_furniture(
            _side(rng), carcass.width, carcass.depth, carcass.height, float(rng.uniform(0.02, 0.04))
        )
    if layout == "doors":
        panels = _doors_across(carcass, (0.0, carcass.height), rng)
        boards: Pieces = ()
    elif layout == "drawers":
        panels = _drawers_up(carcass, 0.0, carcass.height, int(rng.integers(2, 5)))
        boards = _boards(carcass, panels)
    else:
        split = carcass.height * float(rng.uniform(0.55, 0.75))
        doors = _doors_across(carcass, (0.0, split), rng)
        drawers = _drawers_up(carcass, split, carcass.height, int(rng.integers(1, 3)))
        panels = [*doors, *drawers]
        boards = _boards(carcass, [doors[0], *drawers])
    return ObjectModel("StorageFurniture", "furniture_body", carcass.shell() + boards, carcass.front(panels))


def random_refrigerator(rng: np.random.Generator) -> ObjectModel:
    """One door, a freezer above, or two doors side by side."""
    carcass = Carcass(
        width=float(rng.uniform(0.65, 0.85)),
        depth=float(rng.uniform(0.6, 0.75)),
        height=float(rng.uniform(1.4, 1.65)),
        wall=0.05,
        thickness=float(rng.uniform(0.05, 0.08)),
        overhang=float(rng.choice([0.0, 0.025])),
        opens=float(rng.uniform(1.6, 2.4)),
        door_name="door",
    )
    handle, side = bool(carcass.overhang == 0.0 or rng.random() < 0.5), _side(rng)
    across, up = (-carcass.width / 2, carcass.width / 2), (0.0, carcass.height)
    whole = FrontPanel("door", across, up, handle, side)
    boards: Pieces = ()
    match rng.choice(["one", "freezer", "beside"]):
        case "one":
            panels = [whole]
        case "freezer":
            split = carcass.height * float(rng.uniform(0.6, 0.72))
            panels = [replace(whole, z=(0.0, split)), replace(whole, z=(split, carcass.height))]
            boards = carcass.board_between(*panels)
        case _:
            panels = _pair(whole)
    return ObjectModel("Refrigerator", "refrigerator_body", carcass.shell() + boards, carcass.front(panels))


def random_table(rng: np.random.Generator) -> ObjectModel:
    """A top on four legs, with drawers below it."""
    width, depth, height = float(rng.uniform(1.2, 1.5)), float(rng.uniform(0.6, 0.8)), float(rng.uniform(0.7, 0.9))
    box_height, leg = float(rng.uniform(0.2, 0.3)), 0.05
    carcass = Carcass(width - 0.1, depth - 0.1, box_height, 0.025, 0.025, 0.0)
    columns = np.linspace(-carcass.width / 2, carcass.width / 2, int(rng.integers(1, 4)) + 1)
    handle = bool(rng.random() < 0.8)
    drawers = [
        FrontPanel("drawer", (float(low), float(high)), (0.0, box_height), handle) for low, high in pairwise(columns)
    ]
    back = carcass.depth
    dividers = tuple(block((0.0, y - 0.01, 0.025), (back, y + 0.01, box_height - 0.025)) for y in columns[1:-1])
    # The top reaches further forward than the drawers' fronts, or as far: both occur.
    lip = float(rng.choice([0.0, 0.08]))
    top = block((-lip, -width / 2, box_height), (back + 0.05, width / 2, box_height + 0.05))
    legs = tuple(
        block((x, y - leg / 2, box_height - height), (x + leg, y + leg / 2, 0.0))
        for x in (0.0, back - leg)
        for y in (-(carcass.width - leg) / 2, (carcass.width - leg) / 2)
    )
    return ObjectModel("Table", "furniture_body", (*carcass.shell(), *dividers, top, *legs), carcass.front(drawers))


def random_safe(rng: np.random.Generator) -> ObjectModel:
    """A thick box whose door carries a dial that turns by itself."""
    carcass = Carcass(
        width=float(rng.uniform(0.9, 1.2)),
        depth=float(rng.uniform(0.7, 1.0)),
        height=float(rng.uniform(0.9, 1.2)),
        wall=0.08,
        thickness=0.07,
        overhang=float(rng.choice([0.0, 0.025])),
        opens=float(rng.uniform(1.5, 2.2)),
        door_name="door",
    )
    side = _side(rng)
    panel = FrontPanel(
        "door", (-carcass.width / 2, carcass.width / 2), (0.0, carcass.height), bool(rng.random() < 0.7), side
    )
    (door,) = carcass.front([panel])
    face, y = -GAP - carcass.thickness, 0.1 * carcass.width * (1 if side == "left" else -1)
    dial = knob("knob", (face, y, 0.65 * carcass.height), 0.09, parent=0)
    return ObjectModel("Safe", "safe_body", carcass.shell(), (door, dial))


def knob(name: str, centre: Point, radius: float, parent: int | None = None) -> MovablePart:
    """A dial with a ridge across it, which turns about the x axis, on a front whose surface is at `centre`."""
    x, y, z = centre
    pieces = (
        rod((x - 0.002, y, z), (x - 0.04, y, z), radius, 0.85 * radius, sides=20),
        block((x - 0.08, y - 0.15 * radius, z - 0.8 * radius), (x - 0.04, y + 0.15 * radius, z + 0.8 * radius)),
    )
    return MovablePart(name, "revolute", pieces, centre, BACK, np.pi, parent=parent)


def _random_carcass(rng: np.random.Generator) -> Carcass:
    width, height = float(rng.uniform(0.7, 1.3)), float(rng.uniform(0.7, 1.5))
    depth = float(rng.uniform(0.5, 0.8))
    # So scaled, lengths that do not depend on the object's size, such as the overhang, keep theirs.
    scale = 1.95 / float(np.linalg.norm([width, height, depth]))
    thickness = float(rng.uniform(0.025, 0.035))
    return Carcass(width * scale, depth * scale, height * scale, 0.03, thickness, 0.0, float(rng.uniform(1.5, 2.0)))


def _side(rng: np.random.Generator) -> Literal["left", "right"]:
    return "left" if rng.random() < 0.5 else "right"


def _pair(whole: FrontPanel) -> list[FrontPanel]:
    """Two doors in place of one, hinged at the outer sides."""
    middle = (whole.y[0] + whole.y[1]) / 2
    return [
        replace(whole, y=(whole.y[0], middle), hinge="right"),
        replace(whole, y=(middle, whole.y[1]), hinge="left"),
    ]


def _doors_across(carcass: Carcass, z: tuple[float, float], rng: np.random.Generator) -> list[FrontPanel]:
    whole = FrontPanel("door", (-carcass.width / 2, carcass.width / 2), z, bool(rng.random() < 0.7), _side(rng))
    return _pair(whole) if rng.random() < 0.6 else [whole]


def _drawers_up(carcass: Carcass, low: float, high: float, count: int) -> list[FrontPanel]:
    heights = np.linspace(low, high, count + 1)
    across = (-carcass.width / 2, carcass.width / 2)
    return [FrontPanel("drawer", across, (float(bottom), float(top))) for bottom, top in pairwise(heights)]


def _boards(carcass: Carcass, stacked: Sequence[FrontPanel]) -> Pieces:
    return tuple(board for low, high in pairwise(stacked) for board in carcass.board_between(low, high))


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
