"""A straightforward port of the published training step of AAP, as a yardstick: what the paper describes, line by line.

Each interaction brings a cloud of 10,000 points of its own; furthest-point sampling and ball grouping happen inside the
step; PointNet++ has the published sizes and batch normalisation, and gives every point a feature; the critic then looks
at one of them. Plain PyTorch, batched over clouds, with no trick and no deliberate waste.

Shapes: B clouds (one an interaction), N points, n centres, k neighbours, C channels.
"""

import torch
from torch import Tensor, nn

from learner.training.losses import action_scoring_loss
from shared.networks.aap import Aap
from shared.networks.network_config import NETWORKS, NetworkConfig

POINTS = 10_000
LEARNING_RATE = 1e-4
WEIGHT_DECAY = 1e-5


class PublishedStep:
    """Takes training steps of the AAP critic on interactions of one rollout, half of which are context."""

    def __init__(self, seed: int) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.encoder = PublishedEncoder(NETWORKS["published"])
            self.aap = Aap(NETWORKS["published"])
        own = [p for name, p in self.aap.named_parameters() if not name.startswith("encoder.")]
        self.optimiser = torch.optim.Adam([*self.encoder.parameters(), *own], LEARNING_RATE, weight_decay=WEIGHT_DECAY)

    def __call__(self, clouds: Tensor, points: Tensor, frames: Tensor, motions: Tensor, successes: Tensor) -> float:
        """One step; returns the loss.

        Args:
            clouds: [B, N, 3].
            points: index of p in each, [B].
            frames: approach and forward, [B, 6].
            motions: m, [B].
            successes: r as 0 or 1, [B].
        """
        features = self.encoder(clouds)[torch.arange(len(clouds)), points]
        places = clouds[torch.arange(len(clouds)), points]
        context = slice(0, max(1, len(clouds) // 2))
        codes, weights = self.aap.interaction_codes(
            features[context], places[context], frames[context], motions[context], successes[context]
        )
        logits = self.aap.action_logits(features, places, frames, self.aap.latent(codes, weights))
        loss = action_scoring_loss(logits, successes)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return loss.item()


class PublishedEncoder(nn.Module):
    """PointNet++ for segmentation with the published sizes."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        widths = [0]
        self.abstractions = nn.ModuleList()
        for layers in config.abstraction:
            self.abstractions.append(_perceptron(nn.Conv2d, nn.BatchNorm2d, 3 + widths[-1], layers))
            widths.append(layers[-1])
        self.propagations = nn.ModuleList()
        coarse = widths.pop()
        for layers in config.propagation:
            self.propagations.append(_perceptron(nn.Conv1d, nn.BatchNorm1d, coarse + widths.pop(), layers))
            coarse = layers[-1]

    def forward(self, clouds: Tensor) -> Tensor:
        """The feature of every point, [B, N, C]."""
        places, features = [clouds], [clouds[:, :, :0]]
        levels = zip(self.abstractions, self.config.centres, self.config.radii, strict=True)
        for perceptron, count, radius in levels:
            fine, values = places[-1], features[-1]
            centres = _select(fine, furthest_points(fine, count))
            neighbours = ball_neighbours(fine, centres, radius, self.config.neighbours)
            offsets = _select(fine, neighbours) - centres[:, :, None]
            grouped = torch.cat([offsets, _select(values, neighbours)], dim=-1)
            features.append(perceptron(grouped.permute(0, 3, 1, 2)).amax(dim=3).transpose(1, 2))
            places.append(centres)
        coarse = features.pop()
        for perceptron in self.propagations:
            centres = places.pop()
            joined = torch.cat([interpolated(places[-1], centres, coarse), features.pop()], dim=-1)
            coarse = perceptron(joined.transpose(1, 2)).transpose(1, 2)
        return coarse


def furthest_points(points: Tensor, count: int) -> Tensor:
    """Indices of points that are far from each other, [B, count]: each is the furthest from those before it."""
    chosen = torch.zeros(len(points), count, dtype=torch.long)
    nearest = torch.full(points.shape[:2], torch.inf)
    for place in range(1, count):
        last = _select(points, chosen[:, place - 1, None])
        nearest = torch.minimum(nearest, (points - last).square().sum(dim=-1))
        chosen[:, place] = nearest.argmax(dim=-1)
    return chosen


def ball_neighbours(points: Tensor, centres: Tensor, radius: float, count: int) -> Tensor:
    """The first `count` points within the radius of each centre, [B, n, count]; the first of them fills up the rest."""
    number = torch.arange(points.shape[1]).expand(*centres.shape[:2], -1)
    inside = torch.cdist(centres, points) <= radius
    numbered = torch.where(inside, number, points.shape[1])
    first = numbered.topk(min(count, points.shape[1]), dim=-1, largest=False).values
    # Rounding may leave a centre out of its own ball.
    first[..., 0].clamp_(max=points.shape[1] - 1)
    return torch.where(first == points.shape[1], first[..., :1], first)


def interpolated(points: Tensor, centres: Tensor, features: Tensor) -> Tensor:
    """Features of the three nearest centres by inverse squared distance, [B, N, C]."""
    distances, nearest = torch.cdist(points, centres).topk(3, dim=-1, largest=False)
    weights = 1.0 / distances.square().clamp_min(1e-8)
    weights = weights / weights.sum(dim=-1, keepdim=True)
    return (_select(features, nearest) * weights[..., None]).sum(dim=2)


def _select(values: Tensor, indices: Tensor) -> Tensor:
    """Values [B, N, C] at indices [B, ...], [B, ..., C]."""
    first = torch.arange(len(values)).reshape(-1, *([1] * (indices.dim() - 1))) * values.shape[1]
    return values.flatten(0, 1).index_select(0, (indices + first).flatten()).reshape(*indices.shape, values.shape[-1])


def _perceptron(
    layer: type[nn.Conv1d] | type[nn.Conv2d], norm: type[nn.Module], width: int, widths: tuple[int, ...]
) -> nn.Sequential:
    """The shared perceptron of PointNet++ over channels-first features."""
    layers: list[nn.Module] = []
    for out in widths:
        layers += [layer(width, out, 1, bias=False), norm(out), nn.ReLU()]
        width = out
    return nn.Sequential(*layers)
