"""A store as compact arrays: every cloud once, its neighbour indices once, and rows grouped by rollout.

What cannot be seen is among them, as numbers for the oracle: hidden dynamics, and the ways in which the part can move.
A row's *twist* (w, v) says how its part moves: a point p that turns or slides by a small q is displaced by
q (w x p + v). It tells the side of a hinge and its sign.

Shapes: O clouds, N points, I interactions.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.training.hardware import moved
from shared.config import DynamicsRanges, Range
from shared.errors import StoreError, UsageError
from shared.geometry import view_from_world
from shared.hidden import ALWAYS_DRAWN
from shared.networks.actions import middle_of, outcome_details
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import CloudBatch, group_cloud
from shared.pinch import PROFILE_WIDTH, REACH_M, pinch_profiles
from shared.store.codecs.columns import LIST, Column, hidden_names, interaction_columns
from shared.store.codecs.tables import column_values
from shared.store.layout import MAX_ROWS
from shared.store.selection import observations_at
from shared.store.store import Store
from shared.types import Float, Float32, Observation, Order, OutcomeKind

COLUMNS = (
    *("plan_key", "rollout", "object_id", "step"),
    *("point_index", "rotation", "order", "role", "policy_version", "method", "budget", "target_part"),
    *("joint_positions", "joint_limits", "joint_twist", "outcome", "motion", "success"),
    "grasp_opening",
)
WAY_WIDTH = 7
WAYS_WIDTH = 2 * WAY_WIDTH
FACTS_WIDTH = len(ALWAYS_DRAWN) + WAYS_WIDTH
"""Where no other hidden parameters are drawn than always; each further one adds a number."""
_TOLD_AS: dict[str, Callable[[Float], Float]] = {
    "part_mass": lambda values: np.log(np.maximum(values, 1e-6)),
    "joint_friction": lambda values: values,
    "surface_friction": lambda values: np.log(np.maximum(values, 1e-6)),
}
"""How oracles were told these from the beginning; others are told as a place in their range."""
MIN_ROOM = 0.01
"""A part that has less room, rad or length, cannot move that way: no such motion would count as a success."""
MIN_TURNING = 0.1
"""Length of w below which a part slides; that of a hinge is 1."""
MAX_ROOM = 3.15
"""A joint without limits has as much room as half a turn."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Interactions, one an entry; vectors in the view frame of their cloud.

    Attributes:
        cloud: [I], index of the cloud.
        point: [I], index of p in it.
        xyz: p less the middle of what may be moved, [I, 3].
        frame: approach and forward, and the pinch profile where networks are told it, [I, 6 or more].
        motion: m, [I].
        success: r as 0 or 1, [I].
        details: kinds and grasp widths of the outcomes, [I, DETAIL_WIDTH] (see `shared.networks.actions`).
        step: [I], number within the rollout.
        continued: [I], whether the row began where the one before it left the object.
        facts: [I, facts], for the oracle only (see `facts_of`).
        valid: [I], whether the primitive ran to its end (see `shared.types.OutcomeKind.is_valid`).
        role, method: [I], names (see `shared.plan.InteractionRecord`).
        budget: [I].
    """

    cloud: Tensor
    point: Tensor
    xyz: Tensor
    frame: Tensor
    motion: Tensor
    success: Tensor
    details: Tensor
    step: Tensor
    continued: Tensor
    facts: Tensor
    valid: NDArray[np.bool_]
    role: NDArray[np.str_]
    method: NDArray[np.str_]
    budget: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.cloud)


@dataclass(frozen=True, slots=True)
class DenseClouds:
    """The surfaces that pinch profiles are computed from, as far as a hand reaches that acts on what may be moved.

    Attributes:
        points: of each cloud [M, 3], world frame.
        views: [O, 3, 3], the turns from the world to the view frame.
    """

    points: tuple[NDArray[np.float16], ...]
    views: Float

    def frames(self, cloud: Tensor, places: Tensor, frames: Tensor) -> Tensor:
        """Actions with their pinch profiles, [Q, S, 6 or more].

        Args:
            cloud: [Q].
            places: p, [Q, 3], view frame.
            frames: approach and forward of S actions at each, [Q, S, 6].
        """
        at, given = places.numpy(force=True), frames.numpy(force=True)
        profiles = np.empty((*given.shape[:2], PROFILE_WIDTH), np.float32)
        asked = cloud.numpy(force=True)
        for which in np.unique(asked):
            dense = self.points[which].astype(np.float32) @ self.views[which].T.astype(np.float32)
            for number in np.flatnonzero(asked == which):
                profiles[number] = pinch_profiles(dense, at[number], given[number])
        return torch.cat([frames, torch.as_tensor(profiles, device=frames.device)], dim=-1)


@dataclass(frozen=True, slots=True)
class Dataset:
    """A store's interactions.

    Attributes:
        task: of the store.
        primitive: what its interactions execute.
        clouds: every cloud once, with its neighbour indices, view frame.
        movable: [O, N].
        middles: of the movable points, [O, 3].
        rows: labels only; rows of failed infrastructure are left out.
        rollouts: for each rollout, its rows in order of step.
        objects: for each rollout, its object's id.
        versions: for each rollout, the version of the policy that proposed in it; 0 is none.
        dense: of the clouds, where networks are told pinch profiles.
    """

    task: str
    primitive: str
    clouds: CloudBatch
    movable: Tensor
    middles: Tensor
    rows: Rows
    rollouts: tuple[Tensor, ...]
    objects: tuple[str, ...]
    versions: tuple[int, ...]
    dense: DenseClouds | None = None

    def on(self, device: torch.device) -> "Dataset":
        """The same on a device; the numbers of the rollouts' rows stay, since batches are drawn on the CPU."""
        return self if device.type == "cpu" else replace(moved(self, device), rollouts=self.rollouts)

    def rollouts_of(self, objects: Collection[str]) -> tuple[int, ...]:
        """Numbers of the rollouts of some objects."""
        return tuple(number for number, name in enumerate(self.objects) if name in objects)


