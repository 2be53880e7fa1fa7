"""Interactions chosen by their value of information, as a reference for AIP: AAP alone says which would help the most.

For each of some candidate actions AAP imagines a success and a failure, reads it as if it had happened, and is asked
how likely the best candidates would then succeed. The candidate is proposed for which this is highest in expectation.
Nothing is trained for it. Not in the paper (compare Howard, 1966: Information value theory).

Shapes: C candidate actions, each at a point of its own.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shared.policies.adaptation import Adapter, Proposals, movable_points, reachable_action
from shared.policies.methods import ProposerKind
from shared.policies.proposers import TOP_POINTS, best_points
from shared.types import Action, Interaction, Observation

CANDIDATES = 32
"""Half of them among the points that AAP thinks most of, the others anywhere."""
BEST = 6
"""The value is the mean belief in so many candidates."""
USUAL_MOTION = 0.03
"""m of an imagined success as long as none was seen, rad or length: the median at closed doors."""


class InformationValueProposer:
    """Proposes the action with the highest value of information; never stops."""

    name = "information-value"

    def __init__(self, adapter: Adapter, rng: np.random.Generator) -> None:
        self.adapter = adapter
        self.rng = rng

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next interaction; never None."""
        points = self._points(observation, history)
        latent = self.adapter.z(history)
        proposals = [self.adapter.proposals(observation, int(point), self.rng) for point in points]
        scores = [self.adapter.score_proposals(observation, each, latent) for each in proposals]
        frames = torch.stack([own.frames[int(s.argmax())] for own, s in zip(proposals, scores, strict=True)])
        values = self._values(observation, points, frames, history)

        def choose(left: NDArray[np.int64]) -> int:
            return int(left[values[torch.from_numpy(left)].argmax()])

        def act(point: int) -> tuple[Proposals, Tensor]:
            place = int(np.flatnonzero(points == point)[0])
            return proposals[place], scores[place]

        return reachable_action(observation, points, choose, act)

    def _points(self, observation: Observation, history: Sequence[Interaction]) -> NDArray[np.int64]:
        movable = movable_points(observation)
        actionability = self.adapter.affordance(observation, history, points=movable)
        actionable = best_points(movable, actionability, TOP_POINTS)
        drawn = np.concatenate([self.rng.permutation(actionable)[: CANDIDATES // 2], self.rng.permutation(movable)])
        _, first = np.unique(drawn, return_index=True)
        return drawn[np.sort(first)[:CANDIDATES]]

    def _values(
        self, observation: Observation, points: NDArray[np.int64], frames: Tensor, history: Sequence[Interaction]
    ) -> Tensor:
        """The expected mean of the best beliefs after each candidate, [C]."""
        moved = [interaction.outcome.motion for interaction in history if interaction.outcome.success]
        motion = float(np.median(moved)) if moved else USUAL_MOTION
        believed = self.adapter.beliefs(observation, points, frames, self.adapter.z(history)[None])[0]
        values = torch.zeros_like(believed)
        for odds, outcome in ((believed, (motion, True)), (1.0 - believed, (0.0, False))):
            latents = self.adapter.imagined(observation, points, frames, outcome, history)
            after = self.adapter.beliefs(observation, points, frames, latents)
            values += odds * after.topk(min(BEST, len(points)), dim=-1).values.mean(dim=-1)
        return values


INFORMATION_VALUE = ProposerKind(lambda adapter, rng, budget: InformationValueProposer(adapter, rng), ("prior", "aap"))
