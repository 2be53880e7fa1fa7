"""The columns of the two tables: one list that the writer, the reader, the digest and the schema all follow."""

import hashlib
import json
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from shared.hidden import ALWAYS_DRAWN, NAME, hidden_parameter
from shared.plan import InteractionRecord, RolloutRecord, RolloutStatus
from shared.types import Direction, Float, Order, OutcomeKind, Role

Row = TypeVar("Row")

LIST = -1
"""Width of a cell that holds any number of numbers."""
MAX_TEXT = 200
"""Characters of a cell, unless its column says otherwise."""
MAX_JOINT_NAMES = 1 << 16
HIDDEN_PREFIX = "hidden_"
"""Before the name of a hidden parameter that not every store has; no other column begins so."""


@dataclass(frozen=True, slots=True)
class RolloutRow:
    """What a row of rollouts.parquet is computed from."""

    rollout: RolloutRecord
    first_observation: int
    """Index within the shard of the rollout's first observation."""


@dataclass(frozen=True, slots=True)
class InteractionRow:
    """What a row of interactions.parquet is computed from."""

    rollout: RolloutRecord
    interaction: InteractionRecord
    first_observation: int

    def in_camera(self, vectors: Float, *, place: bool) -> Float:
        """Columns [3] or [3, k] of the world in the camera's frame; a place is moved, a direction only turned."""
        pose = self.rollout.observations[self.interaction.observation].world_from_camera
        turned: Float = pose[:3, :3].T @ (vectors - pose[:3, 3] if place else vectors)
        return turned


@dataclass(frozen=True, slots=True)
class Column(Generic[Row]):
    """One column.

    Attributes:
        name: of the column.
        dtype: little-endian numpy type of a cell's numbers; "" for text.
        width: 0 for a scalar, n for a vector, LIST for any number of numbers.
        description: for the schema.
        value: the cell of a row.
        content: whether it enters the content digest; what depends on the shard, on time or on other columns does not.
        default: of a column that came after others, what rows hold that were written before (a tuple for a list); None
            for the first ones.
            Such a column is no content, since older software could not compute the digest (docs/compatibility.md).
        allowed: the texts that there are; None: any that is printable.
        longest: characters of a text.
        finite: whether a number is never NaN or infinite.
    """

    name: str
    dtype: str
    width: int
    description: str
    value: Callable[[Row], Any]
    content: bool = True
    default: Any = None
    allowed: type[StrEnum] | None = None
    longest: int = MAX_TEXT
    finite: bool = True

    def __post_init__(self) -> None:
        """Hold a column that was added to what older software can verify."""
        assert self.default is None or not self.content, f"{self.name} has a default, so it must be no content"

    @property
    def arrow_type(self) -> Any:
        """The pyarrow type."""
        return _arrow_type(self.dtype, self.width)

    @property
    def field(self) -> Any:
        """The pyarrow field, with the description in its metadata."""
        return _field(self.name, self.arrow_type, self.description)

    def gather(self, rows: Sequence[Row]) -> "Cells":
        """The column's cells for some rows.

        Raises:
            ValueError: a cell has another shape than the column.
            TypeError: a cell is of another type.
            OverflowError: an integer does not fit.
        """
        values = [self.value(row) for row in rows]
        if not self.dtype:
            return Cells(np.empty(0), tuple(str(value) for value in values), ())
        if self.width == LIST:
            parts = [np.asarray(value, self.dtype) for value in values]
            if any(part.ndim != 1 for part in parts):
                raise ValueError(f"{self.name} must be a list of numbers")
            return Cells(np.concatenate([np.empty(0, self.dtype), *parts]), (), tuple(len(part) for part in parts))
        if self.dtype[1] in "iu":
            values = [operator.index(value) for value in values]
        numbers = np.array(values, self.dtype)
        shape = (len(rows), self.width) if self.width else (len(rows),)
        if numbers.size and numbers.shape != shape:
            raise ValueError(f"{self.name} has shape {numbers.shape[1:]}, needs {shape[1:]}")
        return Cells(numbers.ravel(), (), ())


# Made once: a store has as many columns as shards times their width, and all are alike.
@lru_cache(maxsize=1024)
def _arrow_type(dtype: str, width: int) -> Any:
    if not dtype:
        return pa.string()
    number = pa.from_numpy_dtype(np.dtype(dtype))
    return pa.list_(pa.field("element", number, nullable=False), width) if width else number


@lru_cache(maxsize=1024)
def _field(name: str, arrow_type: Any, description: str) -> Any:
    return pa.field(name, arrow_type, nullable=False, metadata={"description": description})


