"""What the segmentation network is trained on beside the paper's categories: fronts, faucets and boxes of many layouts.

Each real cabinet, table, microwave or refrigerator has another layout, and those of the other modules have few. So the
front of a MixedFront is a grid of doors, drawers, fixed plates and open compartments, before or within a frame or flush
with it, with gaps that can be seen or not. A SwanFaucet has a bent or slanted spout, fixed or not, which resembles a
lever; a FlushBox has flaps that meet each other and end with its walls.
"""

from itertools import pairwise

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point, point
from collector.objects.procedural.fitted import Style, handle_on, random_style, relief_on
from collector.objects.procedural.shapes import (
    BACK,
    BOTTOM,
    FRONT,
    LEFT,
    RIGHT,
    TOP,
    block,
    hinged,
    hollow_box,
    moved,
    ring,
    rod,
    sliding,
)

Span = tuple[float, float]
Cell = tuple[Span, Span, str]
"""y, z and content of a cell of a front."""
SIZES = {
    "unit": ((0.35, 0.28, 0.35), (1.4, 0.65, 1.5)),
    "table": ((0.8, 0.4, 0.06), (1.8, 0.9, 0.25)),
    "tower": ((0.35, 0.3, 0.8), (0.8, 0.6, 1.8)),
    "microwave": ((0.45, 0.3, 0.25), (0.65, 0.45, 0.4)),
    "refrigerator": ((0.5, 0.5, 0.8), (0.95, 0.8, 1.9)),
}
"""Least and greatest width, depth and height."""
CELLS = ("door", "drawer", "open", "fixed")
LIKELY = {
    "unit": (0.5, 0.25, 0.12, 0.13),
    "table": (0.1, 0.7, 0.1, 0.1),
    "tower": (0.4, 0.2, 0.3, 0.1),
    "microwave": (0.7, 0.0, 0.0, 0.3),
    "refrigerator": (0.8, 0.1, 0.0, 0.1),
}
"""How likely a cell of the grid is each of `CELLS`."""


def random_mixed_front(rng: np.random.Generator) -> ObjectModel:
    """A cabinet, table, shelf, microwave or refrigerator."""
    kind = str(rng.choice(list(SIZES), p=[0.4, 0.25, 0.1, 0.15, 0.1]))
    width, depth, height = (float(size) for size in rng.uniform(*SIZES[kind]))
    if kind == "table" and rng.random() < 0.3:
        height *= 2.5
    cells = _cells(kind, width, height, rng)
    style = random_style(rng)
    gap = float(rng.uniform(0.0003, 0.0012) if rng.random() < 0.5 else rng.uniform(0.002, 0.008))
    wall = min(float(rng.uniform(0.008, 0.03)), *(0.2 * (span[1] - span[0]) for cell in cells for span in cell[:2]))
    frame = wall if rng.random() < 0.5 else wall + float(rng.uniform(0.01, 0.05)) * min(1.0, 3 * height)
    face = float(rng.choice([-gap - style.thickness, 0.0, rng.uniform(0.004, 0.03)], p=[0.5, 0.2, 0.3]))
    open_top, opens = bool(kind == "unit" and rng.random() < 0.3), float(rng.uniform(1.3, 2.4))
    body: Pieces = ()
    parts: list[MovablePart] = []
    for y, z, content in cells:
        openings = (FRONT, TOP) if open_top and z[1] == height else (FRONT,)
        body += hollow_box((0.0, y[0], z[0]), (depth, y[1], z[1]), wall, openings)
        border = min(frame, 0.3 * (y[1] - y[0]), 0.3 * (z[1] - z[0]))
        if frame > wall:
            body += ring((0.0, y[0], z[0]), (0.02, y[1], z[1]), border)
        inset = gap if face < 0 else gap + border
        low: Point = (face, y[0] + inset, z[0] + inset)
        high: Point = (face + style.thickness, y[1] - inset, z[1] - inset)
        if content == "drawer":
            parts.append(_drawer(low, high, depth, wall, style))
        elif content == "door":
            parts.append(_door(low, high, style, opens, rng))
        elif content == "fixed":
            body += (block(low, high),)
            if kind == "microwave":
                parts += _controls(low, high, rng)
    body += _above(width, depth, height, min(face, 0.0), open_top, rng)
    if kind in ("unit", "table", "tower"):
        body += _below(width, depth, 0.75 - height if kind == "table" else float(rng.uniform(0.05, 0.25)), kind, rng)
    return ObjectModel("MixedFront", "furniture_body", body, tuple(parts))


