"""The PointNet++ segmentation network, in plain PyTorch, evaluated only at the points that are asked about.

Clouds come in furthest-point order, so that the centres of its set abstractions are simply their first points. The
neighbour indices of a cloud never change: they are computed once, on the CPU, and kept beside it.

Shapes: B clouds, N points, n centres of a level, m points of the next finer level, k neighbours, C channels,
Q queried points.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional

from shared.networks.layers import Normalisation, PointwiseMlp, dense_copy
from shared.networks.network_config import NetworkConfig
from shared.types import Float32

INTERPOLATED = 3
"""Coarse points that a fine point's feature is interpolated from (PointNet++)."""
MAX_POINTS = np.iinfo(np.int16).max

Indices = NDArray[np.int16]
_QUERIES = 256
"""Points whose surroundings are sought at once; bounds memory."""
MIN_SQUARED_DISTANCE = 1e-8
"""Keeps the inverse-distance weights of a point finite at a centre."""


@dataclass(frozen=True, slots=True)
class Grouping:
    """Which points each level of PointNet++ looks at, from fine to coarse.

    Attributes:
        neighbours: for each level [n, k], indices into the next finer level (the cloud itself, for the first).
        nearest: for each level [m, 3], indices of the centres nearest to each point of the next finer level.
    """

    neighbours: tuple[Indices, ...]
    nearest: tuple[Indices, ...]


def group_cloud(points: Float32, config: NetworkConfig) -> Grouping:
    """Neighbour indices of one cloud.

    Deviation from PointNet++: the k *nearest* points within the radius stand in for the first k that are found there,
    so that the result does not depend on the order of the points. Missing neighbours repeat the nearest, the centre
    itself, which leaves the maximum over the neighbourhood as it is.

    Args:
        points: [N, 3], in furthest-point order.
        config: the sizes; levels larger than the cloud shrink to it.

    Raises:
        ValueError: the cloud is too large for 16-bit indices, empty, or holds a number that is not finite.
    """
    if not 0 < len(points) <= MAX_POINTS:
        raise ValueError(f"a cloud must hold 1 to {MAX_POINTS} points; given {len(points)}")
    if not np.isfinite(points).all():
        raise ValueError("a cloud must hold finite points only")
    neighbours, nearest, fine = [], [], points
    for count, radius in zip(config.centres, config.radii, strict=True):
        centres = fine[: min(count, len(fine))]
        neighbours.append(_within(fine, centres, config.neighbours, radius))
        nearest.append(_nearest(centres, fine))
        fine = centres
    return Grouping(tuple(neighbours), tuple(nearest))


def nearest_points(tree: cKDTree, asked: Float32, count: int) -> NDArray[np.int64]:
    """The `count` nearest of the cloud in a tree to each of some places, [Q, count]; too few repeat the farthest.

    The same as `surroundings` finds for single points of many clouds.
    """
    if not count:
        return np.zeros((len(asked), 0), dtype=np.int64)
    ranks = np.arange(1, min(count, tree.n) + 1)
    found = np.asarray(tree.query(asked, k=ranks)[1])
    return np.pad(found, ((0, 0), (0, count - len(ranks))), mode="edge")


def _within(points: Float32, centres: Float32, count: int, radius: float) -> Indices:
    """The `count` nearest of `points` within `radius` of each centre, [n, count]."""
    _, found = cKDTree(points).query(centres, k=np.arange(1, count + 1), distance_upper_bound=radius)
    return np.where(found == len(points), np.arange(len(centres))[:, None], found).astype(np.int16)


def _nearest(centres: Float32, points: Float32) -> Indices:
    """The three of `centres` nearest to each point, [m, 3]; where there are fewer, the nearest again."""
    found = np.asarray(cKDTree(centres).query(points, k=np.arange(1, INTERPOLATED + 1))[1])
    return np.where(found == len(centres), found[:, :1], found).astype(np.int16)


