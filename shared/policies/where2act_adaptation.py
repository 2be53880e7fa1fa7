"""Where2Act-adaptation: Where2Act whose scores are corrected at points similar to the interaction points.

`learner.stages.where2act_adaptation` trains it. Shapes: N points of a cloud, A actions, S proposals at a point,
Q queried points, K interactions.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shared.networks.actions import PLACE_SCALE
from shared.networks.layers import Head, VectorEncoder, point_features
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import Adapter, Proposals, point_indices
from shared.policies.methods import Baseline, Method
from shared.types import Action, Float32, Interaction, Observation

NAME = "where2act-adaptation"
METHOD = Method("where2act-fps", NAME)
FIRST_LOGIT = -2.0
"""Of a similarity under untrained weights: about 0.1, so that training begins near the prior."""


class Where2ActAdaptation(nn.Module):
    """How similar two points are, given what Where2Act's encoder sees there and how far apart they are.

    AdaAfford, supplement, Details of Baselines: sim_pq from f_p, f_q and |p - q|. The paper leaves its range open; here
    it is in (0, 1), as similarities are. Where2Act itself stays as it is.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.feature_width
        self.config = config
        self.distance_encoder = VectorEncoder(1, config)
        self.similarity_head = Head((width, width, width), 1, config)

    def similarities(self, tried: Tensor, asked: Tensor, distances: Tensor) -> Tensor:
        """sim_pq of interaction points p and queried points q, [...].

        Args:
            tried: of Where2Act, at p, [..., point_width].
            asked: of Where2Act, at q, [..., point_width].
            distances: |p - q|, [...].

        The leading axes broadcast.
        """
        far = self.distance_encoder(PLACE_SCALE * distances[..., None])
        logits: Tensor = self.similarity_head(*(point_features(x, self.config) for x in (tried, asked)), far)
        return torch.sigmoid(logits.squeeze(-1) + FIRST_LOGIT)


def influences(similarities: Tensor, successes: Tensor, scores: Tensor) -> Tensor:
    """Score corrections of points by each interaction, (r - s_u) sim_pq (AdaAfford, supplement), [..., Q, K].

    The paper gives the influence of one interaction; those of several are added up.

    Args:
        similarities: [..., Q, K].
        successes: r as 0 or 1, [..., K].
        scores: s_u, what Where2Act said of the interactions, [..., K].
    """
    return (successes - scores)[..., None, :] * similarities


class AdaptationCritic:
    """Where2Act-adaptation: Where2Act with corrected scores (AdaAfford, Details of Baselines).

    s_u*|new = s_u* + sum (r - s_u) sim_pq, and a_q likewise. Deviation: cut to [0, 1], which the paper does not say.
    """

    name = NAME

    def __init__(self, adapter: Adapter) -> None:
        self.adapter = adapter
        self._network = adapter.policy.baseline(NAME, Where2ActAdaptation)

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
        """Scores, [...], broadcast against [Q], after the interactions of the history."""
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


BASELINE = Baseline(Where2ActAdaptation, AdaptationCritic, training="learner.stages.where2act_adaptation:TRAINING")
