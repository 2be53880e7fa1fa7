"""Which categories there are, one object of each from a seed, and folders of them."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from collector.objects.model import ObjectModel
from collector.objects.procedural.appliances import (
    random_button_cabinet,
    random_handle_cabinet,
    random_microwave,
    random_washing_machine,
)
from collector.objects.procedural.cabinets import random_refrigerator, random_safe, random_table_or_desk
from collector.objects.procedural.containers import (
    random_box,
    random_bucket,
    random_kettle,
    random_kitchen_pot,
    random_trash_can,
)
from collector.objects.procedural.faucets import random_faucet
from collector.objects.procedural.fitted import random_cabinet
from collector.objects.procedural.mixed import random_flush_box, random_mixed_front, random_swan_faucet
from collector.objects.procedural.openings import random_door, random_switch, random_window
from collector.objects.procedural.shapes import normalised
from collector.objects.writing import write_object
from shared.errors import UsageError
from shared.io.files import remove_remnants, writing
from shared.io.text import short
from shared.seeds import generator
from shared.tasks import Task

CATEGORIES: Mapping[str, Callable[[np.random.Generator], ObjectModel]] = {
    "StorageFurniture": random_cabinet,
    "Faucet": random_faucet,
    "Box": random_box,
    "Microwave": random_microwave,
    "Refrigerator": random_refrigerator,
    "Door": random_door,
    "TrashCan": random_trash_can,
    "Kettle": random_kettle,
    "Switch": random_switch,
    "Window": random_window,
    "Table": random_table_or_desk,
    "WashingMachine": random_washing_machine,
    "Bucket": random_bucket,
    "KitchenPot": random_kitchen_pot,
    "Safe": random_safe,
}
"""The paper's fifteen, called as PartNet-Mobility calls them."""
EVERY_CATEGORY = {
    **CATEGORIES,
    "ButtonCabinet": random_button_cabinet,
    "HandleCabinet": random_handle_cabinet,
    "MixedFront": random_mixed_front,
    "SwanFaucet": random_swan_faucet,
    "FlushBox": random_flush_box,
}
"""With those that are only made where a task or a command names them."""


def categories_of(task: Task) -> list[str]:
    """The categories that a task applies to: those that it names, or the paper's."""
    return [name for name in EVERY_CATEGORY if name in (task.categories or CATEGORIES)]


def build(category: str, seed: int, index: int) -> ObjectModel:
    """Object number `index` of a category: a pure function of its arguments, whatever else is made."""
    return normalised(EVERY_CATEGORY[category](generator(seed, f"procedural {category}", index)))


def generate(out: Path, counts: Mapping[str, int], seed: int) -> list[Path]:
    """Write `counts[category]` objects of each category below `out`; what is there already is kept.

    Object number i of a category depends on the seed, the category and i alone. An object appears whole or not at all.

    Args:
        out: folder of objects; made if need be.
        counts: how many of each category of `EVERY_CATEGORY`.
        seed: of the whole collection, non-negative.

    Returns:
        The objects' folders, category by category.

    Raises:
        UsageError: an unknown category, a negative count or seed, or a folder that cannot be written or holds another
            object of the same name.
    """
    unknown = sorted(set(counts) - set(EVERY_CATEGORY))
    if unknown:
        raise UsageError(f"unknown category {short(unknown[0])}; allowed: {', '.join(EVERY_CATEGORY)}")
    if seed < 0 or min(counts.values(), default=0) < 0:
        raise UsageError(f"seed and counts must not be negative; given seed {seed}, counts {dict(counts)}")
    with writing(out, "name a folder that can"):
        out.mkdir(parents=True, exist_ok=True)
        remove_remnants(out)
        return [
            write_object(out / f"{category.lower()}-{index:04d}", build(category, seed, index))
            for category, count in counts.items()
            for index in range(count)
        ]
