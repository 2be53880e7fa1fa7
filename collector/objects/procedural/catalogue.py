"""Which categories there are, and one object of each from a seed."""

from collections.abc import Callable, Mapping

import numpy as np

from collector.objects.model import ObjectModel
from collector.objects.procedural.appliances import random_microwave, random_washing_machine
from collector.objects.procedural.assembly import normalised
from collector.objects.procedural.cabinets import (
    random_refrigerator,
    random_safe,
    random_table,
)
from collector.objects.procedural.containers import (
    random_box,
    random_bucket,
    random_kettle,
    random_kitchen_pot,
    random_trash_can,
)
from collector.objects.procedural.faucets import random_faucet
from collector.objects.procedural.fitted import random_cabinet
from collector.objects.procedural.latched import random_button_cabinet, random_handle_cabinet
from collector.objects.procedural.openings import random_door, random_switch, random_window
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
    "Table": random_table,
    "WashingMachine": random_washing_machine,
    "Bucket": random_bucket,
    "KitchenPot": random_kitchen_pot,
    "Safe": random_safe,
}
"""The paper's fifteen, called as PartNet-Mobility calls them."""
EVERY_CATEGORY = {**CATEGORIES, "ButtonCabinet": random_button_cabinet, "HandleCabinet": random_handle_cabinet}
"""With those that are only made where a task or a command names them."""


def categories_of(task: Task) -> list[str]:
    """The categories that a task applies to: those that it names, or the paper's."""
    return [name for name in EVERY_CATEGORY if name in (task.categories or CATEGORIES)]


def build(category: str, seed: int, index: int) -> ObjectModel:
    """Object number `index` of a category: a pure function of its arguments, whatever else is made."""
    return normalised(EVERY_CATEGORY[category](generator(seed, f"procedural {category}", index)))