@dataclass(frozen=True, slots=True)
class CloudBatch:
    """Clouds of one size with their neighbour indices.

    Attributes:
        points: [B, N, 3], view frame, furthest-point order.
        neighbours: for each level [B, n, k] (see `Grouping`).
        nearest: for each level [B, m, 3].
        extra: [B, N, E], further inputs of each point; None: its place is all that is known of it.
    """

    points: Tensor
    neighbours: tuple[Tensor, ...]
    nearest: tuple[Tensor, ...]
    extra: Tensor | None = None

    @property
    def inputs(self) -> Tensor:
        """What is known of each point, [B, N, 3 + E]."""
        return self.points if self.extra is None else torch.cat([self.points, self.extra], dim=-1)

    @classmethod
    def of(
        cls,
        points: Float32 | Sequence[Float32],
        groupings: Iterable[Grouping],
        extra: Sequence[Float32] | None = None,
    ) -> "CloudBatch":
        """Stack clouds that have one size, their indices, which are taken one by one, and their further inputs."""
        stacked = np.asarray(points)
        levels: list[NDArray[np.int16]] = []
        for number, grouping in enumerate(groupings):
            found = (*grouping.neighbours, *grouping.nearest)
            if not levels:
                levels = [np.empty((len(stacked), *indices.shape), np.int16) for indices in found]
            for all_indices, indices in zip(levels, found, strict=True):
                all_indices[number] = indices
        tensors = tuple(torch.from_numpy(indices) for indices in levels)
        neighbours, nearest = tensors[: len(tensors) // 2], tensors[len(tensors) // 2 :]
        further = None if extra is None else torch.from_numpy(np.asarray(extra))
        return cls(torch.from_numpy(stacked), neighbours, nearest, further)

    def select(self, clouds: Tensor) -> "CloudBatch":
        """The clouds at the indices `clouds`, [any]."""
        return CloudBatch(
            self.points[clouds],
            tuple(x[clouds] for x in self.neighbours),
            tuple(x[clouds] for x in self.nearest),
            None if self.extra is None else self.extra[clouds],
        )


@dataclass(frozen=True, slots=True)
class EncodedClouds:
    """Clouds after everything that does not depend on which points are asked about.

    Attributes:
        clouds: what was encoded.
        centre_features: [B, n, C], at the first n points of each cloud.
    """

    clouds: CloudBatch
    centre_features: Tensor

    def detach(self) -> "EncodedClouds":
        """The same, cut off from the gradient."""
        return EncodedClouds(self.clouds, self.centre_features.detach())


class PointNet2(nn.Module):
    """PointNet++ segmentation network: a cloud in, a feature a point out (AdaAfford, Input Encoders).

    Its last step, the propagation from the first level's centres to the points, is done only where a feature is
    needed (`at`): the same values at a fraction of the cost, since a cloud has thousands of points and few actions.
    `extra` is how many further inputs each point has.
    Under batch normalisation that last step's statistics are those of the queried points (a deviation).

    Example:
        >>> encoder = PointNet2(NetworkConfig())
        >>> encoded = encoder(clouds)                     # once a cloud
        >>> features = encoder.at(encoded, cloud, point)  # [Q, 128], as often as needed
    """

    def __init__(self, config: NetworkConfig, extra: int = 0) -> None:
        super().__init__()
        self.width = config.point_width
        self.surroundings = config.surroundings
        widths = [3 + extra]
        self.abstractions = nn.ModuleList()
        for layer_widths in config.abstraction:
            self.abstractions.append(SetAbstraction(widths[-1], layer_widths, config.normalisation))
            widths.append(layer_widths[-1])
        self.propagations = nn.ModuleList()
        coarse = widths.pop()
        for layer_widths in config.propagation:
            self.propagations.append(PointwiseMlp(coarse + widths.pop(), layer_widths, config.normalisation))
            coarse = layer_widths[-1]

    def forward(self, clouds: CloudBatch) -> EncodedClouds:
        """Encode clouds up to the features of the first level's centres."""
        positions, features = [clouds.points], [clouds.inputs]
        for abstraction, neighbours in zip(self.abstractions, clouds.neighbours, strict=True):
            features.append(abstraction(positions[-1], features[-1], neighbours.long()))
            positions.append(positions[-1][:, : neighbours.shape[1]])
        coarse = features.pop()
        for propagation, level in zip(self.propagations, range(len(features) - 1, 0, -1), strict=False):
            nearest = clouds.nearest[level].long()
            weights = interpolation_weights(positions[level][:, :, None], gather(positions[level + 1], nearest))
            spread = (gather(coarse, nearest) * weights[..., None]).sum(dim=2)
            coarse = propagation(torch.cat([spread, features.pop()], dim=-1))
        return EncodedClouds(clouds, coarse)

    def features_at(self, encoded: EncodedClouds, cloud: Tensor, point: Tensor) -> Tensor:
        """Features f_p|O of single points, [Q, C].

        Args:
            encoded: the clouds.
            cloud: [Q], which cloud each point is of.
            point: [Q], its index in that cloud.
        """
        points = encoded.clouds.points
        xyz = points[cloud, point]
        nearest = encoded.clouds.nearest[0][cloud, point].long()
        rows = (nearest + cloud[:, None] * encoded.centre_features.shape[1]).flatten()
        features = encoded.centre_features.flatten(0, 1).index_select(0, rows).reshape(*nearest.shape, -1)
        weights = interpolation_weights(xyz[:, None], points[cloud[:, None], nearest])
        spread = (features * weights[..., None]).sum(dim=1)
        known = xyz if encoded.clouds.extra is None else torch.cat([xyz, encoded.clouds.extra[cloud, point]], dim=-1)
        result = self.propagations[-1](torch.cat([spread, known], dim=-1))
        assert isinstance(result, Tensor)
        return result

    def at(self, encoded: EncodedClouds, cloud: Tensor, point: Tensor) -> Tensor:
        """All that is known of single points where actions are judged, [Q, width]: f_p|O, then what lies around.

        Offsets of the nearest points, [Q, 3 * surroundings], follow the features in one tensor, so that whoever keeps
        or hands on the one has the other; `ActionEncoder` and `point_features` take them apart.
        """
        features = self.features_at(encoded, cloud, point)
        if not self.surroundings:
            return features
        points = encoded.clouds.points
        around = surroundings(points, cloud, points[cloud, point], self.surroundings)
        return torch.cat([features, around.flatten(-2)], dim=-1)


def surroundings(points: Tensor, cloud: Tensor, centres: Tensor, count: int) -> Tensor:
    """Offsets of the nearest points of each cloud, [Q, count, 3]; a cloud with fewer points repeats its farthest one.

    Args:
        points: [B, N, 3].
        cloud: [Q], which cloud.
        centres: [Q, 3], in it.
        count: how many.
    """
    found = []
    for first in range(0, len(cloud), _QUERIES):
        here = slice(first, first + _QUERIES)
        offsets = points[cloud[here]] - centres[here, None]
        nearest = offsets.square().sum(dim=-1).topk(min(count, points.shape[1]), dim=-1, largest=False).indices
        found.append(offsets.gather(1, nearest[..., None].expand(-1, -1, 3)))
    near = torch.cat(found) if found else centres.new_zeros(0, min(count, points.shape[1]), 3)
    return torch.cat([near, near[:, -1:].expand(-1, count - near.shape[1], 3)], dim=1)


class SetAbstraction(nn.Module):
    """One set abstraction of PointNet++: a perceptron on each centre's neighbours, and the maximum over them.

    The first layer acts on a neighbour's place relative to its centre and on its feature. Its two halves are kept
    apart, so that wide features are multiplied once a point instead of once a neighbour; the function is the same.

    Deviation: layer normalisation comes once, after the maximum, where the published batch normalisation follows every
    layer; neighbours are most of the rows, and this halves the time of a training step.
    """

    def __init__(self, width_in: int, widths: Sequence[int], kind: str) -> None:
        super().__init__()
        whole = nn.Linear(3 + width_in, widths[0], bias=False)
        self.from_offset = nn.Parameter(dense_copy(whole.weight[:, :3]))
        self.from_feature = nn.Parameter(dense_copy(whole.weight[:, 3:]))
        self.bias = nn.Parameter(torch.zeros(widths[0]))
        self.neighbour_norm = Normalisation(widths[0], kind) if kind == "batch" else nn.Identity()
        self.rest = PointwiseMlp(widths[0], widths[1:], kind if kind == "batch" else "none", last_relu=False)
        self.centre_norm = Normalisation(widths[-1], kind) if kind == "layer" else nn.Identity()

    def forward(self, positions: Tensor, features: Tensor, neighbours: Tensor) -> Tensor:
        """Positions [B, m, 3], features [B, m, C_in], neighbours [B, n, k] to the centres' features [B, n, C]."""
        offsets = gather(positions, neighbours) - positions[:, : neighbours.shape[1], None]
        if features.shape[-1] <= 3:
            # Narrow features are cheaper to gather than their products, and need no gradient here.
            inputs = torch.cat([offsets, gather(features, neighbours)], dim=-1)
            hidden = functional.linear(inputs, torch.cat([self.from_offset, self.from_feature], dim=1), self.bias)
        else:
            from_features = gather(functional.linear(features, self.from_feature, self.bias), neighbours)
            hidden = from_features + functional.linear(offsets, self.from_offset)
        # The maximum by `max` sends its gradient to one neighbour; that of `amax` costs three passes over all of them.
        # Without a gradient `amax` is the faster one. ReLU and maximum commute, and ReLU is cheaper after it.
        hidden = self.neighbour_norm(hidden)
        hidden = self.rest(torch.relu(hidden)) if len(self.rest.layers) else hidden
        pooled = hidden.max(dim=2).values if torch.is_grad_enabled() else hidden.amax(dim=2)
        return torch.relu(self.centre_norm(pooled))


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """Values [B, m, C] at indices [B, n, k], [B, n, k, C]."""
    first_rows = torch.arange(len(values))[:, None, None] * values.shape[1]
    return values.flatten(0, 1).index_select(0, (indices + first_rows).flatten()).reshape(*indices.shape, -1)


def interpolation_weights(points: Tensor, centres: Tensor) -> Tensor:
    """Inverse squared-distance weights [..., 3] of the centres [..., 3, 3] nearest to points [..., 1, 3]."""
    inverse = 1.0 / (points - centres).square().sum(dim=-1).clamp_min(MIN_SQUARED_DISTANCE)
    return inverse / inverse.sum(dim=-1, keepdim=True)