def _microwave_cells(width: float, height: float, rng: np.random.Generator) -> list[Cell]:
    """A door with a fixed plate beside it, above or below it, or both."""
    side, case = float(rng.uniform(0.15, 0.35)), rng.choice(["side", "above", "both"], p=[0.6, 0.1, 0.3])
    columns = [-0.5, side - 0.5, 0.5] if case != "above" else [-0.5, 0.5]
    rows = [0.0, 1.0] if case == "side" else [0.0, float(rng.choice([0.15, 0.85])), 1.0]
    high = max(pairwise(rows), key=lambda row: row[1] - row[0])
    return [
        ((width * a, width * b), (height * c, height * d), "door" if b == 0.5 and (c, d) == high else "fixed")
        for a, b in pairwise(columns)
        for c, d in pairwise(rows)
    ]


def _cells(kind: str, width: float, height: float, rng: np.random.Generator) -> list[Cell]:
    """The grid of a front, of which one cell at least moves."""
    across = int(rng.integers(1, 2 + min(3, int(width / 0.3))))
    if kind == "microwave":
        return _microwave_cells(width, height, rng)
    up = int(rng.integers(1, 2 + min(4, int(height / 0.15))))
    common = _cuts(0.0, height, up, rng)
    same = rng.random() < 0.6
    cells: list[Cell] = []
    for y in pairwise(_cuts(-width / 2, width / 2, across, rng)):
        heights = common if same else _cuts(0.0, height, int(rng.integers(1, up + 1)), rng)
        whole = str(rng.choice(CELLS, p=LIKELY[kind])) if rng.random() < 0.4 else None
        cells += [(y, z, whole or str(rng.choice(CELLS, p=LIKELY[kind]))) for z in pairwise(heights)]
    if not any(content in ("door", "drawer") for *_, content in cells):
        cells[-1] = (*cells[-1][:2], "drawer" if kind == "table" else "door")
    return cells


def _cuts(low: float, high: float, count: int, rng: np.random.Generator) -> list[float]:
    """A span in `count` parts: half of the time equal ones."""
    shares = np.ones(count) if rng.random() < 0.5 else rng.uniform(0.4, 1.6, count)
    return [low, *(low + (high - low) * float(c) for c in np.cumsum(shares / shares.sum())[:-1]), high]


def _drawer(low: Point, high: Point, depth: float, wall: float, style: Style) -> MovablePart:
    middle = (low[1] + high[1]) / 2, (low[2] + high[2]) / 2
    raised = style.relief if style.face == "recessed" else 0.0
    pieces: Pieces = (block(low, high), *relief_on(low, high, style))
    pieces += handle_on((low[0] - raised, *middle), LEFT, style, 0.3 * (high[1] - low[1]))
    clear = min(wall + 0.004, 0.2 * (high[2] - low[2]), 0.2 * (high[1] - low[1]))
    tray = (high[0], low[1] + clear, low[2] + clear), (0.9 * depth, high[1] - clear, low[2] + 0.8 * (high[2] - low[2]))
    return sliding("drawer", pieces + hollow_box(*tray, min(0.01, clear), (TOP, FRONT)), FRONT, 0.7 * depth)


def _door(low: Point, high: Point, style: Style, opens: float, rng: np.random.Generator) -> MovablePart:
    width, height = high[1] - low[1], high[2] - low[2]
    if rng.random() < 0.12:
        pieces: Pieces = ring(low, high, 0.2 * min(width, height))
    else:
        pieces = (block(low, high), *relief_on(low, high, style))
    x = low[0] - (style.relief if style.face == "recessed" else 0.0)
    y, z, inset = (low[1] + high[1]) / 2, (low[2] + high[2]) / 2, 0.1 * min(width, height)
    hinge = rng.choice(["side", "top", "bottom"], p=[0.75, 0.17, 0.08])
    if hinge != "side":
        edge, top = (TOP, high[2]) if hinge == "top" else (BOTTOM, low[2])
        pieces += handle_on(
            (x, y, low[2] + high[2] - top + inset * edge[2]), LEFT, style, float(rng.uniform(0.2, 0.8)) * width
        )
        return hinged("tilt_door", pieces, (x, y, top), edge, FRONT, opens)
    left = bool(rng.random() < 0.5)
    free = low[1] + inset if left else high[1] - inset
    pieces += handle_on(
        (x, free, z + float(rng.uniform(-0.3, 0.3)) * height), TOP, style, float(rng.uniform(0.15, 0.4)) * height
    )
    return hinged("rotation_door", pieces, (x, high[1] if left else low[1], z), LEFT if left else RIGHT, FRONT, opens)


def _controls(low: Point, high: Point, rng: np.random.Generator) -> list[MovablePart]:
    """Small buttons on an upright plate, or none."""
    controls, middle = [], (low[1] + high[1]) / 2
    width, height = high[1] - low[1], high[2] - low[2]
    if rng.random() < 0.5 and width < height:
        for z in np.linspace(0.1, 0.6, int(rng.integers(2, 6))):
            for y in np.linspace(-0.3, 0.3, 3):
                centre, half = (middle + float(y) * width, low[2] + float(z) * height), 0.08 * width
                piece = block(
                    (low[0] - 0.003, centre[0] - half, centre[1] - half),
                    (low[0] + 0.002, centre[0] + half, centre[1] + half),
                )
                controls.append(sliding("button", (piece,), BACK, 0.003))
    return controls


