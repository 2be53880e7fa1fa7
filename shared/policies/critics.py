"""Critics at test time: scores of actions and points, given a history of interactions.

Shapes: N points of a cloud, A actions, S proposals at a point, K interactions, Q queried points.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from shared.errors import UsageError
from shared.policies.adaptation import Adapter, Proposals, reachable_action
from shared.policies.methods import BASELINES, CriticName, ModuleName
from shared.types import Action, Float32, Interaction, Observation


class Critic(Protocol):
    """Scores actions and points, given a history."""

    name: CriticName

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """Actionability of the points with these indices, given a history, [Q], in [0, 1]."""
        ...

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """Scores of actions, given a history, [A], in [0, 1]."""
        ...

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """Scores of proposals at one point, given a history, [S], in [0, 1]."""
        ...


def critic_names() -> list[CriticName]:
    """The names of all critics: Where2Act, AAP and the baselines."""
    return ["where2act", "aap", *BASELINES.names()]


def critic_named(name: CriticName, adapter: Adapter) -> Critic:
    """The critic called `name`, with the networks of a policy.

    Raises:
        UsageError: there is none, or the policy's networks that it needs are not trained.
    """
    if name == "where2act":
        return Where2ActCritic(adapter)
    if name == "aap":
        return AdaptiveCritic(adapter, name)
    if name not in BASELINES.names():
        raise UsageError(f"no critic is called '{name}'; allowed: {', '.join(critic_names())}")
    adapter.policy.require(*BASELINES.get(name).needs, name)
    return BASELINES.get(name).critic(adapter)


def best_action(
    critic: Critic,
    adapter: Adapter,
    observation: Observation,
    points: NDArray[np.int64],
    choose: Callable[[NDArray[np.int64]], int],
    history: Sequence[Interaction],
    rng: np.random.Generator,
) -> Action:
    """The best by a critic of 100 rotations at a point, from the prior's proposal network; see `reachable_action`."""

    def act(point: int) -> tuple[Proposals, Tensor]:
        proposals = adapter.proposals(observation, point, rng)
        return proposals, critic.predict_proposals(observation, proposals, history)

    return reachable_action(observation, points, choose, act)


class Where2ActCritic:
    """The prior (Where2Act), which ignores the history.

    Raises:
        UsageError: the prior of the policy is not trained.
    """

    name: CriticName = "where2act"

    def __init__(self, adapter: Adapter) -> None:
        adapter.policy.require("prior")
        self.adapter = adapter

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """Where2Act's actionability, [Q]."""
        return self.adapter.prior_affordance(observation, points)

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """Where2Act's scores, [A]."""
        return self.adapter.prior_score(observation, actions)

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """Where2Act's scores, [S]."""
        return self.adapter.prior_score_proposals(observation, proposals)


class AdaptiveCritic:
    """AAP, or a baseline whose network has the same interface and reads a history through z.

    Args:
        adapter: the policy at test time.
        name: "aap", or the name of the baseline.

    Raises:
        UsageError: the prior or this network is not trained.
    """

    def __init__(self, adapter: Adapter, name: ModuleName) -> None:
        adapter.policy.require("prior", name)
        self.adapter = adapter
        self.name: CriticName = name
        self._module = name

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """a_p|z, [Q]."""
        return self.adapter.affordance(observation, history, self._module, points)

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """s_u|z, [A]."""
        return self.adapter.score(observation, actions, history, self._module)

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """s_u|z, [S]."""
        latent = self.adapter.z(history, self._module)
        return self.adapter.score_proposals(observation, proposals, latent, self._module)