@dataclass(frozen=True, slots=True)
class Cells:
    """The cells of a column, side by side."""

    numbers: NDArray[Any]
    texts: tuple[str, ...]
    lengths: tuple[int, ...]
    """Of each cell of a LIST column."""


def _hidden_column(name: str, column: str, *, content: bool = True) -> Column[Any]:
    """The column of a hidden parameter, whose package need not be installed."""
    parameter = hidden_parameter(name)
    told = parameter.in_full if parameter is not None else "of a package that was not installed"
    return Column(column, "<f8", 0, f"hidden: {told}", lambda row: row.rollout.dynamics[name], content=content)


@lru_cache(maxsize=1024)
def added_column(name: str, *, content: bool) -> Column[Any]:
    """The column of a parameter that not every store has: content of rollouts.parquet, a copy in the other table."""
    return _hidden_column(name, HIDDEN_PREFIX + name, content=content)


def hidden_names(added: Sequence[str]) -> dict[str, str]:
    """The columns of hidden parameters by the parameters' names: those that every store has, then some others."""
    return {name: name for name in ALWAYS_DRAWN} | {name: HIDDEN_PREFIX + name for name in added}


def rollout_columns(added: Sequence[str]) -> tuple["Column[RolloutRow]", ...]:
    """The columns of rollouts.parquet in a store with some hidden parameters that not every store has."""
    return (*ROLLOUT_COLUMNS, *(added_column(name, content=True) for name in added))


def interaction_columns(added: Sequence[str]) -> tuple["Column[InteractionRow]", ...]:
    """The same of interactions.parquet."""
    return (*INTERACTION_COLUMNS, *(added_column(name, content=False) for name in added))


def added_in(columns: Sequence[str]) -> tuple[str, ...]:
    """The hidden parameters that not every store has, by the names of a table's columns."""
    names = (column.removeprefix(HIDDEN_PREFIX) for column in columns if column.startswith(HIDDEN_PREFIX))
    return tuple(sorted(name for name in names if re.fullmatch(NAME, name)))


def _rollout_columns() -> tuple[Column[RolloutRow], ...]:
    r = operator.attrgetter("rollout")
    return (
        Column("plan_key", "", 0, "plan", lambda x: r(x).plan_key),
        Column("rollout", "<i8", 0, "number within the plan", lambda x: r(x).index),
        Column("object_id", "", 0, "object", lambda x: r(x).object.id),
        Column("object_category", "", 0, "its category", lambda x: r(x).object.category),
        Column("object_hash", "", 0, "SHA-256 of what was read of its files", lambda x: r(x).object.content_hash),
        *(_hidden_column(name, name) for name in ALWAYS_DRAWN),
        Column(
            "direction",
            "",
            0,
            "hidden: ways that joints move from the rollout's start; clockwise: to greater positions",
            lambda x: r(x).dynamics.direction,
            allowed=Direction,
        ),
        Column("azimuth_deg", "<f8", 0, "of the camera, from +x about z", lambda x: r(x).azimuth_deg),
        Column("elevation_deg", "<f8", 0, "of the camera, above the floor", lambda x: r(x).elevation_deg),
        Column("seed", "<u8", 0, "the plan's seed", lambda x: r(x).seed),
        Column("fidelity", "", 0, "name of the preset", lambda x: r(x).fidelity),
        Column(
            "status",
            "",
            0,
            "ok, nothing-to-act-on, never-at-rest or quarantined",
            lambda x: r(x).status,
            allowed=RolloutStatus,
        ),
        Column("observations", "<i8", 0, "how many", lambda x: len(r(x).observations)),
        Column("interactions", "<i8", 0, "how many", lambda x: len(r(x).interactions)),
        Column("first_observation", "<i8", 0, "index in the shard", lambda x: x.first_observation, content=False),
        Column(
            "arm_base",
            "<f8",
            LIST,
            "x, y, z, yaw of the arm's base, world; empty: the hand flies",
            lambda x: r(x).arm_base,
            content=False,
            default=(),
        ),
    )


def _action_columns() -> tuple[Column[InteractionRow], ...]:
    i, a = operator.attrgetter("interaction"), operator.attrgetter("interaction.action")
    return (
        Column("step", "<i4", 0, "number within the rollout", lambda x: i(x).step),
        Column("rollout_observation", "<i4", 0, "index within the rollout", lambda x: i(x).observation),
        Column(
            "observation",
            "<i4",
            0,
            "index in the shard",
            lambda x: x.first_observation + i(x).observation,
            content=False,
        ),
        Column("point_index", "<i4", 0, "of p in the cloud", lambda x: a(x).point_index),
        Column("point", "<f8", 3, "p, world", lambda x: a(x).point),
        Column("rotation", "<f8", 9, "R, world, row by row", lambda x: a(x).rotation.ravel()),
        Column("point_camera", "<f8", 3, "p, camera", lambda x: x.in_camera(a(x).point, place=True), content=False),
        Column(
            "rotation_camera",
            "<f8",
            9,
            "R, camera, row by row",
            lambda x: x.in_camera(a(x).rotation, place=False).ravel(),
            content=False,
        ),
        Column("normal", "<f8", 3, "surface normal at p, world", lambda x: i(x).normal),
    )


