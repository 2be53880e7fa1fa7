"""Interactions chosen by outcomes that AAP imagines, without a network for it. Not in the paper.

For each of some candidate actions AAP imagines a success and a failure, and reads it as if it had happened. The
candidate is proposed whose imagined outcomes are worth the most in expectation. Two kinds of worth:

- information gain: how far the beliefs in random actions move (Lindley, 1956: On a measure of the information provided
  by an experiment).
- value of information: how likely the best candidates would succeed then (Howard, 1966: Information value theory).

Shapes: C candidate actions, each at a point of its own; A actions that AAP is asked about.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shared.policies.adaptation import Adapter, Proposals, movable_points, reachable_action
from shared.policies.methods import ProposerKind
from shared.policies.proposers import TOP_POINTS, best_points
from shared.types import Action, Interaction, Observation

CANDIDATES = 32
"""Half of them among the points of highest AAP actionability, the others anywhere."""
BEST = 6
"""The value of information is the mean belief in so many candidates."""
ASKED = 4
"""Random rotations at each candidate's point, whose beliefs the information gain is about."""
USUAL_MOTION = 0.03
"""m of an imagined success as long as none was seen, rad or length: the median at closed doors."""
SURE = 1e-4
"""Beliefs are kept this far from 0 and 1, so that one action of which AAP is sure does not outweigh all others."""


def divergence(after: Tensor, now: Tensor) -> Tensor:
    """Kullback-Leibler divergence, nats, of beliefs `after` an outcome from those of `now`, each in [0, 1], [...]."""
    now, after = now.clamp(SURE, 1 - SURE), after.clamp(SURE, 1 - SURE)
    return after * (after / now).log() + (1 - after) * ((1 - after) / (1 - now)).log()


class AskedActions(NamedTuple):
    """Actions that AAP is asked about: indices of their points, [A], and their frames, [A, 6 or more]."""

    points: NDArray[np.int64]
    frames: Tensor


class _ImaginingProposer:
    """Proposes the action whose imagined outcomes are worth the most in expectation; never stops."""

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
        candidates = AskedActions(points, frames)
        worth = self._expected(observation, candidates, self._asked(candidates, proposals), history, latent)

        def choose(left: NDArray[np.int64]) -> int:
            return int(left[worth[torch.from_numpy(left)].argmax()])

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

    def _expected(
        self,
        observation: Observation,
        candidates: AskedActions,
        asked: AskedActions,
        history: Sequence[Interaction],
        latent: Tensor,
    ) -> Tensor:
        """The expected worth of each candidate, [C], after a history whose z is `latent`."""
        moved = [interaction.outcome.motion for interaction in history if interaction.outcome.success]
        motion = float(np.median(moved)) if moved else USUAL_MOTION
        odds = self.adapter.beliefs(observation, *candidates, latent[None])[0]
        now = self.adapter.beliefs(observation, *asked, latent[None])[0]
        expected = torch.zeros_like(odds)
        for chance, outcome in ((odds, (motion, True)), (1.0 - odds, (0.0, False))):
            latents = self.adapter.imagined(observation, *candidates, outcome, history)
            expected += chance * self._worth(now, self.adapter.beliefs(observation, *asked, latents))
        return expected

    def _asked(self, candidates: AskedActions, proposals: Sequence[Proposals]) -> AskedActions:
        """The actions that AAP is asked about before and after."""
        raise NotImplementedError

    def _worth(self, now: Tensor, after: Tensor) -> Tensor:
        """What beliefs `after` an imagined outcome of each candidate, [C, A], are worth, [C]; `now`: [A]."""
        raise NotImplementedError


class InformationGainProposer(_ImaginingProposer):
    """Proposes the action after which the beliefs in random actions are expected to change most.

    The distance is the Kullback-Leibler divergence. For beliefs that agree with each other, its expectation is the
    mutual information of the outcome and the success of a random action.
    """

    name = "information-gain"

    def _asked(self, candidates: AskedActions, proposals: Sequence[Proposals]) -> AskedActions:
        drawn = [torch.from_numpy(self.rng.integers(0, len(own.frames), ASKED)) for own in proposals]
        frames = torch.cat([own.frames[places] for own, places in zip(proposals, drawn, strict=True)])
        return AskedActions(np.repeat(candidates.points, ASKED), frames)

    def _worth(self, now: Tensor, after: Tensor) -> Tensor:
        return divergence(after, now).mean(dim=-1)


class InformationValueProposer(_ImaginingProposer):
    """Proposes the action after which AAP is expected to believe most in its best candidates."""

    name = "information-value"

    def _asked(self, candidates: AskedActions, proposals: Sequence[Proposals]) -> AskedActions:
        return candidates

    def _worth(self, now: Tensor, after: Tensor) -> Tensor:
        return after.topk(min(BEST, after.shape[-1]), dim=-1).values.mean(dim=-1)


INFORMATION_GAIN = ProposerKind(lambda adapter, rng, budget: InformationGainProposer(adapter, rng), ("prior", "aap"))
INFORMATION_VALUE = ProposerKind(lambda adapter, rng, budget: InformationValueProposer(adapter, rng), ("prior", "aap"))
