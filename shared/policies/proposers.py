"""Proposers that use a policy: for the next interaction, and for the final action.

Everything here runs on the CPU in a few milliseconds a step and depends on its random generator alone.

Baselines of AIP choose points that are spread by furthest-point sampling (FPS): the next point is the one farthest from
the earlier interaction points. The paper specifies only the points; the rotation is the best of 100 by the method's own
critic, as in an exploit.

Shapes: C candidate points, K interactions.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from shared.errors import UsageError
from shared.policies.adaptation import Adapter, Proposals, first_in_reach, movable_points, reachable_action
from shared.policies.critics import best_action, critic_named, critic_names
from shared.policies.methods import PROPOSERS, REPEATING, CriticName, ProposerKind
from shared.types import Action, Float, Float32, Interaction, Observation, Proposer

TOP_POINTS = 100
"""Points that an exploit is drawn from (AdaAfford, Evaluation Metrics)."""
REPEAT_M = 0.12
"""Metres from an interaction that succeeded to its repetition; the part has moved since, and the hand with it."""
MOST_REACHED = 50
"""The most repetitions that are checked for whether the arm reaches them."""
THRESHOLD = 0.5
"""Actionability of points that are worth an interaction (AdaAfford, supplement, Details of Baselines)."""
LEAST_POINTS = 50
"""If fewer points reach the threshold, it is lowered until this many do (the same section)."""
STOP_THRESHOLD = 0.0
"""The paper says "e.g., 0.05", but the AIP score is a drop of a loss whose mean here is about 0.003, so that 0.05 would
stop at once; 0 stops where no point promises any gain."""


@dataclass(eq=False)
class AipProposer:
    """Proposes the next interaction by the AIP module (AdaAfford, Next-step Interaction Action Proposal).

    It chooses the movable point with the highest AIP actionability, and there the best of 100 rotations of the prior's
    proposal network by the AIP critic. It stops when the budget is reached, or when the highest actionability is
    below the threshold (AdaAfford, Stopping Criterion).

    With a `share`, the point is drawn from that share of the cloud's points, those with the highest AIP actionability:
    the published code draws from the best 100 of 10,000 (AdaAffordCode, code/sample_succ.py, `while len(xs) < 100`).

    Deviation: `at_least` interactions are proposed in spite of the threshold, because an empty history reveals nothing.

    Attributes:
        adapter: the policy at test time.
        rng: of the proposed rotations, and of the drawn points.
        budget: the most interactions.
        threshold: of the highest AIP actionability.
        at_least: interactions that are proposed without regard to the threshold.
        share: of the cloud's points, above 0 and at most 1; None: the best point is taken.

    Raises:
        UsageError: prior, AAP or AIP is not trained.
    """

    name = "aip"

    adapter: Adapter
    rng: np.random.Generator
    budget: int
    threshold: float = STOP_THRESHOLD
    at_least: int = 1
    share: float | None = None

    def __post_init__(self) -> None:
        self.adapter.policy.require("prior", "aap", "aip")

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next action, or None to stop."""
        if len(history) >= self.budget:
            return None
        candidates = movable_points(observation)
        preferred = self.preferred(observation.points[candidates].astype(np.float64), history)
        latent = self.adapter.z(history)
        information = self.adapter.information(observation, candidates, latent)
        if len(history) >= self.at_least and float(information[preferred].max()) < self.threshold:
            return None

        def choose(left: NDArray[np.int64]) -> int:
            left = left[preferred[left]] if preferred[left].any() else left
            if self.share is None:
                return int(left[information[left].argmax()])
            return drawn_point(left, information[left], points_of(self.share, observation), self.rng)

        def act(point: int) -> tuple[Proposals, Tensor]:
            proposals = self.adapter.proposals(observation, point, self.rng)
            return proposals, self.adapter.information_proposals(observation, proposals, latent)

        return reachable_action(observation, candidates, choose, act)

    def preferred(self, points: Float, history: Sequence[Interaction]) -> NDArray[np.bool_]:
        """Which of the points, [C, 3], it chooses among, [C]; among others only where the arm reaches none of these."""
        return np.ones(len(points), np.bool_)


class SpreadAipProposer(AipProposer):
    """AIP among the half of the movable points that is furthest from the points of the earlier interactions.

    Addition: the paper's AIP chooses among all points. On real objects it goes on near its last interaction, which
    reveals little (docs/results/experiments.md, "AIP in the furthest half").
    """

    name = "aip-spread"

    def preferred(self, points: Float, history: Sequence[Interaction]) -> NDArray[np.bool_]:
        """The furthest half of the points, [C]."""
        spread = distances_to(points, np.array([each.action.point for each in history]).reshape(-1, 3))
        return super().preferred(points, history) if spread is None else spread >= np.median(spread)


def _aip(proposer: type[AipProposer]) -> ProposerKind:
    return ProposerKind(
        proposer,
        ("prior", "aap", "aip"),
        draw=lambda adapter, rng, budget, share: proposer(adapter, rng, budget, share=share),
    )


AIP, SPREAD_AIP = _aip(AipProposer), _aip(SpreadAipProposer)


