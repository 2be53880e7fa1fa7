"""Multilayer perceptrons over the last axis, and heads over several inputs."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from shared.networks.actions import FRAME_WIDTH, PLACE_SCALE, action_inputs, action_width, in_gripper, turned_over
from shared.networks.network_config import NetworkConfig
from shared.pinch import PROFILE_WIDTH

PIECE = 64
"""Rows in a piece; see `in_pieces`."""
SURROUNDINGS_SCALE = 10.0
"""Offsets of the nearest points, some hundredths of a unit, come to some tenths."""


class Normalisation(nn.Module):
    """Layer or batch normalisation of the last axis, whatever the leading axes are."""

    def __init__(self, width: int, kind: str) -> None:
        super().__init__()
        self.norm: nn.Module = nn.BatchNorm1d(width) if kind == "batch" else nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """`x`, [..., width], normalised."""
        if isinstance(self.norm, nn.BatchNorm1d):
            return _as_tensor(self.norm(x.reshape(-1, x.shape[-1]))).reshape(x.shape)
        return _as_tensor(self.norm(x))


class PointwiseMlp(nn.Module):
    """Linear, normalisation and ReLU, once a width: the shared perceptron of PointNet++; `kind` may be "none"."""

    def __init__(self, width_in: int, widths: Sequence[int], kind: str, *, last_relu: bool = True) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            layers.append(nn.Linear(width_in, width, bias=kind == "none"))
            if kind != "none":
                layers.append(Normalisation(width, kind))
            layers.append(nn.ReLU())
            width_in = width
        self.layers = nn.Sequential(*(layers if last_relu else layers[:-1]))

    def forward(self, x: Tensor) -> Tensor:
        """[..., width_in] to [..., widths[-1]]."""
        return _as_tensor(self.layers(x))


class VectorEncoder(nn.Module):
    """The MLP that encodes a vector into f_a (AdaAfford, Input Encoders): two layers, leaky ReLU between."""

    def __init__(self, width_in: int, config: NetworkConfig) -> None:
        super().__init__()
        self.first = nn.Linear(width_in, config.feature_width)
        self.second = nn.Linear(config.feature_width, config.feature_width)

    def forward(self, x: Tensor) -> Tensor:
        """[..., width_in] to [..., feature_width]."""
        return _as_tensor(self.second(functional.leaky_relu(self.first(x))))


class SurroundingsEncoder(nn.Module):
    """Encodes the points around p: each through a small perceptron, of which the maximum counts, as in PointNet."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        # ReLU and maximum commute, and ReLU is cheaper after it.
        self.each = PointwiseMlp(3, (32, 64), "none", last_relu=False)
        self.together = VectorEncoder(64, config)

    def forward(self, offsets: Tensor) -> Tensor:
        """Offsets from p, [..., k, 3], to [..., feature_width]."""
        pooled = in_pieces(self._pooled, offsets.flatten(0, -3))
        return _as_tensor(self.together(pooled.reshape(*offsets.shape[:-2], pooled.shape[-1])))

    def _pooled(self, offsets: Tensor) -> Tensor:
        return torch.relu(_as_tensor(self.each(SURROUNDINGS_SCALE * offsets)).amax(dim=-2))


class ActionEncoder(nn.Module):
    """Encodes an action at a point into f_a (AdaAfford, Input Encoders).

    Deviation, where `config.surroundings` is set: the points around p are told as the gripper sees them, in its own
    frame; where `config.pinch_profile` is set, what lies between its fingers as well.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.numbers = VectorEncoder(action_width(config), config)
        self.around = SurroundingsEncoder(config) if config.surroundings else None
        self.pinch = VectorEncoder(PROFILE_WIDTH, config) if config.pinch_profile else None

    def forward(self, features: Tensor, points: Tensor, frames: Tensor) -> Tensor:
        """Actions to [..., feature_width]; leading axes broadcast.

        Args:
            features: all that is known of the points, [..., point_width].
            points: p less the middle of what may be moved, [..., 3].
            frames: approach and forward, and the pinch profile where the configuration has it, [..., 6 or more].
        """
        encoded = self._encoded(features, points, frames)
        if not self.config.roll_symmetry:
            return encoded
        return (encoded + self._encoded(features, points, turned_over(frames))) / 2

    def _encoded(self, features: Tensor, points: Tensor, frames: Tensor) -> Tensor:
        encoded = _as_tensor(self.numbers(action_inputs(points, frames, self.config)))
        if self.around is not None:
            offsets = in_gripper(surrounding_offsets(features, self.config), frames)
            encoded = encoded + _as_tensor(self.around(offsets))
        if self.pinch is not None:
            encoded = encoded + _as_tensor(self.pinch(frames[..., FRAME_WIDTH:]))
        return encoded


class PlaceEncoder(nn.Module):
    """Encodes what a D network is told of a point beside f_p|O; the published networks are told nothing more.

    Deviation: D follows a critic, and has to know what its critic knows: p, where actions enter with it, since scores
    turn on lever arms, and the points around p, where actions are told them, here in the view frame.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.place = VectorEncoder(3, config) if config.action_features else None
        self.around = SurroundingsEncoder(config) if config.surroundings else None

    @classmethod
    def where_told(cls, config: NetworkConfig) -> "PlaceEncoder | None":
        """One, where there is something to encode."""
        return cls(config) if config.action_features or config.surroundings else None

    def forward(self, features: Tensor, points: Tensor) -> Tensor:
        """All that is known of points, [..., point_width], and p less the middle, [..., 3]; [..., feature_width]."""
        told = []
        if self.place is not None:
            told.append(_as_tensor(self.place(PLACE_SCALE * points)))
        if self.around is not None:
            told.append(_as_tensor(self.around(surrounding_offsets(features, self.config))))
        return torch.stack(told).sum(dim=0)


