"""Vessels with lids and handles: Box, TrashCan, KitchenPot, Bucket, Kettle."""

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
    arch,
    block,
    either,
    hinged,
    hollow_box,
    moved,
    rod,
    sliding,
    tub,
)


def random_box(rng: np.random.Generator) -> ObjectModel:
    """A box with thick walls, or a carton or a chest, equally often."""
    return either(rng, _random_thick_box, _random_carton_or_chest)


def _random_carton_or_chest(rng: np.random.Generator) -> ObjectModel:
    return _random_chest(rng) if rng.random() < 0.35 else _random_carton(rng)


def _random_thick_box(rng: np.random.Generator) -> ObjectModel:
    """A box with one lid hinged at the back, or two flaps that meet in the middle."""
    width, depth, height = float(rng.uniform(0.9, 1.3)), float(rng.uniform(0.7, 1.1)), float(rng.uniform(0.5, 0.9))
    body = hollow_box((0.0, -width / 2, 0.0), (depth, width / 2, height), 0.03, (TOP,))
    overhang, opens = float(rng.uniform(0.02, 0.04)), float(rng.uniform(1.6, 2.2))
    low, high = (-overhang, -width / 2 - overhang, height + GAP), (depth, width / 2 + overhang, height + GAP + 0.03)
    if rng.random() < 0.5:
        lids: tuple[MovablePart, ...] = (_lid(low, high, BACK, opens),)
    else:
        lids = (
            _lid((low[0], GAP / 2, low[2]), high, LEFT, opens),
            _lid(low, (high[0], -GAP / 2, high[2]), RIGHT, opens),
        )
    return ObjectModel("Box", "box_body", body, lids)


def _random_carton(rng: np.random.Generator) -> ObjectModel:
    """A box of thin board with two or four flaps, which leave the middle open if they are short."""
    width, depth, height = (float(size) for size in rng.uniform((0.5, 0.4, 0.25), (1.3, 1.1, 1.0)))
    wall = float(rng.uniform(0.01, 0.02))
    body = hollow_box((0.0, -width / 2, 0.0), (depth, width / 2, height), wall, (TOP,))
    four, opens = bool(rng.random() < 0.6), float(rng.uniform(1.8, 2.8))
    reach = float(rng.uniform(0.25, 0.5)) * width - GAP / 2
    low, high = height + GAP, height + GAP + wall

    def at_sides(end: float) -> tuple[MovablePart, ...]:
        front, back = end + GAP, depth - end - GAP
        return (
            _lid((front, width / 2 - reach, low), (back, width / 2, high), LEFT, opens),
            _lid((front, -width / 2, low), (back, reach - width / 2, high), RIGHT, opens),
        )

    def at_ends(end: float) -> tuple[MovablePart, ...]:
        return (
            _lid((0.0, -width / 2, low), (end, width / 2, high), FRONT, opens),
            _lid((depth - end, -width / 2, low), (depth, width / 2, high), BACK, opens),
        )

    if four:
        end = float(rng.uniform(0.15, 0.35)) * depth
        flaps = at_sides(end) + at_ends(end)
    else:
        flaps = at_ends(0.3 * depth) if rng.random() < 0.5 else at_sides(0.0)
    return ObjectModel("Box", "box_body", body, flaps)


def _random_chest(rng: np.random.Generator) -> ObjectModel:
    """A low case with compartments, whose hollow lid turns up at the back; perhaps a latch plate in front."""
    width, depth, height = (float(size) for size in rng.uniform((0.8, 0.5, 0.25), (1.3, 0.9, 0.5)))
    wall, rim = float(rng.uniform(0.02, 0.035)), float(rng.uniform(0.05, 0.2))
    body = hollow_box((0.0, -width / 2, 0.0), (depth, width / 2, height), wall, (TOP,))
    columns = np.linspace(-width / 2, width / 2, int(rng.integers(1, 5)) + 1)[1:-1]
    inner = float(rng.uniform(0.6, 0.9)) * height
    body += tuple(block((wall, y - 0.008, wall), (depth - wall, y + 0.008, inner)) for y in columns)
    bottom = height + GAP
    shell = hollow_box((0.0, -width / 2, bottom), (depth, width / 2, bottom + rim), wall, (BOTTOM,))
    if rng.random() < 0.5:
        shell += (block((-0.02, -0.06, bottom), (0.0, 0.06, bottom + 0.6 * rim)),)
    lid = hinged("rotation_lid", shell, (depth, 0.0, bottom), BACK, TOP, float(rng.uniform(1.2, 1.7)))
    return ObjectModel("Box", "box_body", body, (lid,))