class ExploitProposer:
    """Proposes the action with the best score of a critic (AdaAfford, Evaluation Metrics, sample-success).

    It draws one of the 100 movable points with the highest actionability, and chooses there the best of 100 rotations
    of the prior's proposal network by the critic.

    Published clouds have 10,000 points and ours fewer, so that 100 are a larger part of them: with a `share`, the point
    is one of that share of the cloud's points, 0.01 as published (AdaAffordCode, code/sample_succ.py).

    Args:
        adapter: the policy at test time.
        rng: of the drawn point and the proposed rotations.
        critic: the name of the critic.
        share: of the cloud's points, above 0 and at most 1; None: 100 points.

    Raises:
        UsageError: there is no such critic, or its networks are not trained.
    """

    def __init__(
        self, adapter: Adapter, rng: np.random.Generator, critic: CriticName = "aap", share: float | None = None
    ) -> None:
        self.name = critic
        self.critic = critic_named(critic, adapter)
        self.adapter = adapter
        self.rng = rng
        self.share = share

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The action to execute; never None."""
        candidates = movable_points(observation)
        scores = self.critic.affordance(observation, candidates, history)
        count = TOP_POINTS if self.share is None else points_of(self.share, observation)

        def choose(left: NDArray[np.int64]) -> int:
            return drawn_point(left, scores[left], count, self.rng)

        return best_action(self.critic, self.adapter, observation, candidates, choose, history, self.rng)


class RepeatProposer:
    """Repeats an interaction that succeeded, near its point: the final action on a robot.

    Candidates have the rotation of an interaction that succeeded, at the movable points within `REPEAT_M` of it. The
    one with the highest score of the critic is taken. It need not be at the same point, since the part has moved. If no
    interaction succeeded, or the arm reaches none of the candidates, it acts as `ExploitProposer`.

    Addition: the paper draws the point of the final action from the best ones, whatever the interactions showed.

    Args and errors are those of `ExploitProposer`.
    """

    def __init__(
        self, adapter: Adapter, rng: np.random.Generator, critic: CriticName = "aap", share: float | None = None
    ) -> None:
        self.name = critic
        self._exploit = ExploitProposer(adapter, rng, critic, share)

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The action to execute; never None."""
        candidates, actions = movable_points(observation), list[Action]()
        places = observation.points[candidates].astype(np.float64)
        for tried in (each.action for each in history if each.outcome.success):
            near = candidates[np.linalg.norm(places - tried.point, axis=1) < REPEAT_M]
            actions += [Action(int(k), observation.points[k].astype(np.float64), tried.rotation) for k in near]
        if actions:
            scores = self._exploit.critic.predict(observation, actions, history)
            best_first = np.argsort(-scores, kind="stable")[:MOST_REACHED]
            reached = first_in_reach(observation, (actions[int(k)] for k in best_first))
            if reached is not None:
                return reached
        return self._exploit.propose(observation, history)


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


def points_of(share: float, observation: Observation) -> int:
    """How many points a share of a cloud is, at least one; of all points, because the published 100 are of 10,000.

    Raises:
        UsageError: it is no share.
    """
    if not 0 < share <= 1:
        raise UsageError(f"share={share}: give more than 0 and at most 1 of a cloud's points")
    return max(1, round(share * len(observation.points)))


def drawn_point(candidates: NDArray[np.int64], scores: Float32, count: int, rng: np.random.Generator) -> int:
    """One of the `count` candidates with the highest scores, at random; `candidates` and `scores`: [C]."""
    return int(rng.choice(best_points(candidates, scores, count)))


def best_points(candidates: NDArray[np.int64], scores: Float32, count: int) -> NDArray[np.int64]:
    """The `count` candidates with the highest scores, best first; `candidates` and `scores`: [C]."""
    # A stable sort makes the choice among equal scores independent of the machine.
    return candidates[np.argsort(-scores, kind="stable")][:count]


def proposer_named(
    name: str, adapter: Adapter | None, rng: np.random.Generator, budget: int, share: float | None = None
) -> Proposer:
    """The proposer called `name`.

    Args:
        name: one of `shared.policies.methods.PROPOSERS`; or the name of a critic, for a proposer that exploits it; or
            `REPEATING` and that name, for one that repeats what succeeded.
        adapter: the policy; None if the proposer needs none.
        rng: of its random draws.
        budget: how many interactions it may propose.
        share: of a cloud's points, from which its points are drawn, as far as it draws any; None: its own way.

    Raises:
        UsageError: no proposer has this name, or the networks that it needs are not trained.
    """
    if name in PROPOSERS.names():
        kind = PROPOSERS.get(name)
        if adapter is not None:
            adapter.policy.require(*kind.modules)
        if share is not None and kind.draw is not None:
            return kind.draw(adapter, rng, budget, share)
        return kind.make(adapter, rng, budget)
    if adapter is not None and name in critic_names():
        return ExploitProposer(adapter, rng, name, share)
    critic = name.removeprefix(REPEATING)
    if adapter is not None and critic in critic_names():
        return RepeatProposer(adapter, rng, critic, share)
    known = ", ".join((*PROPOSERS.names(), *critic_names()))
    raise UsageError(f"no proposer is called '{name}'; allowed: {known}")
