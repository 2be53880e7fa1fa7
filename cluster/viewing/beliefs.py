"""What policies believe of an object after the first interactions of a rollout, as colours of its points.

Shapes: N points of a cloud.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from adaafford.heatmaps import blended
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.adaptation import Adapter, movable_points
from shared.policies.policy import Policy
from shared.types import Float32, Interaction, Observation, Role

TOLD = (Role.COLLECT, Role.CONTEXT, Role.CONTEXT_BY_SHARE)
"""Interactions that a policy may be told; the others of an evaluation measure it."""
BODY = (150, 155, 162)
_VIRIDIS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
_DIVERGING = ((30, 80, 200), (205, 205, 205), (210, 30, 30))
_PARTS = ((31, 119, 180), (255, 127, 14), (44, 160, 44), (148, 103, 189), (140, 86, 75), (227, 119, 194))

Range = tuple[float, float]
Colours = NDArray[np.uint8]


class Quantity(StrEnum):
    """What the colour of a point says."""

    PARTS = "parts"
    """The part of the point; parts that the task does not move are pale."""
    AFFORDANCE = "affordance"
    """A_I, adapted to the known interactions."""
    CHANGE = "change of affordance"
    """A_I less the affordance without interactions."""
    PRIOR = "prior affordance"
    """Where2Act's, which knows no interaction."""
    INFORMATION = "value of interaction"
    """AIP's actionability: where the next interaction tells most."""


def told_before(rollout: RolloutRecord, row: InteractionRecord) -> tuple[list[Interaction], int]:
    """The interactions that the method of a row may be told, and how many of them came before the row."""
    rows = [
        each
        for each in rollout.interactions
        if each.role in TOLD and each.method == row.method and each.outcome.kind.is_label
    ]
    history = [Interaction(rollout.observations[each.observation], each.action, each.outcome) for each in rows]
    return history, sum(each.step < row.step for each in rows)


class Beliefs:
    """Predictions of some policies on one cloud at a time, each computed when it is first asked for.

    Args:
        policies: by name, each loaded when it is first used.
    """

    def __init__(self, policies: Mapping[str, Callable[[], Policy]]) -> None:
        self.names = tuple(policies)
        self._policies = policies
        self._adapters = dict[str, Adapter]()
        self._observation: Observation | None = None
        self._history = list[Interaction]()
        self._values = dict[tuple[str, Quantity, int], Float32]()

    def policy(self, name: str) -> Policy:
        """A policy; raises what its loading does."""
        return self._adapter(name).policy

    def look_at(self, observation: Observation, history: Sequence[Interaction]) -> None:
        """Choose the cloud, and the interactions of which policies know the first ones."""
        if observation is not self._observation or [*map(id, history)] != [*map(id, self._history)]:
            self._observation, self._history = observation, list(history)
            self._values.clear()

    def values(self, name: str, quantity: Quantity, known: int) -> Float32:
        """A quantity, [N], of a policy that knows the first interactions; 0 where the task moves nothing.

        Raises:
            UsageError: the networks cannot be asked about this cloud.
        """
        key = (name, quantity, 0 if quantity is Quantity.PRIOR else known)
        if key not in self._values:
            self._values[key] = self._computed(name, quantity, known)
        return self._values[key]

    def range_of(self, names: Sequence[str], quantity: Quantity) -> Range:
        """The range of colours: one for all policies and numbers of interactions, so that colours can be compared."""
        assert self._observation is not None
        ends = [self.values(name, quantity, known) for name in names for known in (0, len(self._history))]
        shown = np.concatenate([values[self._observation.movable] for values in ends])
        if quantity is Quantity.CHANGE:
            reach = max(float(np.abs(shown).max()), 1e-3)
            return -reach, reach
        low, high = float(shown.min()), float(shown.max())
        return low, max(high, low + 1e-3)

    def _computed(self, name: str, quantity: Quantity, known: int) -> Float32:
        assert self._observation is not None, "look_at comes first"
        adapter, observation, history = self._adapter(name), self._observation, self._history[:known]
        values = np.zeros(len(observation.points), np.float32)
        points = movable_points(observation)
        match quantity:
            case Quantity.PRIOR:
                values[points] = adapter.prior_affordance(observation, points)
            case Quantity.CHANGE:
                values = self.values(name, Quantity.AFFORDANCE, known) - self.values(name, Quantity.AFFORDANCE, 0)
            case Quantity.INFORMATION:
                adapter.policy.require("aip")
                values[points] = adapter.information(observation, points, adapter.z(history))
            case _:
                values[points] = adapter.affordance(observation, history, points=points)
        return values

    def _adapter(self, name: str) -> Adapter:
        if name not in self._adapters:
            self._adapters[name] = Adapter(self._policies[name]())
        return self._adapters[name]


def part_colours(observation: Observation) -> Colours:
    """Colours of the points by part, [N, 3]; what the task does not move is pale."""
    palette = np.array(_PARTS)[(observation.part_ids.astype(np.int64) - 1) % len(_PARTS)]
    pale = (palette + 2 * np.array(BODY)) // 3
    coloured = np.where(observation.movable[:, None], palette, pale)
    return np.where(observation.part_ids[:, None] > 0, coloured, BODY).astype(np.uint8)


def value_colours(values: Float32, within: Range, movable: NDArray[np.bool_], quantity: Quantity) -> Colours:
    """Colours of values, [N, 3]; points that the task does not move are grey."""
    low, high = within
    stops = _DIVERGING if quantity is Quantity.CHANGE else _VIRIDIS
    shown = blended(stops, (values.astype(np.float64) - low) / (high - low))
    return np.where(movable[:, None], shown, BODY).astype(np.uint8)