def _above(width: float, depth: float, height: float, face: float, bare: bool, rng: np.random.Generator) -> Pieces:
    """A slab that overhangs, a raised rim, or open shelves between posts."""
    half, over = width / 2, float(rng.uniform(0.0, 0.05))
    match rng.choice(["nothing", "slab", "rim", "shelves"], p=[0.3, 0.45, 0.15, 0.1]):
        case "slab" if not bare:
            front = face - over if rng.random() < 0.7 else 0.0
            top = height + float(rng.uniform(0.01, 0.05))
            return (block((front, -half - over, height), (depth + over, half + over, top)),)
        case "rim":
            top = height + float(rng.uniform(0.01, 0.06))
            return hollow_box((face, -half, height), (depth, half, top), 0.03, (TOP, BOTTOM))
        case "shelves" if not bare:
            rise, front = float(rng.uniform(0.3, 1.0)), depth - float(rng.uniform(0.4, 1.0)) * depth
            places = [(x, y) for x in (front, depth - 0.03) for y in (-half, half - 0.03)]
            posts = [block((x, y, height), (x + 0.03, y + 0.03, height + rise)) for x, y in places]
            levels = height + rise * np.linspace(0.0, 1.0, int(rng.integers(2, 6)))[1:] - 0.02
            return (*posts, *(block((front, -half, float(z)), (depth, half, float(z) + 0.018)) for z in levels))
        case _:
            return ()


def _below(width: float, depth: float, rise: float, kind: str, rng: np.random.Generator) -> Pieces:
    """Legs, perhaps with a shelf between them, or a recessed base, or nothing."""
    half, case = width / 2, rng.choice(["legs", "base", "nothing"], p=[0.4, 0.3, 0.3])
    if kind == "table" or case == "legs":
        thick = float(rng.uniform(0.025, 0.08))
        ends = [(x, y) for x in (0.0, depth - thick) for y in (-half, half - thick)]
        legs = tuple(block((x, y, -rise), (x + thick, y + thick, 0.0)) for x, y in ends)
        z = -rise * float(rng.uniform(0.6, 0.9))
        shelf = (block((0.0, -half, z), (depth, half, z + 0.02)),) if rng.random() < 0.3 else ()
        return legs + shelf
    return (block((0.05, -half + 0.01, -rise), (depth - 0.02, half - 0.01, 0.0)),) if case == "base" else ()


def random_swan_faucet(rng: np.random.Generator) -> ObjectModel:
    """A column with a bent or slanted spout, which turns or not, and switches at its sides, on it or apart."""
    radius, height = float(rng.uniform(0.04, 0.09)), float(rng.uniform(0.15, 0.6))
    body: Pieces = (
        rod((0.0, 0.0, -0.03), (0.0, 0.0, 0.0), float(rng.uniform(1.2, 2.2)) * radius, sides=24),
        rod((0.0, 0.0, 0.0), (0.0, 0.0, height), radius, float(rng.uniform(0.7, 1.0)) * radius),
    )
    heading = 0.0 if rng.random() < 0.6 else float(rng.uniform(-1.6, 1.6))
    spout = _swan(height, heading, float(rng.uniform(0.45, 0.9)) * radius, rng)
    switches = []
    place = rng.choice(["side", "top", "apart"], p=[0.6, 0.15, 0.25])
    sides = (1.0, -1.0) if place == "apart" or rng.random() < 0.35 else (float(rng.choice([-1.0, 1.0])),)
    arm, low = float(rng.uniform(0.02, 0.2)), height * float(rng.uniform(0.3, 0.8))
    length, lean = float(rng.uniform(0.08, 0.4)), rng.uniform(-1.0, 1.0, 2)
    thick, cross = float(rng.uniform(0.35, 0.8)) * radius, bool(rng.random() < 0.3)
    apart, reach = float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.05, 0.18))
    for side in sides:
        out, up = np.array([0.0, side, 0.0]), np.array([0.0, 0.0, 1.0])
        if place == "side":
            stand, axis, second = out * (radius + arm) + low * up, out, up
            body += (rod(point(out * 0.5 * radius + low * up), point(stand), thick),)
            angle = float(np.arctan2(1.0, lean[0]))
        else:
            stand, axis, second = height * up, up, np.array([0.0, 1.0, 0.0])
            angle = np.pi * lean[0]
            if place == "apart":
                stand = out * apart + 0.5 * stand
                body += (rod((0.0, stand[1], 0.0), point(stand), 1.6 * thick, thick),)
        pieces: Pieces = (rod(point(axis * 0.004), point(axis * reach), thick, float(rng.uniform(0.8, 1.1)) * thick),)
        start = axis * 0.8 * reach
        for turn in np.pi / 2 * np.arange(4) if cross else (angle,):
            way = np.array([np.cos(turn), 0.0, 0.0]) + np.sin(turn) * second
            arms = 0.4 * way if cross else way + 0.6 * abs(lean[1]) * axis
            pieces += (rod(point(start), point(start + length * arms), 0.022, 0.018, sides=10),)
        switches.append(MovablePart("switch", "revolute", moved(pieces, point(stand)), point(stand), point(axis), 2.0))
        if place == "top":
            break
    if rng.random() < 0.5 and place != "top":
        switches.append(MovablePart("spout", "revolute", spout, (0.0, 0.0, height), TOP, np.pi / 2))
        spout = ()
    return ObjectModel("SwanFaucet", "faucet_base", body + spout, tuple(switches))


