"""The paper's fifteen categories of objects, called as PartNet-Mobility calls them, and which of them it trains on."""

from collections.abc import Iterable

TRAIN_CATEGORIES = (
    "StorageFurniture",
    "Faucet",
    "Box",
    "Microwave",
    "Refrigerator",
    "Door",
    "TrashCan",
    "Kettle",
    "Switch",
    "Window",
)
"""Some shapes of each are trained on; the others are tested on."""
TEST_CATEGORIES = ("Table", "WashingMachine", "Bucket", "KitchenPot", "Safe")
"""Never trained on."""
GROUPS = {"train": TRAIN_CATEGORIES, "test": TEST_CATEGORIES}
"""Names that stand for several categories."""


def expanded(names: Iterable[str]) -> tuple[str, ...]:
    """`names` with "train" and "test" replaced by the paper's categories, each once."""
    return tuple(dict.fromkeys(category for name in names for category in GROUPS.get(name, (name,))))
