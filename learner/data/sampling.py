"""Batches: which rollouts are learnt from, which rows are context, which are asked about, and how they are seen.

Not in the paper: the same interactions are seen turned about the vertical, and in a mirror. Gravity points down in the
view frame, so that physics is the same after a turn about z or a reflection of y; the hand is its own mirror image once
its fingers are swapped, which keeps approach and forward. Neighbours stay neighbours.

Shapes: B ordered sets of interactions, n rows of each (padded), K the longest context.
"""

import zlib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data.dataset import WAY_WIDTH, WAYS_WIDTH, Dataset, ordered_ways
from learner.settings import AugmentationConfig
from shared.errors import UsageError
from shared.io.files import read_named
from shared.networks.actions import FRAME_WIDTH, swapped_fingers, turned_over
from shared.networks.pointnet2 import CloudBatch, PointNet2

MAX_LIST_BYTES = 1 << 20
VALIDATION_SHARE = 5
"""Without lists of objects, one object in this many is kept for validation, chosen by a hash of its id."""


@dataclass(frozen=True, slots=True)
class Split:
    """Rollouts to learn from, and rollouts of other objects to judge by."""

    train: tuple[int, ...]
    validation: tuple[int, ...]


def split(dataset: Dataset, train: Collection[str] | None, validation: Collection[str] | None) -> Split:
    """Split a data set's rollouts by object.

    Args:
        dataset: the interactions.
        train: ids of the objects to learn from; None: all but those for validation.
        validation: ids of the objects to judge by; None: all but those for training, or, where these are not given
            either, one object in five, by a hash of its id.

    Raises:
        UsageError: an object is in both, or one of the two has no rollout.
    """
    leaked = sorted(set(train or ()) & set(validation or ()))
    if leaked:
        raise UsageError(f"object '{leaked[0]}' is listed for training and for validation; list each object once")
    if validation is None:
        validation = set(dataset.objects) - set(train) if train is not None else kept_for_validation(dataset.objects)
    if train is None:
        train = set(dataset.objects) - set(validation)
    parts = Split(dataset.rollouts_of(train), dataset.rollouts_of(validation))
    for name, found in (("training", parts.train), ("validation", parts.validation)):
        if not found:
            raise UsageError(f"no rollout of the store is of an object for {name}; collect or list more objects")
    return parts


def kept_for_validation(objects: Iterable[str]) -> frozenset[str]:
    """One object in five, by a hash of its id, and at least one."""
    # A rank, instead of a remainder of the hash, never comes out empty for few objects.
    ranked = sorted(set(objects), key=lambda name: (zlib.crc32(name.encode()), name))
    return frozenset(ranked[: max(1, len(ranked) // VALIDATION_SHARE)])


def without_later(dataset: Dataset, parts: Split, newest: int) -> Split:
    """The split without what policies later than `newest` proposed to learn from; what is judged by stays.

    Raises:
        UsageError: nothing is left.
    """
    train = tuple(number for number in parts.train if dataset.versions[number] <= newest)
    if not train:
        raise UsageError(f"no rollout to learn from is of policy {newest} or older; collect some at random first")
    return Split(train, parts.validation)


def read_object_list(path: Path | None) -> frozenset[str] | None:
    """Object ids, one a line; what follows a blank (such as Where2Act's category) is ignored.

    Raises:
        UsageError: the file is missing, too large, not text, or lists nothing.
    """
    if path is None:
        return None
    advice = "name a text file with one object id a line"
    try:
        lines = read_named(path, MAX_LIST_BYTES, advice).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise UsageError(f"{path}: not text; {advice}") from None
    names = frozenset(line.split()[0] for line in lines if line.split())
    if not names:
        raise UsageError(f"{path}: lists no object; write one object id a line")
    return names


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


def draw_turns(count: int, config: AugmentationConfig, rng: np.random.Generator) -> Tensor:
    """Orthogonal matrices that keep the vertical, [count, 3, 3]."""
    angle = np.deg2rad(config.turn_deg) * rng.uniform(-1.0, 1.0, count)
    mirrored = rng.random(count) < 0.5 if config.mirror else np.zeros(count, dtype=bool)
    cos, sin, sign = np.cos(angle), np.sin(angle), np.where(mirrored, -1.0, 1.0)
    turns = np.zeros((count, 3, 3), dtype=np.float32)
    turns[:, 0, 0], turns[:, 0, 1] = cos, -sin * sign
    turns[:, 1, 0], turns[:, 1, 1] = sin, cos * sign
    turns[:, 2, 2] = 1.0
    return torch.as_tensor(turns)


def draw_flips(count: int, config: AugmentationConfig, rng: np.random.Generator) -> Tensor:
    """Whether the gripper is turned about its approach in each set, [count]."""
    return torch.as_tensor(rng.random(count) < 0.5 if config.flip else np.zeros(count, dtype=bool))


def turn_frames(turns: Tensor, frames: Tensor) -> Tensor:
    """Frames with or without pinch profiles, [B, n, 6 or more], after the turns [B, 3, 3]."""
    if frames.shape[-1] == FRAME_WIDTH:
        return turn_vectors(turns, frames)
    turned = torch.cat([turn_vectors(turns, frames[..., :FRAME_WIDTH]), frames[..., FRAME_WIDTH:]], dim=-1)
    # A mirror keeps approach and forward, and so swaps the fingers.
    return torch.where((torch.linalg.det(turns) < 0)[:, None, None], swapped_fingers(turned), turned)


def flip_frames(flips: Tensor, frames: Tensor) -> Tensor:
    """Frames with or without pinch profiles, [B, n, 6 or more], turned about the approach in the sets `flips`, [B]."""
    return torch.where(flips[:, None, None], turned_over(frames), frames) if flips.any() else frames


def turn_vectors(turns: Tensor, vectors: Tensor) -> Tensor:
    """Vectors or points, [B, n, 3 k], each three of them turned by the matrices [B, 3, 3]."""
    triples = vectors.reshape(*vectors.shape[:2], -1, 3)
    return _turned(turns, triples).reshape(vectors.shape)


def turn_facts(turns: Tensor, facts: Tensor) -> Tensor:
    """Facts for the oracle, [B, n, facts], of what is seen after the turns (see `learner.data.dataset.facts_of`)."""
    dynamics = facts[..., :-WAYS_WIDTH]
    ways = facts[..., -WAYS_WIDTH:].reshape(*facts.shape[:2], 2, WAY_WIDTH)
    room, turning, sliding = ways[..., :1], ways[..., 1:4], ways[..., 4:]
    # An axis of rotation is the cross product of two vectors: a mirror turns it round beside reflecting it.
    handed = torch.linalg.det(turns)[:, None, None, None]
    turning = handed * _turned(turns, turning)
    sliding = _turned(turns, sliding)
    turned = ordered_ways(torch.cat([room, turning, sliding], dim=-1))
    return torch.cat([dynamics, turned.flatten(-2)], dim=-1)


def _turned(turns: Tensor, triples: Tensor) -> Tensor:
    """Vectors [B, n, k, 3] turned; a sum of products, since a matrix product may be taken in half precision."""
    return (turns[:, None, None] * triples[..., None, :]).sum(dim=-1)
