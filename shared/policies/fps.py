"""Interactions at points spread by furthest-point sampling (FPS): the baselines that AIP is compared with.

The next point is the one farthest from the earlier interaction points. The paper specifies only the points; the
rotation is the best of 100 by the method's own critic, as in an exploit.

Shapes: C candidate points, K interactions.
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
"""Actionability of points that are worth an interaction (AdaAfford, supplement, Details of Baselines)."""
LEAST_POINTS = 50
"""If fewer points reach the threshold, it is lowered until this many do (the same section)."""


class FpsProposer(ABC):
    """Proposes interactions by FPS; never stops.

    Candidates are the movable points of the present cloud. Distances are to the points of the earlier interactions;
    without one, all points are equally far.

    Args:
        adapter: the policy.
        rng: draws the first point, if FPS may begin anywhere, and the rotations.
    """

    name: str
    critic_name: CriticName = "aap"
    """The critic that gives the actionability and chooses the rotation."""

    def __init__(self, adapter: Adapter, rng: np.random.Generator) -> None:
        self.adapter = adapter
        self.rng = rng
        self.critic = critic_named(self.critic_name, adapter)

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next interaction; never None."""
        candidates = movable_points(observation)
        actionability = self.critic.affordance(observation, candidates, history)
        tried = np.array([interaction.action.point for interaction in history]).reshape(-1, 3)
        spread = distances_to(observation.points[candidates].astype(np.float64), tried)

        def choose(left: NDArray[np.int64]) -> int:
            return int(left[self.choose(None if spread is None else spread[left], actionability[left])])

        return best_action(self.critic, self.adapter, observation, candidates, choose, history, self.rng)

    @abstractmethod
    def choose(self, spread: Float | None, actionability: Float32) -> int:
        """Choose a point.

        Args:
            spread: distance of each point to the nearest interaction point, [C]; None without interactions.
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

    The paper does not say how the two are combined; a product needs no constant. The first interaction is at the most
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
    """Distance of each point, [C, 3], to the nearest interaction point, [K, 3]; None if K is 0."""
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
