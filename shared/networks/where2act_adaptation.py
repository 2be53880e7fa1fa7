"""Where2Act-adaptation: Where2Act whose scores are corrected at points similar to those that were tried.

Shapes: Q points asked about, K tries.
"""

import torch
from torch import Tensor, nn

from shared.networks.actions import PLACE_SCALE
from shared.networks.configuration import NetworkConfig
from shared.networks.layers import Head, VectorEncoder, point_features

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
        """sim_pq of tried points p and points q that are asked about, [...].

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
    """What each try adds to the scores of points: (r - s_u) sim_pq (AdaAfford, supplement), [..., Q, K].

    The paper gives the influence of one interaction; those of several are added up.

    Args:
        similarities: [..., Q, K].
        successes: r as 0 or 1, [..., K].
        scores: s_u, what Where2Act said of the tries, [..., K].
    """
    return (successes - scores)[..., None, :] * similarities