def in_pieces(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """A function of each row of `x`, computed some rows at a time where no gradient is kept.

    What a piece needs for its hidden layers stays in the processor's cache, and is not asked from the system each time.
    """
    if torch.is_grad_enabled() or len(x) <= PIECE:
        return function(x)
    return torch.cat([function(piece) for piece in torch.split(x, PIECE)])


def told_of_points(
    features: Tensor, points: Tensor, place_encoder: PlaceEncoder | None, config: NetworkConfig
) -> list[Tensor]:
    """What a D network is told of points: f_p|O, and how a `PlaceEncoder`, where there is one, encodes the rest."""
    told = [point_features(features, config)]
    return told if place_encoder is None else [*told, place_encoder(features, points)]


def present(**modules: nn.Module | None) -> nn.ModuleDict:
    """Those of some modules that there are, by name."""
    return nn.ModuleDict({name: module for name, module in modules.items() if module is not None})


def surrounding_offsets(features: Tensor, config: NetworkConfig) -> Tensor:
    """Offsets of the points around p, [..., surroundings, 3], of all that is known of points, [..., point_width]."""
    around = features[..., config.feature_width :]
    return around.reshape(*around.shape[:-1], config.surroundings, 3)


def point_features(features: Tensor, config: NetworkConfig) -> Tensor:
    """f_p|O alone, [..., feature_width], of all that is known of points, [..., point_width]."""
    return features[..., : config.feature_width]


class Head(nn.Module):
    """A two-layer perceptron with leaky ReLU over the concatenation of several inputs.

    The first layer is kept as one matrix an input, whose products are added: the same function as one matrix on the
    concatenation, except that inputs whose leading axes broadcast (a point's feature against a hundred rotations, or
    an action against every latent) are multiplied once and never copied.

    Deviation, where `product` is set: the hidden layer also gets the product of projections of the last two inputs.
    Whether a push at p along d turns a hinge is bilinear in the action and in what is known of the hinge, which sums
    alone learn from far more data.
    """

    def __init__(
        self, widths_in: Sequence[int], width_out: int, config: NetworkConfig, *, product: bool = False
    ) -> None:
        super().__init__()
        whole = nn.Linear(sum(widths_in), config.feature_width)
        # Drawn as one layer, so that the spread of the weights is that of the concatenation.
        self.inputs = nn.ParameterList(
            nn.Parameter(dense_copy(part)) for part in torch.split(whole.weight, list(widths_in), dim=1)
        )
        self.bias = nn.Parameter(dense_copy(whole.bias))
        self.factors = nn.ModuleList(
            nn.Linear(width, config.feature_width) for width in (widths_in[-2:] if product else ())
        )
        self.output = nn.Linear(config.feature_width, width_out)

    @torch.no_grad()
    def start_from(self, other: "Head") -> None:
        """Compute what `other`, a head without products, makes of the first inputs; the further ones change nothing."""
        assert not len(other.factors)
        for place, weight in enumerate(self.inputs):
            weight.copy_(other.inputs[place] if place < len(other.inputs) else torch.zeros_like(weight))
        self.bias.copy_(other.bias)
        self.output.load_state_dict(other.output.state_dict())
        if len(self.factors):
            # The other factor keeps its weights, so that the product has a gradient and can be learnt.
            for parameter in self.factors[-1].parameters():
                parameter.zero_()

    def forward(self, *inputs: Tensor) -> Tensor:
        """Inputs [..., width_in] with leading axes that broadcast, to [..., width_out]."""
        hidden: Tensor = self.bias
        for weight, x in zip(self.inputs, inputs, strict=True):
            hidden = hidden + functional.linear(x, weight)
        if len(self.factors):
            one, other = (factor(x) for factor, x in zip(self.factors, inputs[-2:], strict=True))
            hidden = hidden + one * other
        return _as_tensor(self.output(functional.leaky_relu(hidden)))


def dense_copy(weights: Tensor) -> Tensor:
    """A copy of some weights of a layer, without a gradient."""
    # On the meta device, on which policies are read, the default format would import SymPy, half a second of work.
    return weights.detach().clone(memory_format=torch.contiguous_format)


def _as_tensor(x: object) -> Tensor:
    """What a module returned; torch types every module's result as Any."""
    assert isinstance(x, torch.Tensor)
    return x
