"""AAP: the Adaptive Affordance Prediction module, and the oracle that it may learn from."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from shared.networks.actions import outcome_inputs, outcome_width
from shared.networks.layers import (
    ActionEncoder,
    Head,
    PlaceEncoder,
    VectorEncoder,
    point_features,
    present,
    told_of_points,
)
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import PointNet2

MIN_ATTENTION = 1e-4
"""Keeps the weighted mean defined where every weight is tiny."""


class Aap(nn.Module):
    """Adaptive Affordance Prediction (AdaAfford, the section of that name).

    Holds the adaptive information encoder E, the adaptive critic C and the adaptive affordance network D. They share
    one PointNet++, and share nothing with the other modules ("the encoders do not share weights across different
    modules"). D sees its features without passing a gradient back: it is supervised by C, and would otherwise bend
    C's features towards its own regression.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, latent = config.feature_width, config.latent_width
        self.config = config
        self.encoder = PointNet2(config)
        self.action_encoder = ActionEncoder(config)
        self.outcome_encoder = VectorEncoder(outcome_width(config), config)
        self.code_head = Head((width, width, width), latent, config, product=config.products)
        self.attention_head = Head((width, width, width), 1, config)
        self.evidence_head = Head((latent, latent), latent, config) if config.evidence else None
        self.empty_latent = nn.Parameter(torch.zeros(latent))
        self.critic_head = Head((width, width, latent), 1, config, product=config.products)
        self.place_encoder = PlaceEncoder.where_told(config)
        place = () if self.place_encoder is None else (width,)
        self.affordance_head = Head((width, *place, latent), 1, config, product=config.products)

    def interaction_codes(
        self,
        features: Tensor,
        points: Tensor,
        frames: Tensor,
        motions: Tensor,
        successes: Tensor,
        details: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What each interaction tells alone: z_I and w_I (AdaAfford, Adaptive Information Encoder).

        Deviation: the paper's w is any real number, so that its sum may be zero; here it is positive (softplus).

        Args:
            features: of each interaction's point, [..., point_width].
            points: p less the middle of what may be moved, [..., 3].
            frames: approach and forward, [..., 6].
            motions: m, [...].
            successes: r as 0 or 1, [...].
            details: kinds and grasp widths of the outcomes, [..., DETAIL_WIDTH] (see `outcome_details`); None: unknown.

        Returns:
            Codes [..., latent_width] and attention weights [...].
        """
        actions = self.action_encoder(features, points, frames)
        features = point_features(features, self.config)
        outcomes = self.outcome_encoder(outcome_inputs(motions, successes, self.config, details))
        weights = functional.softplus(self.attention_head(features, actions, outcomes)).squeeze(-1) + MIN_ATTENTION
        codes: Tensor = self.code_head(features, actions, outcomes)
        return codes, weights

    def prefix_latents(self, codes: Tensor, weights: Tensor) -> Tensor:
        """The z of every prefix of ordered interactions, in one pass: sum z_i w_i / sum w_i.

        Deviation, where `config.evidence` is set: a mean forgets how many interactions agreed, so that a small
        perceptron corrects it by the mean grown with the total weight.

        Deviation: the paper leaves z of no interactions undefined; here it is a learned constant, so that "AAP with no
        interactions" is a prediction like the others.

        Args:
            codes: [..., K, latent_width].
            weights: [..., K].

        Returns:
            [..., K + 1, latent_width], from no interactions to all K.
        """
        sums, totals = (codes * weights[..., None]).cumsum(dim=-2), weights.cumsum(dim=-1)[..., None]
        means = sums / totals
        if self.evidence_head is not None:
            means = means + self.evidence_head(means, means * torch.log1p(totals))
        return torch.cat([self.empty_latent.expand(*codes.shape[:-2], 1, -1), means], dim=-2)

    def latent(self, codes: Tensor, weights: Tensor) -> Tensor:
        """The z of a whole set, [latent_width], from codes [K, latent_width] and weights [K]; K may be 0."""
        return self.prefix_latents(codes, weights)[-1]

    def action_logits(self, features: Tensor, points: Tensor, frames: Tensor, latents: Tensor) -> Tensor:
        """Logits of the AAP action score s_u|z (AdaAfford, Adaptive Critic Network), [...].

        Args:
            features: of points, [..., point_width].
            points: p less the middle of what may be moved, [..., 3].
            frames: approach and forward, [..., 6].
            latents: z, [..., latent_width].

        The leading axes of features, frames and latents broadcast.
        """
        actions = self.action_encoder(features, points, frames)
        logits: Tensor = self.critic_head(point_features(features, self.config), actions, latents)
        return logits.squeeze(-1)

    def actionability(self, features: Tensor, points: Tensor, latents: Tensor) -> Tensor:
        """AAP actionability a_p|z in [0, 1] (AdaAfford, Adaptive Affordance Network), [...]; leading axes broadcast.

        Arguments as for `action_logits`; for what D is told beyond the paper see `PlaceEncoder`.
        """
        return self.affordance(self.told_of_points(features, points), latents)

    def told_of_points(self, features: Tensor, points: Tensor) -> list[Tensor]:
        """What D is told of points beside z; arguments as for `actionability`."""
        return told_of_points(features.detach(), points, self.place_encoder, self.config)

    def affordance(self, told: list[Tensor], latents: Tensor) -> Tensor:
        """`actionability` of points of which `told_of_points` was computed before."""
        logits: Tensor = self.affordance_head(*told, latents.detach())
        return torch.sigmoid(logits.squeeze(-1))

    def affordance_network(self) -> nn.Module:
        """All that D has of its own."""
        return present(head=self.affordance_head, place=self.place_encoder)


class OracleEncoder(nn.Module):
    """h: what cannot be seen, told outright, to z; the critic that it conditions bounds what adaptation can reach.

    Not in the paper. Trained end to end, AAP tends to ignore z; where its critic first learns with z = h(hidden facts),
    the information encoder then has something to infer.
    """

    def __init__(self, facts_width: int, config: NetworkConfig) -> None:
        super().__init__()
        self.first = VectorEncoder(facts_width, config)
        self.second = nn.Linear(config.feature_width, config.latent_width)

    def forward(self, facts: Tensor) -> Tensor:
        """Facts [..., facts_width] to z, [..., latent_width]; bounded, so that it can be imitated."""
        hidden: Tensor = self.second(functional.leaky_relu(self.first(facts)))
        return torch.tanh(hidden)
