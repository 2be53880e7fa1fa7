"""A task: push the lids of boxes and bins from any state, with heavier lids than elsewhere."""

from shared.config import DynamicsRanges, Range
from shared.tasks import Task

PUSH_LID = Task(
    name="push-lid",
    primitive="push",
    categories=("Box", "TrashCan"),
    part_names=("lid",),
    revolute_only=True,
    dynamics=DynamicsRanges(part_mass=Range(low=0.2, high=2.0, log=True)),
)
