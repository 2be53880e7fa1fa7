"""AIP: the Adaptive Interaction Proposal module."""

from torch import Tensor, nn

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

SCORE_SCALE = 0.02
"""The usual size of a drop of the AAP loss; outputs are in units of it, so that untrained weights start near."""


class Aip(nn.Module):
    """Adaptive Interaction Proposal (AdaAfford, the section of that name): predicts how much an interaction reveals.

    Holds the AIP critic C and the AIP affordance network D over a PointNet++ of their own. D sees its features without
    passing a gradient back, as in `shared.networks.aap.Aap`.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, latent = config.feature_width, config.latent_width
        self.config = config
        self.encoder = PointNet2(config)
        self.action_encoder = ActionEncoder(config)
        self.score_encoder = VectorEncoder(1, config)
        self.actionability_encoder = VectorEncoder(1, config)
        self.critic_head = Head((width, width, width, latent), 1, config, product=config.products)
        self.place_encoder = PlaceEncoder.where_told(config)
        place = () if self.place_encoder is None else (width,)
        self.affordance_head = Head((width, *place, width, latent), 1, config)

    def action_scores(
        self, features: Tensor, points: Tensor, frames: Tensor, latents: Tensor, aap_scores: Tensor
    ) -> Tensor:
        """AIP action scores s^AIP_u|z (AdaAfford, AIP Critic Network), [...], in nats of the AAP loss.

        Args:
            features: of points under this module's encoder, [..., point_width].
            points: p less the middle of what may be moved, [..., 3].
            frames: approach and forward, [..., 6].
            latents: z, [..., latent_width].
            aap_scores: s^AAP_u|z, probabilities, [...].
        """
        actions = self.action_encoder(features, points, frames)
        features = point_features(features, self.config)
        scores: Tensor = self.critic_head(features, self.score_encoder(aap_scores[..., None]), actions, latents)
        return SCORE_SCALE * scores.squeeze(-1)

    def actionability(self, features: Tensor, points: Tensor, latents: Tensor, aap_actionability: Tensor) -> Tensor:
        """AIP actionability a^AIP_p|z of points (AdaAfford, AIP Affordance Network), [...].

        Args:
            features: of points under this module's encoder, [..., point_width].
            points: p less the middle of what may be moved, [..., 3].
            latents: z, [..., latent_width].
            aap_actionability: a^AAP_p|z in [0, 1], [...].
        """
        return self.affordance(self.told_of_points(features, points), latents, aap_actionability)

    def told_of_points(self, features: Tensor, points: Tensor) -> list[Tensor]:
        """What D is told of points beside z and AAP's D; arguments as for `actionability`."""
        return told_of_points(features.detach(), points, self.place_encoder, self.config)

    def affordance(self, told: list[Tensor], latents: Tensor, aap_actionability: Tensor) -> Tensor:
        """`actionability` of points of which `told_of_points` was computed before."""
        believed = self.actionability_encoder(aap_actionability[..., None])
        scores: Tensor = self.affordance_head(*told, believed, latents)
        return SCORE_SCALE * scores.squeeze(-1)

    def affordance_network(self) -> nn.Module:
        """All that D has of its own."""
        return present(head=self.affordance_head, believed=self.actionability_encoder, place=self.place_encoder)
