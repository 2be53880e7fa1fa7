"""Critics at test time: what a history of tries makes a method believe of actions and points.

Shapes: N points of a cloud, A actions, S proposals at a point, K tries, Q points asked about.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shared.adaptation import Adapter, AdaptiveName, Proposals, action_from_frame, point_indices
from shared.methods import CriticName
from shared.networks.where2act_adaptation import influences
from shared.vocabulary import Action, Float32, Interaction, Observation


class Critic(Protocol):
    """What every method's beliefs look like to a proposer."""

    name: CriticName

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """The actionability of the points at some indices after a history, [Q], in [0, 1]."""
        ...

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """The scores of actions after a history, [A], in [0, 1]."""
        ...

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """The scores of proposals at one point after a history, [S], in [0, 1]."""
        ...


def critic_named(name: CriticName, adapter: Adapter) -> Critic:
    """The critic of a policy that is called `name`.

    Raises:
        UsageError: the policy's networks that it needs are not trained.
    """
    match name:
        case "where2act":
            return Where2ActCritic(adapter)
        case "where2act-adaptation":
            return AdaptationCritic(adapter)
        case _:
            return AdaptiveCritic(adapter, name)


def best_action(
    critic: Critic,
    adapter: Adapter,
    observation: Observation,
    point: int,
    history: Sequence[Interaction],
    rng: np.random.Generator,
) -> Action:
    """The best by a critic of 100 rotations at a point, from the prior's proposal network."""
    proposals = adapter.proposals(observation, point, rng)
    best = int(critic.predict_proposals(observation, proposals, history).argmax())
    return action_from_frame(observation, point, proposals.frames[best])


class Where2ActCritic:
    """The prior, which knows nothing of tries."""

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
    """AAP, or Where2Act-interaction, which shares its form: both read a history through z."""

    def __init__(self, adapter: Adapter, name: AdaptiveName) -> None:
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


class AdaptationCritic:
    """Where2Act-adaptation: Where2Act, corrected at points similar to those tried (AdaAfford, Details of Baselines).

    s_u*|new = s_u* + sum (r - s_u) sim_pq, and a_q likewise. Deviation: cut to [0, 1], which the paper does not say.
    """

    name: CriticName = "where2act-adaptation"

    def __init__(self, adapter: Adapter) -> None:
        adapter.policy.require("prior", "where2act-adaptation")
        assert adapter.policy.where2act_adaptation is not None, "a trained module is there"
        self.adapter = adapter
        self._network = adapter.policy.where2act_adaptation

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """Where2Act's actionability, corrected, [Q]."""
        before = torch.from_numpy(self.adapter.prior_affordance(observation, points))
        return self._corrected(before, observation, points, history).numpy()

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """Where2Act's scores, corrected, [A]."""
        before = torch.from_numpy(self.adapter.prior_score(observation, actions))
        return self._corrected(before, observation, point_indices(actions), history).numpy()

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """Where2Act's scores, corrected, [S]; all by the same, since similarity is one of points."""
        before = self.adapter.prior_score_proposals(observation, proposals)
        return self._corrected(before, observation, np.array([proposals.point]), history)

    @torch.inference_mode()
    def _corrected(
        self, before: Tensor, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Tensor:
        """Scores, [...], broadcast against [Q], after the tries of the history."""
        after = before
        features, places = self.adapter.features(observation, "prior", points), self.adapter.places(observation, points)
        for interaction in history:
            tried, at = interaction.observation, point_indices([interaction.action])
            similarities = self._network.similarities(
                self.adapter.features(tried, "prior", at),
                features,
                (places - self.adapter.places(tried, at)).norm(dim=-1),
            )
            success = torch.tensor([float(interaction.outcome.success)])
            score = torch.from_numpy(self.adapter.prior_score(tried, [interaction.action]))
            after = after + influences(similarities[:, None], success, score)[:, 0]
        return after.clamp(0.0, 1.0)
