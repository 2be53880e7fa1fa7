"""Tries at points spread by furthest-point sampling (FPS): the baselines that AIP is compared with.

The next point is the one farthest from those that were tried. The paper speaks of points only; the rotation there is
the best of 100 by the method's own critic, as in an exploit.

Shapes: C points that may be tried, K tries.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.policies.adaptation import Adapter, movable_points
from shared.policies.critics import best_action, critic_named
from shared.policies.methods import CriticName, ProposerKind
from shared.types import Action, Float, Float32, Interaction, Observation

THRESHOLD = 0.5
"""Actionability of points that are worth a try (AdaAfford, supplement, Details of Baselines)."""
LEAST_POINTS = 50
"""Where fewer points reach it, the threshold is set lower until this many do (the same place)."""


class FpsProposer(ABC):
    """One try after the other by FPS; never stops.

    Points are those that the task may act on, in the cloud as it is seen now, and the tries count where they touched.
    With nothing tried yet every point is as far as any other.

    Args:
        adapter: the policy.
        rng: draws the first point, where FPS may begin anywhere, and the rotations.
    """

    name: str
    critic_name: CriticName = "aap"
    """Whose actionability is looked at, after the tries so far, and who chooses the rotation."""

    def __init__(self, adapter: Adapter, rng: np.random.Generator) -> None:
        self.adapter = adapter
        self.rng = rng
        self.critic = critic_named(self.critic_name, adapter)

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next try; never None."""
        candidates = movable_points(observation)
        actionability = self.critic.affordance(observation, candidates, history)
        tried = np.array([interaction.action.point for interaction in history]).reshape(-1, 3)
        spread = distances_to(observation.points[candidates].astype(np.float64), tried)
        point = int(candidates[self.choose(spread, actionability)])
        return best_action(self.critic, self.adapter, observation, point, history, self.rng)

    @abstractmethod
    def choose(self, spread: Float | None, actionability: Float32) -> int:
        """Which point to try.

        Args:
            spread: distance of each point to the nearest that was tried, [C]; None where nothing was.
            actionability: of each point, [C].
        """


class PureFpsProposer(FpsProposer):
    """FPS "without using actionability scores" (AdaAfford, supplement, Ours-purefps)."""

    name = "purefps"

    def choose(self, spread: Float | None, actionability: Float32) -> int:
        """The farthest point."""
        return int(self.rng.integers(len(actionability)) if spread is None else spread.argmax())


class ActionableFpsProposer(FpsProposer):
    """FPS over points whose actionability is high enough (AdaAfford, supplement, Ours-fps)."""

    name = "fps"

    def choose(self, spread: Float | None, actionability: Float32) -> int:
        """The farthest of the actionable points."""
        actionable = actionable_points(actionability)
        place = self.rng.integers(len(actionable)) if spread is None else spread[actionable].argmax()
        return int(actionable[place])


class Where2ActFpsProposer(ActionableFpsProposer):
    """The same over Where2Act's actionability (AdaAfford, Where2Act-interaction and Where2Act-adaptation)."""

    name = "where2act-fps"
    critic_name = "where2act"


class WeightedFpsProposer(FpsProposer):
    """FPS by "the weighted distance" (AdaAfford, supplement, Ours-argfps): distance times actionability.

    The paper says that the two are combined, but not how; a product needs no constant. The first try goes to the most
    actionable point.
    """

    name = "argfps"

    def choose(self, spread: Float | None, actionability: Float32) -> int:
        """The point with the greatest weighted distance."""
        return int((actionability if spread is None else spread * actionability).argmax())


FPS = ProposerKind(lambda adapter, rng, budget: ActionableFpsProposer(adapter, rng), ("prior", "aap"))
PURE_FPS = ProposerKind(lambda adapter, rng, budget: PureFpsProposer(adapter, rng), ("prior", "aap"))
WEIGHTED_FPS = ProposerKind(lambda adapter, rng, budget: WeightedFpsProposer(adapter, rng), ("prior", "aap"))
WHERE2ACT_FPS = ProposerKind(lambda adapter, rng, budget: Where2ActFpsProposer(adapter, rng), ("prior",))


def distances_to(points: Float, tried: Float) -> Float | None:
    """Distance of each point, [C, 3], to the nearest of those tried, [K, 3]; None where K is 0."""
    if not len(tried):
        return None
    distances: Float = np.linalg.norm(points[:, None] - tried[None], axis=-1).min(axis=1)
    return distances


def actionable_points(actionability: Float32, least: int = LEAST_POINTS) -> NDArray[np.int64]:
    """Indices of the points above the threshold, or of the best `least` where fewer are, in ascending order."""
    above = np.flatnonzero(actionability > THRESHOLD)
    if len(above) >= least:
        return above
    return np.sort(np.argsort(-actionability, kind="stable")[:least])
