"""Evaluation rollouts as one method lived them: its interactions in order, and what it did in the end."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.adaptation import Adapter
from shared.policies.methods import MethodName
from shared.store import Store
from shared.types import Interaction, Observation, Role

TOLD: MethodName = "ours-final"
"""The method whose episodes pictures show."""
MOST_TRIALS = 60
"""Looked at for pictures, at the most: each holds all clouds of its rollout, some megabytes."""
CANDIDATES = 40
"""Episodes among them that are asked for what their interactions changed."""


@dataclass(frozen=True, slots=True)
class EvaluationTrial:
    """What one method did with one object.

    Attributes:
        rollout: where it comes from.
        tries: rows of its interactions.
        exploits: rows of what its adapted affordance chose, one a budget.
    """

    rollout: RolloutRecord
    tries: tuple[InteractionRecord, ...]
    exploits: tuple[InteractionRecord, ...]

    @property
    def history(self) -> list[Interaction]:
        """The interactions as a proposer is told them."""
        return [Interaction(self.seen_by(row), row.action, row.outcome) for row in self.tries]

    def seen_by(self, row: InteractionRecord) -> Observation:
        """The observation that a row's action was chosen on."""
        return self.rollout.observations[row.observation]

    def before(self, exploit: InteractionRecord) -> list[Interaction]:
        """The interactions that came before an exploit."""
        return self.history[: exploit.budget]


def first_trials(evaluation: Store, most: int = MOST_TRIALS) -> list[EvaluationTrial]:
    """The first episodes of the method that pictures show; raises as `trials` does."""
    return list(islice(trials(evaluation, TOLD), most))


def trials(evaluation: Store, method: MethodName) -> Iterator[EvaluationTrial]:
    """The episodes of a method that tried anything, in order.

    Raises:
        StoreError: a shard is damaged or foreign.
    """
    for part in evaluation.parts():
        for rollout in evaluation.rollouts_of(part):
            own = [row for row in rollout.interactions if row.method == method]
            tries = tuple(row for row in own if row.role is Role.CONTEXT)
            if tries:
                yield EvaluationTrial(rollout, tries, tuple(row for row in own if row.role is Role.EXPLOIT))


def most_telling(found: list[EvaluationTrial], adapter: Adapter) -> EvaluationTrial | None:
    """The episode whose affordance its interactions changed the most; None where there is none."""
    return max(found[:CANDIDATES], key=lambda trial: _change(trial, adapter), default=None)


def _change(trial: EvaluationTrial, adapter: Adapter) -> float:
    """How much the interactions changed the affordance of movable points; more where an interaction succeeded."""
    history = trial.history
    observation = history[0].observation
    before, after = adapter.affordance(observation, []), adapter.affordance(observation, history)
    moved = np.abs(after - before)[observation.movable]
    return float(moved.mean()) + 0.1 * any(interaction.outcome.success for interaction in history)