def load_dataset(store: Store, config: NetworkConfig) -> Dataset:
    """Load all labels of a store.

    Raises:
        StoreError: the store is damaged, or holds no label at all.
        UsageError: the networks are told pinch profiles, and the store keeps no depth images.
    """
    if config.pinch_profile and not store.setting.collection.camera.keep_depth:
        raise UsageError(
            f"{store.where}: keeps no depth images, which network.pinch_profile needs; collect with "
            "--collection.camera.keep-depth, or unset it"
        )
    ranges = store.setting.dynamics
    known = {column.name: column for column in interaction_columns(ranges.added)}
    hidden = hidden_names(ranges.added)
    names = (*COLUMNS, *hidden.values(), "observation")
    table = store.interactions(names)
    labels = pa.array([kind.value for kind in OutcomeKind if kind.is_label], pa.string())
    table = table.filter(pc.is_in(table.column("outcome"), value_set=labels))
    if not len(table):
        raise StoreError(f"{store.where}: holds no interaction to learn from; collect some first")
    cells = {name: _cells(table, known[name]) for name in names}
    shards, shard = _coded(table, "shard")
    seen, cloud = np.unique(shard * MAX_ROWS + cells["observation"], return_inverse=True)
    places = ((shards[number // MAX_ROWS], int(number % MAX_ROWS)) for number in seen)
    points, movable, views, dense = _read_clouds(store, places, len(seen), config.pinch_profile)
    batch = CloudBatch.of(points, (group_cloud(each, config) for each in points))
    masks = torch.from_numpy(movable)
    middles = middle_of(batch.points, masks)
    dynamics = {name: cells[column] for name, column in hidden.items()}
    rows = _rows(cells, dynamics, ranges, cloud, batch.points, views, middles)
    if dense is not None:
        at = batch.points[rows.cloud, rows.point]
        rows = replace(rows, frame=dense.frames(rows.cloud, at, rows.frame[:, None])[:, 0])
    order, starts = _by_rollout(table, cells)
    objects, of_object = _coded(table, "object_id")
    return Dataset(
        task=store.setting.task,
        primitive=store.setting.primitive,
        clouds=batch,
        movable=masks,
        middles=middles,
        rows=rows,
        rollouts=torch.from_numpy(order).tensor_split(torch.from_numpy(starts[1:])),
        objects=tuple(objects[number] for number in of_object[order[starts]]),
        versions=tuple(np.maximum.reduceat(cells["policy_version"][order], starts).tolist()),
        dense=dense,
    )


def _cells(table: Any, column: Column[Any]) -> Any:
    """A column as an array; lists of any length as their numbers, their lengths, and where each begins."""
    if not column.dtype:
        names, codes = _coded(table, column.name)
        return np.array(names)[codes]
    if column.width != LIST:
        return column_values(table, column)
    lists = table.column(column.name).combine_chunks()
    lengths = pc.list_value_length(lists).to_numpy().astype(np.int64)
    return lists.flatten().to_numpy(), lengths, np.cumsum(lengths) - lengths


def _coded(table: Any, name: str) -> tuple[list[str], NDArray[np.int64]]:
    """The different texts of a column, in order, and the number of each row's."""
    encoded = table.column(name).combine_chunks().dictionary_encode()
    texts = encoded.dictionary.to_pylist()
    order = sorted(range(len(texts)), key=texts.__getitem__)
    ranks = np.empty(len(texts), np.int64)
    ranks[order] = np.arange(len(texts))
    return [texts[number] for number in order], ranks[encoded.indices.to_numpy()]


def _read_clouds(
    store: Store, places: Iterable[tuple[str, int]], count: int, keep_dense: bool
) -> tuple[Float32, NDArray[np.bool_], Float, DenseClouds | None]:
    """Clouds by shard and index: points in the view frame, movable masks, and the turn from world to view [O, 3, 3].

    With `keep_dense`, their dense points as well.
    """
    size = store.setting.collection.camera.points
    # Filled one by one, since a list of so many arrays would be in memory beside what they are stacked into.
    points = np.empty((count, size, 3), np.float32)
    movable, views = np.empty((count, size), np.bool_), np.empty((count, 3, 3))
    dense = []
    for number, seen in enumerate(observations_at(store, places)):
        views[number] = view_from_world(seen.world_from_camera)
        points[number] = seen.points @ views[number].T.astype(np.float32)
        movable[number] = seen.movable
        if keep_dense:
            dense.append(_within_reach(seen))
    return points, movable, views, DenseClouds(tuple(dense), views) if keep_dense else None


def _within_reach(observation: Observation) -> NDArray[np.float16]:
    """The dense points that a hand can reach which acts on a movable point, [M, 3], world frame.

    Raises:
        StoreError: the observation keeps no depth image.
    """
    if observation.dense is None:
        raise StoreError("an observation of the store keeps no depth image; run `adaafford store verify`")
    points = observation.dense.points()
    touched = observation.points[observation.movable] if observation.movable.any() else observation.points
    low, high = touched.min(axis=0) - REACH_M, touched.max(axis=0) + REACH_M
    # Dense points are rounded to float16, so that this loses nothing.
    within: NDArray[np.float16] = points[((points >= low) & (points <= high)).all(axis=1)].astype(np.float16)
    return within


def _rows(
    cells: dict[str, Any],
    dynamics: dict[str, Float],
    ranges: DynamicsRanges,
    cloud: NDArray[np.int64],
    points: Tensor,
    views: NDArray[np.float64],
    middles: Tensor,
) -> Rows:
    view = views[cloud]
    rotation = cells["rotation"].reshape(-1, 3, 3)
    turned = np.einsum("iab,ibc->iac", view, rotation)
    frame = np.concatenate([turned[:, :, 2], turned[:, :, 0]], axis=1)
    point = cells["point_index"].astype(np.int64)
    if point.min() < 0 or point.max() >= points.shape[1]:
        raise StoreError("the store names a point that its cloud does not have; run `adaafford store verify`")
    hidden = HiddenColumns(
        twist=cells["joint_twist"].reshape(-1, 6),
        room=_room(cells),
        dynamics=dynamics,
        ranges=ranges,
        view=view,
        middle=middles.double().numpy()[cloud],
    )
    numbers = [cells["motion"], rotation, cells["joint_twist"]]
    facts = facts_of(hidden).astype(np.float32)
    if not all(np.isfinite(each.astype(np.float32)).all() for each in (*numbers, facts)):
        raise StoreError("the store holds numbers that are not finite; run `adaafford store verify`")
    return Rows(
        cloud=torch.from_numpy(cloud),
        point=torch.from_numpy(point),
        xyz=(points[torch.from_numpy(cloud), torch.from_numpy(point)] - middles[torch.from_numpy(cloud)]),
        frame=torch.from_numpy(frame.astype(np.float32)),
        motion=torch.from_numpy(cells["motion"].astype(np.float32)),
        success=torch.from_numpy(cells["success"].astype(np.float32)),
        details=torch.from_numpy(outcome_details(cells["outcome"], cells["grasp_opening"])),
        step=torch.from_numpy(cells["step"].astype(np.int64)),
        continued=torch.from_numpy(cells["order"] == Order.CONTINUE.value),
        facts=torch.from_numpy(facts),
        valid=np.isin(cells["outcome"], [kind.value for kind in OutcomeKind if kind.is_valid]),
        role=cells["role"],
        method=cells["method"],
        budget=cells["budget"].astype(np.int64),
    )


@dataclass(frozen=True, slots=True)
class HiddenColumns:
    """Columns of the store that facts are made from.

    Attributes:
        twist: [I, 6], (w, v) of the target joint, world frame.
        room: [I, 2], how far the target joint can go up and down from where it starts.
        dynamics: [I] each, the values of the hidden parameters.
        ranges: that they were drawn from.
        view: [I, 3, 3], view frame from world frame.
        middle: [I, 3], view frame, of what may be moved; actions are told their places from there.
    """

    twist: Float
    room: Float
    dynamics: Mapping[str, Float]
    ranges: DynamicsRanges
    view: Float
    middle: Float


def facts_of(hidden: HiddenColumns) -> Float:
    """Facts for the oracle, [I, FACTS_WIDTH or more], in the view frame.

    Columns: a number for each hidden parameter, first those that are always drawn; for each of the two ways in which
    the part might move, the room that it has and its twist (w, v), zero where there is no room. A joint's sign is a
    convention of its file, so that the ways come in an order of their own (`ordered_ways`).
    """
    turned = np.einsum("iab,icb->ica", hidden.view, hidden.twist.reshape(-1, 2, 3))
    # w x p + v is the same motion, whatever point p and v are taken from.
    turned[:, 1] += np.cross(turned[:, 0], hidden.middle)
    turned = turned.reshape(-1, 6)
    told = [_TOLD_AS[name](hidden.dynamics[name]) for name in ALWAYS_DRAWN]
    told += [_place(hidden.dynamics[name], hidden.ranges[name]) for name in hidden.ranges.added]
    room = np.clip(np.nan_to_num(hidden.room, nan=0.0, posinf=MAX_ROOM), 0.0, MAX_ROOM)[..., None]
    both = np.stack([turned, -turned], axis=1) * (room > MIN_ROOM)
    ways = ordered_ways(torch.from_numpy(np.concatenate([room, both], axis=2))).numpy()
    return np.concatenate([np.stack(told, axis=1), ways.reshape(len(ways), -1)], axis=1)


def _place(values: Float, interval: Range) -> Float:
    """Where values lie in an interval that they were drawn from: -1 at its lower end, 1 at its upper end."""
    low, high = interval.low, interval.high
    if interval.log:
        low, high, values = np.log(low), np.log(high), np.log(np.maximum(values, 1e-12))
    return np.asarray(2.0 * (values - low) / max(high - low, 1e-12) - 1.0)


def ordered_ways(ways: Tensor) -> Tensor:
    """The two ways of each part, [..., 2, WAY_WIDTH], the one about (or along) the more positive axis first.

    The axis counts by its largest component; that of a twist whose w is zero is v.
    """
    difference = ways[..., 0, 1:] - ways[..., 1, 1:]
    turning, sliding = difference[..., :3], difference[..., 3:]
    axis = torch.where(turning.norm(dim=-1, keepdim=True) > MIN_TURNING, turning, sliding)
    largest = torch.gather(axis, -1, axis.abs().argmax(dim=-1, keepdim=True))
    return torch.where((largest < 0)[..., None], ways.flip(-2), ways)


def _room(cells: dict[str, Any]) -> NDArray[np.float64]:
    """How far each row's target joint can go up and down from where it starts, [I, 2]."""
    (positions, joints, first), (limits, bounds, first_limit) = cells["joint_positions"], cells["joint_limits"]
    part = cells["target_part"].astype(np.int64)
    room = np.zeros((len(part), 2))
    row = np.flatnonzero((part >= 1) & (part <= np.minimum(joints, bounds // 2)))
    position, low = positions[(first + part - 1)[row]], (first_limit + 2 * part - 2)[row]
    room[row, 0], room[row, 1] = limits[low + 1] - position, position - limits[low]
    return room


def _by_rollout(table: Any, cells: dict[str, Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows in order of plan, rollout and step, [I], and where in this order each rollout begins."""
    plan, rollout = _coded(table, "plan_key")[1], cells["rollout"]
    order = np.lexsort((cells["step"], rollout, plan))
    is_first = (np.diff(plan[order], prepend=-1) != 0) | (np.diff(rollout[order], prepend=-1) != 0)
    return order, np.flatnonzero(is_first)
