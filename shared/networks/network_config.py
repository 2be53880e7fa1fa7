"""The sizes of the networks; every set of weights carries the configuration that it was made with."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from shared.config import StrictModel

MAX_LEVEL_NUMBERS = 1 << 25
"""What a set abstraction may compute of a cloud at a time: centres by neighbours by width. As published: 2 million."""
Width = Annotated[int, Field(ge=1, le=2048)]
Widths = Annotated[tuple[Width, ...], Field(min_length=1, max_length=8)]


class NetworkConfig(StrictModel):
    """Sizes of PointNet++ and of the heads; the defaults are the `small` configuration (see `NETWORKS`).

    Levels are listed from fine to coarse in the first four settings, and from coarse to fine in `propagation`.
    """

    centres: Widths = (512, 128, 32)
    """Points kept by each set abstraction."""
    radii: tuple[Annotated[float, Field(gt=0, le=100)], ...] = (0.12, 0.3, 0.8)
    """Of each set abstraction's neighbourhoods, in the cloud's units."""
    neighbours: int = Field(16, ge=1, le=128)
    """Neighbours that each centre looks at; as published: 32."""
    abstraction: tuple[Widths, ...] = ((32, 32), (64, 64), (128, 128))
    """Layer widths of each set abstraction."""
    propagation: tuple[Widths, ...] = ((128,), (64,), (128, 128))
    """Layer widths of each feature propagation; the last width is the point feature's."""
    normalisation: Literal["layer", "batch"] = "layer"
    """As published: batch. Its statistics drift with small batches; see `SetAbstraction` for where "layer" stands."""
    feature_width: Width = 128
    """Of f_p|O, of the encoded actions and outcomes, and of the hidden layers of the heads."""
    latent_width: Width = 128
    """Of z."""
    noise_width: int = Field(10, ge=1, le=256)
    """Of the Gaussian that the proposal network turns into rotations."""
    action_features: bool = True
    """Whether an action enters with p and p x d, beside approach and forward. As published: not."""
    surroundings: int = Field(32, ge=0, le=128)
    """How many points of the cloud around p an action is told, in the gripper's own frame, beside what the point
    encoder makes of them: whether fingers will close on an edge shows there. As published: 0."""
    outcome_features: bool = True
    """Whether an outcome enters with log(1 + m / tau) and r, beside the motion m. As published: not."""
    outcome_details: bool = False
    """Whether an outcome enters with its kind and the grasp width as well: fingers that held a part which did not move
    are then told from fingers that closed on nothing. As published: not."""
    products: bool = True
    """Whether actions are multiplied with z and with outcomes, and AAP's D multiplies points with z (see
    `shared.networks.layers.Head`). As published: not."""
    evidence: bool = True
    """Whether z is told how much was tried, beside the mean of what the interactions say. As published: not."""

    pinch_profile: bool = Field(False, exclude_if=lambda told: not told)
    """Whether an action enters with what lies between the fingers, from the depth image (see `shared.pinch`); stores
    need `collection.camera.keep_depth`, scans a point every centimetre. As published: not."""
    roll_symmetry: bool = Field(False, exclude_if=lambda is_symmetric: not is_symmetric)
    """Whether an action and the same with the gripper turned by 180 deg about its approach are encoded alike: as the
    mean of both encodings. As published: not."""

    @property
    def point_width(self) -> int:
        """Of all that is known of a point: f_p|O, then the offsets of its surroundings (see `PointNet2.at`)."""
        return self.feature_width + 3 * self.surroundings

    @model_validator(mode="after")
    def _consistent(self) -> "NetworkConfig":
        levels = len(self.centres)
        if not len(self.radii) == len(self.abstraction) == len(self.propagation) == levels:
            raise ValueError(f"radii, abstraction and propagation need {levels} entries each, one for each of centres")
        if any(coarse > fine for fine, coarse in zip(self.centres, self.centres[1:], strict=False)):
            raise ValueError(f"centres must not grow from level to level; given {self.centres}")
        for centres, widths in zip(self.centres, self.abstraction, strict=True):
            if centres * self.neighbours * max(widths) > MAX_LEVEL_NUMBERS:
                raise ValueError(
                    f"{centres} centres by {self.neighbours} neighbours by {max(widths)} numbers are more than "
                    f"{MAX_LEVEL_NUMBERS}; choose fewer"
                )
        if self.propagation[-1][-1] != self.feature_width:
            raise ValueError(f"propagation must end in feature_width ({self.feature_width})")
        return self


NETWORKS = {
    "small": NetworkConfig(),
    "published": NetworkConfig(
        centres=(1024, 256, 64, 16),
        radii=(0.1, 0.2, 0.4, 0.8),
        neighbours=32,
        abstraction=((32, 32, 64), (64, 64, 128), (128, 128, 256), (256, 256, 512)),
        propagation=((256, 256), (256, 256), (256, 128), (128, 128, 128)),
        normalisation="batch",
        action_features=False,
        surroundings=0,
        outcome_features=False,
        products=False,
        evidence=False,
    ),
}
"""Named configurations: "small" for clouds of about 2,048 points on a few cores, and "published"."""
