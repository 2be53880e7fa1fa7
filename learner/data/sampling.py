"""Batches: which rows are context, which are asked about, and which clouds that needs.

Shapes: B ordered sets of interactions, n rows of each (padded), K the longest context.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data.augmentation import flip_frames, turn_facts, turn_frames, turn_vectors
from learner.data.dataset import Dataset
from shared.networks.pointnet2 import CloudBatch, PointNet2


@dataclass(frozen=True, slots=True)
class OrderedRows:
    """Ordered sets of interactions, each of one rollout; the first are context for the others.

    Attributes:
        rows: [B, n], indices into the data set's rows; padding repeats a row.
        valid: [B, n], false for padding.
        clouds: [U], the clouds that occur, each once.
        cloud: [B, n], index into `clouds`.
    """

    rows: Tensor
    valid: Tensor
    clouds: Tensor
    cloud: Tensor

    def select(self, places: slice) -> "OrderedRows":
        """Some of the sets."""
        if places == slice(0, None, 1):
            return self
        clouds, which = torch.unique(self.cloud[places], return_inverse=True)
        return OrderedRows(self.rows[places], self.valid[places], self.clouds[clouds], which)

    def longest_context(self, limit: int) -> int:
        """The longest context, of at most `limit` interactions, that leaves a row to ask about."""
        return min(limit, self.rows.shape[1] - 1)

    def asked(self, context: int) -> Tensor:
        """Which rows each prefix of the context is asked about: those after it, [B, context + 1, n].

        Context and questions never overlap.
        """
        place = torch.arange(self.rows.shape[1])
        prefix = torch.arange(context + 1)
        return (place[None, None] >= prefix[None, :, None]) & self.valid[:, None]


def order_rows(
    dataset: Dataset,
    rollouts: Sequence[int],
    size: int,
    rng: np.random.Generator,
    continued_first: float = 0.0,
) -> OrderedRows:
    """A random ordered subset of each rollout's rows.

    Args:
        dataset: the interactions.
        rollouts: which ones, [B]; a rollout may occur more than once.
        size: n, the most rows of each.
        rng: draws the orders.
        continued_first: how often the interactions that continued one another come first, in the order in which they
            were made, as at test time (AdaAfford, Training Strategy: AAP is fine-tuned with the proposed interactions).
    """
    orders, continued = [], dataset.rows.continued.numpy(force=True)
    for number in rollouts:
        order = rng.permutation(dataset.rollouts[number].numpy())
        if rng.random() < continued_first:
            # The rows of a rollout are in order of step, so that a sort by row is a sort by step.
            first = np.array([row for row in dataset.rollouts[number].tolist() if continued[row]], dtype=np.int64)
            order = np.concatenate([first, order[~continued[order]]])
        orders.append(order)
    return padded(dataset, orders, size)


def padded(dataset: Dataset, orders: Sequence[NDArray[np.int64]], size: int) -> OrderedRows:
    """Ordered rows of equal length: at most the first `size` of each, padded to the longest."""
    width = min(size, max(map(len, orders)))
    rows = np.zeros((len(orders), width), dtype=np.int64)
    valid = np.zeros((len(orders), width), dtype=bool)
    for place, order in enumerate(orders):
        kept = order[:width]
        rows[place], valid[place, : len(kept)] = kept[0], True
        rows[place, : len(kept)] = kept
    index = torch.as_tensor(rows)
    clouds, cloud = torch.unique(dataset.rows.cloud[index], return_inverse=True)
    return OrderedRows(index, torch.as_tensor(valid), clouds, cloud)


@dataclass(frozen=True, slots=True)
class Batch:
    """Ordered sets of interactions as networks take them.

    Attributes:
        clouds: the clouds that occur, each once.
        cloud: [B, n], index of each row's cloud among them.
        point: [B, n], index of p in it.
        xyz: p less the middle of what may be moved, [B, n, 3].
        frame: approach and forward, and the pinch profile where networks are told it, [B, n, 6 or more].
        motion: m, [B, n].
        success: r as 0 or 1, [B, n].
        details: of the outcomes, [B, n, DETAIL_WIDTH].
        facts: [B, n, facts].
    """

    clouds: CloudBatch
    cloud: Tensor
    point: Tensor
    xyz: Tensor
    frame: Tensor
    motion: Tensor
    success: Tensor
    details: Tensor
    facts: Tensor

    @classmethod
    def of(
        cls, dataset: Dataset, ordered: OrderedRows, turns: Tensor | None = None, flips: Tensor | None = None
    ) -> "Batch":
        """Collect the rows.

        Args:
            dataset: the interactions.
            ordered: which of them.
            turns: what each set is seen after, [B, 3, 3]; sets must then share no cloud.
            flips: whether the gripper is turned about its approach in each set, [B].
        """
        rows, index = dataset.rows, ordered.rows
        clouds = dataset.clouds.select(ordered.clouds)
        xyz, frame, facts = rows.xyz[index], rows.frame[index], rows.facts[index]
        if turns is not None:
            owner = torch.zeros(len(ordered.clouds), dtype=torch.long)
            owner[ordered.cloud.flatten()] = torch.arange(len(index)).repeat_interleave(index.shape[1])
            clouds = replace(clouds, points=turn_vectors(turns[owner], clouds.points))
            xyz, frame, facts = turn_vectors(turns, xyz), turn_frames(turns, frame), turn_facts(turns, facts)
        if flips is not None:
            frame = flip_frames(flips, frame)
        point, motion, success = rows.point[index], rows.motion[index], rows.success[index]
        details = rows.details[index]
        return cls(clouds, ordered.cloud, point, xyz, frame, motion, success, details, facts)

    def features(self, encoder: PointNet2) -> Tensor:
        """What is known of the rows' points, [B, n, point_width]; each cloud is encoded once."""
        flat = encoder.at(encoder(self.clouds), self.cloud.flatten(), self.point.flatten())
        return flat.reshape(*self.point.shape, -1)


def spread(numbers: Sequence[int], most: int) -> list[int]:
    """At most `most` of the numbers, evenly over all of them, so that no plan or object is left out."""
    return [numbers[place] for place in np.linspace(0, len(numbers) - 1, min(most, len(numbers))).astype(int)]


def draw(numbers: Sequence[int], most: int, rng: np.random.Generator) -> list[int]:
    """At most `most` of the numbers at random, each once."""
    return [numbers[place] for place in rng.choice(len(numbers), min(most, len(numbers)), replace=False)]