def _choice_columns() -> tuple[Column[InteractionRow], ...]:
    i = operator.attrgetter("interaction")
    return (
        Column("primitive", "", 0, "gripper primitive", lambda x: i(x).primitive),
        Column("order", "", 0, "restart or continue", lambda x: i(x).order, allowed=Order),
        Column("role", "", 0, "what the row is for", lambda x: i(x).role, allowed=Role),
        Column("proposer", "", 0, "who chose the action", lambda x: i(x).proposer),
        Column("policy_version", "<i4", 0, "policy it used; 0: none", lambda x: i(x).policy_version),
        Column("method", "", 0, "evaluation: whose try", lambda x: i(x).method),
        Column("budget", "<i4", 0, "evaluation: tries before; -1: none", lambda x: i(x).budget),
        Column("target_part", "<i4", 0, "1-based movable part under p", lambda x: i(x).target_part),
        Column("target_link", "", 0, "its link", lambda x: i(x).target_link),
        Column("target_joint", "", 0, "its joint", lambda x: i(x).target_joint),
        Column(
            "joint_names",
            "",
            0,
            "all joints, a JSON list",
            lambda x: json.dumps(list(i(x).joint_names)),
            longest=MAX_JOINT_NAMES,
        ),
        Column("joint_positions", "<f8", LIST, "of all joints at the start, rad or m", lambda x: i(x).joint_positions),
        Column(
            "joint_limits", "<f8", LIST, "lower, upper of each joint, as simulated", lambda x: i(x).joint_limits.ravel()
        ),
        Column("joint_twist", "<f8", 6, "hidden: (w, v) of the target joint, world", lambda x: i(x).joint_twist),
        Column("hand_start", "<f8", 7, "hand frame at the start, world, xyz wxyz", lambda x: i(x).hand_start),
    )


def _outcome_columns() -> tuple[Column[InteractionRow], ...]:
    i, o = operator.attrgetter("interaction"), operator.attrgetter("interaction.outcome")
    return (
        Column("outcome", "", 0, "how the trial ended", lambda x: o(x).kind, allowed=OutcomeKind),
        Column("motion", "<f8", 0, "m, rad or m; 0 unless the outcome is ok", lambda x: o(x).motion),
        Column("success", "|b1", 0, "r", lambda x: o(x).success),
        Column(
            "start_joint_position",
            "<f8",
            0,
            "of the target, rad or m",
            lambda x: o(x).start_joint_position,
            finite=False,
        ),
        Column(
            "end_joint_position",
            "<f8",
            0,
            "likewise, when the trial ended",
            lambda x: o(x).end_joint_position,
            finite=False,
        ),
        Column("displacement", "<f8", 3, "of the touched point, world", lambda x: o(x).displacement, finite=False),
        Column(
            "grasp_opening",
            "<f8",
            0,
            "both fingers together once closed, m",
            lambda x: o(x).grasp_opening,
            finite=False,
        ),
        Column("steps", "<i8", 0, "physics steps", lambda x: o(x).steps),
        Column("seconds", "<f8", 0, "wall time", lambda x: i(x).seconds, content=False),
    )


def _of_rollout(column: Column[Any]) -> Column[Any]:
    """The same column in interactions.parquet, for rows that are read alone; a copy, so not content."""
    return replace(column, value=lambda x: column.value(RolloutRow(x.rollout, x.first_observation)), content=False)


def fingerprint(*tables: Sequence[Column[Any]]) -> str:
    """A short text that changes with any column of some tables: what a store's software knows of its rows."""
    known = [[(c.name, c.dtype, c.width, c.content) for c in columns] for columns in tables]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()[:16]


ROLLOUT_COLUMNS = _rollout_columns()
_NOT_COPIED = ("status", "observations", "interactions", "first_observation", "arm_base")
COPIED_COLUMNS = tuple(column.name for column in ROLLOUT_COLUMNS if column.name not in _NOT_COPIED)
"""Columns of interactions.parquet that repeat the row's rollout."""
INTERACTION_COLUMNS = (
    *(_of_rollout(column) for column in ROLLOUT_COLUMNS if column.name in COPIED_COLUMNS),
    *_action_columns(),
    *_choice_columns(),
    *_outcome_columns(),
)
