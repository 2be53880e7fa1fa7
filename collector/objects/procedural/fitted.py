"""Fitted cabinets, as kitchens have them: wall, base and tall units, with doors in a grid, flaps, frames and knobs.

They follow what the cabinets of PartNet-Mobility have and those of `collector.objects.procedural.cabinets` lack: doors
whose free edges meet or end flush with the carcass, framed panels, knobs and short bars in a corner, flaps that turn
about their upper edge, fronts that a door covers in part, toe kicks, missing tops and overhanging ones. Lengths are
metres before `normalised` scales the object.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from collector.objects.model import MovablePart, ObjectModel, Pieces, Point
from collector.objects.procedural.cabinets import Carcass, FrontPanel, random_storage_furniture
from collector.objects.procedural.shapes import (
    BACK,
    BOTTOM,
    FRONT,
    LEFT,
    RIGHT,
    TOP,
    block,
    either,
    grip,
    hinged,
    hollow_box,
    rod,
)

WALL = 0.018
CLEAR = 0.003
"""Between a leaf and the carcass behind it."""
TOE_KICK = (0.09, 0.06)
"""Height of a base unit's recess at the floor, and its depth."""

Hinge = Literal["left", "right", "top"]


@dataclass(frozen=True, slots=True)
class Style:
    """What all leaves of one unit have in common.

    Attributes:
        face: of a leaf: flat, or with a panel that is raised from its frame or recessed in it.
        border: width of that frame.
        relief: how far panel and frame differ.
        handle: what a leaf carries.
        thickness: of a leaf.
        reveal: how far a leaf ends before its cell; leaves of neighbouring cells have twice that between them.
    """

    face: Literal["flat", "raised", "recessed"]
    border: float
    relief: float
    handle: Literal["none", "bar", "knob"]
    thickness: float
    reveal: float


@dataclass(frozen=True, slots=True)
class _Leaf:
    """A door or a flap: its cell, and the edge that it turns about, seen from the front."""

    y: tuple[float, float]
    z: tuple[float, float]
    hinge: Hinge


def random_cabinet(rng: np.random.Generator) -> ObjectModel:
    """A free-standing cabinet or a fitted one, equally often."""
    return either(rng, random_storage_furniture, random_fitted_cabinet)


def random_fitted_cabinet(rng: np.random.Generator) -> ObjectModel:
    """A wall, base or tall unit."""
    kind = rng.choice(["wall", "base", "tall"], p=[0.45, 0.35, 0.2])
    sizes = {"wall": (0.3, 1.1, 0.35, 0.95), "base": (0.3, 1.0, 0.65, 0.8), "tall": (0.35, 0.65, 1.2, 1.8)}[kind]
    width, height = float(rng.uniform(*sizes[:2])), float(rng.uniform(*sizes[2:]))
    depth = float(rng.uniform(0.28, 0.38) if kind == "wall" else rng.uniform(0.4, 0.6))
    opens = float(rng.uniform(1.4, 2.0))
    style = random_style(rng)
    carcass = Carcass(width, depth, height, WALL, style.thickness, 0.0, opens)

    half = width / 2
    covered = (-half + (width * float(rng.uniform(0.25, 0.45)) if rng.random() < 0.15 else 0.0), half)
    columns = _shares(covered, 2 if covered[1] - covered[0] > 0.45 and rng.random() < 0.75 else 1, None)
    top = height - float(rng.uniform(0.14, 0.2)) if kind == "base" and rng.random() < 0.35 else height
    rows = _shares((0.0, top), 2 if height > 0.75 and rng.random() < 0.55 else 1, float(rng.uniform(0.3, 0.6)))
    flap = kind == "wall" and covered[1] - covered[0] > rows[0][1] - rows[0][0] and rng.random() < 0.6
    if flap and rng.random() < 0.6:
        columns = [covered]
    side: Hinge = "left" if rng.random() < 0.5 else "right"
    leaves = [
        _Leaf(y, z, "top" if flap else side if len(columns) == 1 else ("right" if y[0] == covered[0] else "left"))
        for z in rows
        for y in columns
    ]
    high_handles = kind == "base" or (kind == "tall" and rng.random() < 0.5)
    parts = [_leaf_part(leaf, style, opens, high_handles) for leaf in leaves]
    if top < height:
        parts += carcass.front([FrontPanel("drawer", (-half, half), (top, height), style.handle != "none")])
    body = _shell(width, depth, height, kind == "base", rng)
    body += tuple(
        block((0.0, -half + WALL, z[0] - WALL / 2), (depth - WALL, half - WALL, z[0] + WALL / 2)) for z in rows[1:]
    )
    if covered[0] > -half and rng.random() < 0.5:
        body += (block((-style.thickness, -half, 0.0), (0.0, covered[0] - style.reveal, height)),)
    return ObjectModel("StorageFurniture", "furniture_body", body, tuple(parts))


