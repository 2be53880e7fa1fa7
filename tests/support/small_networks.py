"""Networks small enough for a test."""

from shared.networks.network_config import NetworkConfig

TINY = NetworkConfig(
    centres=(24, 8),
    radii=(0.5, 1.0),
    neighbours=6,
    abstraction=((8, 8), (16, 16)),
    propagation=((16,), (16, 16)),
    feature_width=16,
    latent_width=12,
    surroundings=5,
)