def random_trash_can(rng: np.random.Generator) -> ObjectModel:
    """A bin, square or round, whose lid turns up at the back."""
    radius, height = float(rng.uniform(0.35, 0.5)), float(rng.uniform(1.0, 1.4))
    overhang, opens = float(rng.uniform(0.02, 0.04)), float(rng.uniform(1.3, 1.9))
    if rng.random() < 0.5:
        body = hollow_box((-radius, -radius, 0.0), (radius, radius, height), 0.03, (TOP,))
        reach = radius + overhang
        lid = _lid((-reach, -reach, height + GAP), (radius, reach, height + GAP + 0.05), BACK, opens)
    else:
        body = tub(0.85 * radius, radius, 0.0, height, 0.03)
        reach, top = radius + overhang, height + GAP + 0.05
        plate = rod((0.0, 0.0, height + GAP), (0.0, 0.0, top), reach, 0.95 * reach, sides=24)
        lid = hinged("rotation_lid", (plate,), (reach, 0.0, top), BACK, TOP, opens)
    return ObjectModel("TrashCan", "trashcan_body", body, (lid,))


def random_kitchen_pot(rng: np.random.Generator) -> ObjectModel:
    """A pot with two ears and a loose lid."""
    radius, height = float(rng.uniform(0.5, 0.65)), float(rng.uniform(0.4, 0.8))
    body = tub(0.95 * radius, radius, 0.0, height, 0.04)
    ears = tuple(
        block((-0.12, min(y, y + side * 0.16), height - 0.14), (0.12, max(y, y + side * 0.16), height - 0.1))
        for side in (-1.0, 1.0)
        for y in [side * (radius - 0.02)]
    )
    lid = sliding("lid", _round_lid(1.03 * radius, height), TOP, float(rng.uniform(0.15, 0.3)))
    return ObjectModel("KitchenPot", "pot_body", body + ears, (lid,))


def random_bucket(rng: np.random.Generator) -> ObjectModel:
    """A pail whose handle lies forward on its rim and turns up."""
    radius, height = float(rng.uniform(0.5, 0.65)), float(rng.uniform(0.7, 1.0))
    body = tub(float(rng.uniform(0.7, 0.85)) * radius, radius, 0.0, height, 0.03)
    pivot = (0.0, 0.0, height + 0.05)
    pins = tuple(
        block((-0.03, min(y, 1.12 * y), height - 0.08), (0.03, max(y, 1.12 * y), height + 0.08))
        for y in (radius, -radius)
    )
    handle = moved(arch(1.18 * radius, 0.025, lean=np.pi / 2), pivot)
    # Turned about +y, what lies towards -x rises.
    part = MovablePart("handle", "revolute", handle, pivot, LEFT, float(rng.uniform(1.5, 2.8)))
    return ObjectModel("Bucket", "bucket_body", body + pins, (part,))


def random_kettle(rng: np.random.Generator) -> ObjectModel:
    """A kettle: spout to the left, handle to the right, lid on top."""
    radius, height = float(rng.uniform(0.4, 0.5)), float(rng.uniform(0.6, 0.9))
    top = 0.7 * radius
    body = tub(radius, top, 0.0, height, 0.04)
    spout = rod((0.0, 0.8 * radius, 0.35 * height), (0.0, 1.5 * radius, 0.95 * height), 0.1, 0.05)
    posts = [(0.0, -1.35 * radius, z * height) for z in (0.25, 0.9)]
    handle = (
        rod((0.0, -0.8 * radius, 0.25 * height), posts[0], 0.035, sides=10),
        rod((0.0, -0.7 * radius, 0.9 * height), posts[1], 0.035, sides=10),
        rod(posts[0], posts[1], 0.04, sides=10),
    )
    lid = sliding("lid", _round_lid(0.97 * top, height), TOP, float(rng.uniform(0.1, 0.25)))
    return ObjectModel("Kettle", "kettle_body", (*body, spout, *handle), (lid,))


def _lid(low: Point, high: Point, edge: Point, opens: float) -> MovablePart:
    """A flat lid over an open top, turning up about the edge towards `edge`."""
    middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
    corner = middle + half * edge
    return hinged("rotation_lid", (block(low, high),), (float(corner[0]), float(corner[1]), high[2]), edge, TOP, opens)


def _round_lid(radius: float, height: float) -> Pieces:
    """A domed lid at `height`, with a knob to pinch."""
    base = height + GAP
    return (
        rod((0.0, 0.0, base), (0.0, 0.0, base + 0.06), radius, 0.8 * radius, sides=24),
        rod((0.0, 0.0, base + 0.06), (0.0, 0.0, base + 0.13), 0.025, sides=10),
        rod((0.0, 0.0, base + 0.13), (0.0, 0.0, base + 0.18), 0.06, sides=12),
    )
