"""The segmentation network: of each point of a raw scan what it is of, and where the middle of its part is."""

import torch
from torch import Tensor, nn

from shared.networks.layers import PointwiseMlp
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import CloudBatch, PointNet2

SEGMENTATION_NETWORK = NetworkConfig(
    centres=(1024, 256, 64, 16),
    radii=(0.1, 0.25, 0.7, 2.5),
    neighbours=16,
    abstraction=((32, 48), (64, 96), (128, 192), (192, 256)),
    propagation=((192,), (160,), (128,), (128, 96)),
    feature_width=96,
    surroundings=0,
)
"""Small, and with a last level that sees a whole object: where the middle of a door is depends on all of it."""


class SegmentationNetwork(nn.Module):
    """PointNet++ with two heads: logits of `kinds` classes, and the offset of the middle of the point's part (VoteNet).

    Args:
        config: sizes of the encoder.
        kinds: number of classes.
        extra: number of inputs of a point beside its place.
    """

    def __init__(self, config: NetworkConfig, kinds: int, extra: int) -> None:
        super().__init__()
        self.kinds = kinds
        self.encoder = PointNet2(config, extra)
        self.head = PointwiseMlp(config.feature_width, (config.feature_width,), "layer")
        self.output = nn.Linear(config.feature_width, kinds + 3)

    def forward(self, clouds: CloudBatch) -> tuple[Tensor, Tensor]:
        """Clouds to logits [B, N, kinds] and offsets [B, N, 3], in the cloud's units."""
        count, size = clouds.points.shape[:2]
        cloud = torch.arange(count).repeat_interleave(size)
        point = torch.arange(size).repeat(count)
        features = self.encoder.features_at(self.encoder(clouds), cloud, point)
        output = self.output(self.head(features)).reshape(count, size, -1)
        return output[..., : self.kinds], output[..., self.kinds :]
