"""Tasks: a primitive, the parts that it acts on, start states, and hidden dynamics; and categories of objects.

The paper's tasks are built in. Packages add others by entry points of the group "adaafford.tasks", and a TOML file that
is named on the command line defines one of its own (docs/extending.md).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from shared.config import CollectionConfig, DynamicsRanges, Name, StrictModel, load_toml, parse
from shared.errors import UsageError
from shared.extensions import Registry
from shared.primitives import PRIMITIVES
from shared.types import Direction

Word = Annotated[str, Field(min_length=1, max_length=64)]
Words = Annotated[tuple[Word, ...], Field(max_length=1000)]
TASK_FILE_SUFFIX = ".toml"
"""What tells a file that defines a task from the name of one."""


@dataclass(frozen=True, slots=True)
class Terms:
    """The settings of a configuration, completed by those of its task.

    Attributes:
        primitive: name of the primitive.
        dynamics: ranges of the hidden parameters.
        edge_share: share of random actions at points near a part's edge.
    """

    primitive: str
    dynamics: DynamicsRanges
    edge_share: float


class Task(StrictModel):
    """One manipulation task."""

    name: Name
    """What flags and rows call it."""
    primitive: Name
    """Name of the primitive that the gripper executes."""
    categories: Words = ()
    """The only categories that it applies to; empty: all."""
    part_names: Words = ()
    """A movable part qualifies if its semantic name contains one of these; empty: all."""
    revolute_only: bool = False
    """Whether only turning joints qualify."""
    closed: bool = False
    """Whether every joint starts at its lower limit, instead of the published mixture of states."""
    directions: Annotated[tuple[Direction, ...], Field(min_length=1, max_length=16)] = (Direction.AS_BUILT,)
    """The modes that a rollout's `HiddenDynamics.direction` is drawn from."""
    dynamics: DynamicsRanges = DynamicsRanges()
    """Ranges of the hidden dynamics."""
    edge_share: float = Field(0.0, ge=0, le=1)
    """Share of random actions at points near a part's edge. As published it is 0 throughout; most pulls in the middle
    of a panel pinch nothing, so that half of them there doubles the positives."""

    def terms(self, collection: CollectionConfig) -> Terms:
        """The terms of a collection; settings that `collection` leaves out are the task's."""
        share = collection.rollout.edge_share
        return Terms(
            primitive=collection.primitive or self.primitive,
            dynamics=collection.dynamics or self.dynamics,
            edge_share=self.edge_share if share is None else share,
        )

    def resolve(self, collection: CollectionConfig) -> CollectionConfig:
        """`collection` completed by the task, so that a store records all settings.

        Raises:
            UsageError: a hidden parameter is named whose package is not installed.
        """
        terms = self.terms(collection)
        terms.dynamics.check_known()
        return collection.model_copy(
            update={
                "primitive": terms.primitive,
                "dynamics": terms.dynamics,
                "rollout": collection.rollout.model_copy(update={"edge_share": terms.edge_share}),
            }
        )


TASKS = Registry(
    "task",
    Task,
    {
        task.name: task
        for task in (
            Task(name="push", primitive="push"),
            Task(name="pull", primitive="pull", edge_share=0.5),
            Task(
                name="pull-closed-door",
                primitive="pull",
                categories=("StorageFurniture", "Cabinet"),
                part_names=("door",),
                revolute_only=True,
                closed=True,
                edge_share=0.5,
            ),
            Task(
                name="push-faucet",
                primitive="push",
                categories=("Faucet",),
                part_names=("switch",),
                revolute_only=True,
                closed=True,
                directions=(Direction.BOTH, Direction.CLOCKWISE, Direction.COUNTER_CLOCKWISE),
            ),
        )
    },
)
"""The paper's tasks, and those of other packages."""


def task_named(name: str) -> Task:
    """The task called `name`.

    Raises:
        UsageError: there is no such task; the message lists the known ones.
    """
    task = TASKS.get(name)
    if task.name != name:
        raise UsageError(f"{TASKS.package_of(name)}: the task '{name}' calls itself '{task.name}'; give both one name")
    return task


def task_of(told: str) -> Task:
    """The task of a name, or of a TOML file; raises as `task_named` and `read_task`."""
    return read_task(Path(told)) if told.endswith(TASK_FILE_SUFFIX) else task_named(told)


def read_task(file: Path) -> Task:
    """The task that a TOML file defines, with the fields of `Task`.

    Raises:
        UsageError: the file is missing, or a setting is missing, unknown or not allowed, or the name is taken.
    """
    task = parse(Task, load_toml(file), str(file))
    if task.primitive not in PRIMITIVES.names():
        allowed = ", ".join(PRIMITIVES.names())
        raise UsageError(f"{file}: unknown primitive '{task.primitive}'; allowed: {allowed}")
    if task.name in TASKS.names():
        raise UsageError(f"{file}: there is already a task '{task.name}'; choose another name")
    return task


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