def _swan(height: float, heading: float, radius: float, rng: np.random.Generator) -> Pieces:
    """A pipe from the column's top that rises and bends, or that slants."""
    out = np.array([-np.cos(heading), -np.sin(heading), 0.0])
    if rng.random() < 0.7:
        rise, bend = float(rng.uniform(0.1, 0.9)), float(rng.uniform(0.1, 0.3))
        angles = np.linspace(0.0, np.pi * float(rng.uniform(0.6, 1.0)), 9)
        bow = [out * bend * (1 - np.cos(a)) + [0.0, 0.0, height + rise + bend * np.sin(a)] for a in angles]
        last = bow[-1] + (bow[-1] - bow[-2]) * float(rng.uniform(0.5, 3.0))
        points = [np.array([0.0, 0.0, height + 0.002]), *bow, last]
    else:
        far = float(rng.uniform(0.3, 0.9))
        tip = out * far + [0.0, 0.0, height + far * float(rng.uniform(-0.1, 0.7))]
        points = [np.array([0.0, 0.0, height + 0.002]), tip, tip - [0.0, 0.0, float(rng.uniform(0.03, 0.15))]]
    return tuple(rod(point(start), point(end), radius, sides=10) for start, end in pairwise(points))


def random_flush_box(rng: np.random.Generator) -> ObjectModel:
    """A box of thin board whose flaps or front wall end with its walls, with gaps that cannot be seen."""
    width, depth, height = (float(size) for size in rng.uniform((0.4, 0.4, 0.12), (1.2, 1.2, 1.1)))
    wall, gap = float(rng.uniform(0.006, 0.02)), float(rng.uniform(0.0003, 0.003))
    half, opens, low, high = width / 2, float(rng.uniform(1.5, 2.8)), height + gap, height + gap + wall
    case = rng.choice(["lid", "sides", "ends", "four", "walls"], p=[0.15, 0.3, 0.15, 0.25, 0.15])
    if case == "walls":
        walls = [(0.0, wall, FRONT)] + ([(depth - wall, depth, BACK)] if rng.random() < 0.5 else [])
        body = hollow_box((0.0, -half, 0.0), (depth, half, height), wall, (TOP, *(way for *_, way in walls)))
        pieces = [((block((a, -half, gap), (b, half, height)),), a if way == FRONT else b, way) for a, b, way in walls]
        parts = [hinged("wall", plate, (x, 0.0, gap), BOTTOM, way, 1.5) for plate, x, way in pieces]
        return ObjectModel("FlushBox", "box_body", body, tuple(parts))
    body = hollow_box((0.0, -half, 0.0), (depth, half, height), wall, (TOP,))
    short = 1.0 if rng.random() < 0.6 else float(rng.uniform(0.4, 0.95))
    end = float(rng.uniform(0.15, 0.4)) * depth if case == "four" else 0.0
    flaps: list[tuple[Point, Point, Point]] = []
    if case == "lid":
        flaps = [((0.0, -half, low), (depth, half, high), BACK)]
    if case in ("sides", "four"):
        reach, front, back = short * half - gap, end + gap, depth - end - gap
        flaps += [
            ((front, half - reach, low), (back, half, high), LEFT),
            ((front, -half, low), (back, reach - half, high), RIGHT),
        ]
    if case in ("ends", "four"):
        reach = end or short * depth / 2 - gap
        flaps += [
            ((0.0, -half, low), (reach, half, high), FRONT),
            ((depth - reach, -half, low), (depth, half, high), BACK),
        ]
    parts = []
    for least, most, edge in flaps:
        corner = (np.add(least, most) + np.multiply(edge, np.subtract(most, least))) / 2
        parts.append(hinged("rotation_lid", (block(least, most),), (corner[0], corner[1], high), edge, TOP, opens))
    return ObjectModel("FlushBox", "box_body", body, tuple(parts))