def random_style(rng: np.random.Generator) -> Style:
    """Half of the fronts are flat; two in five have no handle."""
    return Style(
        face=rng.choice(["flat", "raised", "recessed"], p=[0.5, 0.3, 0.2]),
        border=float(rng.uniform(0.04, 0.07)),
        relief=float(rng.uniform(0.005, 0.012)),
        handle=rng.choice(["none", "bar", "knob"], p=[0.4, 0.4, 0.2]),
        thickness=float(rng.uniform(0.016, 0.024)),
        reveal=float(rng.uniform(0.001, 0.003) if rng.random() < 0.65 else rng.uniform(0.008, 0.02)),
    )


def _shares(span: tuple[float, float], count: int, share: float | None) -> list[tuple[float, float]]:
    """A span cut once, at a share of it or in the middle, or not at all."""
    cut = span[0] + (0.5 if share is None else share) * (span[1] - span[0])
    return list(pairwise([span[0], cut, span[1]] if count == 2 else span))


def _shell(width: float, depth: float, height: float, base: bool, rng: np.random.Generator) -> Pieces:
    """The carcass, with a toe kick below and perhaps no top if it is of a base unit, or a top that overhangs."""
    half = width / 2
    open_top = base and rng.random() < 0.5
    pieces = hollow_box((0.0, -half, 0.0), (depth, half, height), WALL, (FRONT, TOP) if open_top else (FRONT,))
    if base:
        kick, recess = TOE_KICK
        pieces += hollow_box((recess, -half, -kick), (depth, half, 0.0), WALL, (TOP, BOTTOM))
    if not open_top and rng.random() < 0.2:
        over = float(rng.uniform(0.02, 0.05))
        pieces += (block((-over, -half - over, height), (depth, half + over, height + 0.03)),)
    return pieces


def _leaf_part(leaf: _Leaf, style: Style, opens: float, high_handle: bool) -> MovablePart:
    """A door or a flap, closed; its handle is in the corner of its free edge."""
    low: Point = (-CLEAR - style.thickness, leaf.y[0] + style.reveal, leaf.z[0] + style.reveal)
    high: Point = (-CLEAR, leaf.y[1] - style.reveal, leaf.z[1] - style.reveal)
    pieces: Pieces = (block(low, high), *relief_on(low, high, style))
    face = low[0] - (style.relief if style.face == "recessed" else 0.0)
    inset = 0.5 * style.border
    middle = (low[1] + high[1]) / 2, (low[2] + high[2]) / 2
    if leaf.hinge == "top":
        pieces += handle_on((face, middle[0], low[2] + inset), LEFT, style, 0.3 * (high[1] - low[1]))
        return hinged("tilt_door", pieces, (face, middle[0], high[2]), TOP, FRONT, opens)
    left = leaf.hinge == "left"
    length = min(0.2, 0.3 * (high[2] - low[2]))
    y = low[1] + inset if left else high[1] - inset
    z = high[2] - inset - length / 2 if high_handle else low[2] + inset + length / 2
    pieces += handle_on((face, y, z), TOP, style, length)
    corner = (face, high[1] if left else low[1], middle[1])
    return hinged("rotation_door", pieces, corner, LEFT if left else RIGHT, FRONT, opens)


def relief_on(low: Point, high: Point, style: Style) -> Pieces:
    """What lies on the plate of a leaf from `low` to `high`: a raised panel, or the frame of a recessed one."""
    border = min(style.border, 0.25 * (high[1] - low[1]), 0.25 * (high[2] - low[2]))
    front = (low[0] - style.relief, low[1], low[2])
    match style.face:
        case "raised":
            inner = (front[0], low[1] + border, low[2] + border), (low[0], high[1] - border, high[2] - border)
            return (block(*inner),)
        case "recessed":
            return hollow_box(front, (low[0], high[1], high[2]), border, (FRONT, BACK))
        case _:
            return ()


def handle_on(centre: Point, along: Point, style: Style, length: float) -> Pieces:
    """A handle on a surface: `centre` is on it, and a bar is `length` long."""
    x, y, z = centre
    match style.handle:
        case "bar":
            return grip(centre, along, FRONT, max(length, 0.05), 0.03, 0.005)
        case "knob":
            stem = rod((x, y, z), (x - 0.015, y, z), 0.006, sides=8)
            return (stem, rod((x - 0.015, y, z), (x - 0.028, y, z), 0.009, 0.014, sides=10))
        case _:
            return ()
