"""The paper's tasks: which primitive, on which parts, from which states, under which hidden dynamics."""

from dataclasses import dataclass

from shared.configuration import CollectionConfig, DynamicsRanges
from shared.errors import UsageError
from shared.vocabulary import Direction


@dataclass(frozen=True, slots=True)
class Terms:
    """What a configuration says, or else its task: the one place where what is left to the task is looked up.

    Attributes:
        primitive: name of what trials execute.
        dynamics: what hidden dynamics are drawn from.
        edge_share: share of random actions at points near a part's edge.
    """

    primitive: str
    dynamics: DynamicsRanges
    edge_share: float


@dataclass(frozen=True, slots=True)
class Task:
    """One manipulation task.

    Attributes:
        name: what flags and rows call it.
        primitive: name of the gripper primitive that it executes.
        categories: the only categories that it applies to; empty: all.
        part_names: a movable part qualifies if its semantic name contains one of these; empty: all.
        revolute_only: whether only turning joints qualify.
        closed: whether every joint starts at its lower limit, instead of the published mixture of states.
        directions: the modes that a rollout's `HiddenDynamics.direction` is drawn from.
        dynamics: ranges of the hidden dynamics.
        edge_share: share of random actions at points near a part's edge. As published it is 0 throughout; most pulls in
            the middle of a panel pinch nothing, so that half of them there doubles the positives.
    """

    name: str
    primitive: str
    categories: tuple[str, ...] = ()
    part_names: tuple[str, ...] = ()
    revolute_only: bool = False
    closed: bool = False
    directions: tuple[Direction, ...] = (Direction.AS_BUILT,)
    dynamics: DynamicsRanges = DynamicsRanges()
    edge_share: float = 0.0

    def terms(self, collection: CollectionConfig) -> Terms:
        """What holds under `collection`, which may leave some of it to the task."""
        share = collection.rollout.edge_share
        return Terms(
            primitive=collection.primitive or self.primitive,
            dynamics=collection.dynamics or self.dynamics,
            edge_share=self.edge_share if share is None else share,
        )

    def resolve(self, collection: CollectionConfig) -> CollectionConfig:
        """`collection` with what it leaves to the task filled in, so that a store says all that was decided.

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


TASKS = {
    task.name: task
    for task in (
        Task("push", "push"),
        Task("pull", "pull", edge_share=0.5),
        Task(
            "pull-closed-door",
            "pull",
            categories=("StorageFurniture", "Cabinet"),
            part_names=("door",),
            revolute_only=True,
            closed=True,
            edge_share=0.5,
        ),
        Task(
            "push-faucet",
            "push",
            categories=("Faucet",),
            part_names=("switch",),
            revolute_only=True,
            closed=True,
            directions=(Direction.BOTH, Direction.CLOCKWISE, Direction.COUNTER_CLOCKWISE),
        ),
    )
}


def task_named(name: str) -> Task:
    """The task called `name`.

    Raises:
        UsageError: there is no such task; the message lists those there are.
    """
    if name not in TASKS:
        raise UsageError(f"unknown task '{name}'; allowed: {', '.join(TASKS)}")
    return TASKS[name]
