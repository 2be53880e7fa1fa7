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
    """`names`, of which one may hold several with commas; "train" and "test" stand for the paper's; each once."""
    single = (part for name in names for part in name.split(",") if part)
    return tuple(dict.fromkeys(category for name in single for category in GROUPS.get(name, (name,))))
