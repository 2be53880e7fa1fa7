"""The scene of a stored interaction, as it was when the hand was placed."""

import numpy as np

from collector.objects.articulation import ArticulatedObject
from collector.sim.scene import Scene
from shared.config import SAPIEN, CollectionConfig
from shared.errors import UsageError
from shared.plan import InteractionRecord, RolloutRecord
from shared.primitives import PRIMITIVES
from shared.types import Direction, Float, OutcomeKind


def restored(
    target: ArticulatedObject, collection: CollectionConfig, rollout: RolloutRecord, row: InteractionRecord
) -> Scene:
    """A scene of its own in which a stored interaction can be executed again.

    Args:
        target: the rollout's object.
        collection: of the store's setting.
        rollout: one of the store.
        row: one of its interactions.

    Raises:
        UsageError: another simulator made the store, or the arm did not reach the action.
    """
    refuse_other_simulators(collection)
    if row.outcome.kind is OutcomeKind.UNREACHABLE:
        raise UsageError(f"interaction {row.step} was not executed, because the arm cannot reach it; choose another")
    primitive = PRIMITIVES.get(row.primitive)
    scene = Scene(target, rollout.dynamics, collection.fidelity, primitive, collection.gripper)
    if rollout.dynamics.direction is not Direction.AS_BUILT:
        scene.restrict(first_positions(row.joint_limits, rollout.dynamics.direction))
    scene.put(row.joint_positions)
    return scene


def refuse_other_simulators(collection: CollectionConfig) -> None:
    """Refuse to execute stored interactions again if another simulator than SAPIEN made them.

    Raises:
        UsageError: it did.
    """
    if collection.simulator != SAPIEN:
        raise UsageError(
            f"the store was made with the simulator '{collection.simulator}'; only SAPIEN executes rows again"
        )


def first_positions(limits: Float, direction: Direction) -> Float:
    """Where the joints stood when their limits were set, from the limits [parts, 2] that came of it."""
    match direction:
        case Direction.CLOCKWISE:
            positions = limits[:, 0]
        case Direction.COUNTER_CLOCKWISE:
            positions = limits[:, 1]
        case _:
            positions = limits.mean(axis=1)
    return np.asarray(positions, np.float64)
