"""The prior: Where2Act's proposal, critic and affordance networks over one PointNet++."""

import torch
from torch import Tensor, nn

from shared.networks.actions import FRAME_WIDTH, orthonormal_frames
from shared.networks.layers import ActionEncoder, Head, PlaceEncoder, point_features, present, told_of_points
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import PointNet2


class Prior(nn.Module):
    """Where2Act (ICCV 2021): what vision alone says of an action, and which rotations are worth trying.

    Attributes:
        encoder: the point features, shared by the three heads as in Where2Act, and with no other module.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.feature_width
        self.config = config
        self.encoder = PointNet2(config)
        self.action_encoder = ActionEncoder(config)
        self.proposal_head = Head((width, config.noise_width), FRAME_WIDTH, config)
        self.critic_head = Head((width, width), 1, config)
        self.place_encoder = PlaceEncoder.where_told(config)
        place = () if self.place_encoder is None else (width,)
        self.affordance_head = Head((width, *place), 1, config)

    def propose(self, features: Tensor, noise: Tensor) -> Tensor:
        """Rotations at points (Where2Act, Action Proposal Network).

        Args:
            features: of points, [..., 1, point_width].
            noise: standard normal, [..., S, noise_width].

        Returns:
            Approach and forward of S rotations a point, [..., S, 6].
        """
        return orthonormal_frames(self.proposal_head(point_features(features, self.config), noise))

    def action_logits(self, features: Tensor, points: Tensor, frames: Tensor) -> Tensor:
        """Logits of the action score s_u (Where2Act, Action Scoring Network), [...]; `torch.sigmoid` gives the score.

        Args:
            features: of points, [..., point_width], broadcast against the frames.
            points: p less the middle of what may be moved, [..., 3], broadcast against the frames.
            frames: approach and forward, [..., 6].
        """
        actions = self.action_encoder(features, points, frames)
        return _single(self.critic_head(point_features(features, self.config), actions))

    def actionability(self, features: Tensor, points: Tensor) -> Tensor:
        """Actionability a_p in [0, 1] (Where2Act), [...]; features and points as for `action_logits`."""
        return self.affordance(self.told_of_points(features, points))

    def told_of_points(self, features: Tensor, points: Tensor) -> list[Tensor]:
        """What D is told of points; arguments as for `actionability`."""
        return told_of_points(features, points, self.place_encoder, self.config)

    def affordance(self, told: list[Tensor]) -> Tensor:
        """`actionability` of points of which `told_of_points` was computed before."""
        return torch.sigmoid(_single(self.affordance_head(*told)))

    def affordance_network(self) -> nn.Module:
        """All that D has of its own."""
        return present(head=self.affordance_head, place=self.place_encoder)


def _single(x: Tensor) -> Tensor:
    return x.squeeze(-1)
