"""Which columns and rows of a store's table somebody wants, and the clouds that these rows were decided on.

Columns and conditions are held to what the table has before anything is read; each shard is read once for its clouds.
"""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shared.config import CameraConfig
from shared.errors import StoreError, UsageError
from shared.hidden import hidden_parameter
from shared.store.codecs.columns import added_in
from shared.store.codecs.observations import ARRAYS, ObservationArrays, fields_of, kinds
from shared.store.codecs.tables import Columns, schema_of
from shared.types import Observation

if TYPE_CHECKING:
    from shared.store.store import Store

Condition = tuple[str, str, Any]
"""Column, operator and value, such as ("outcome", "=", "ok") or ("object_id", "in", ["101", "102"])."""
OPERATORS = ("=", "==", "!=", "<", ">", "<=", ">=", "in", "not in")


@dataclass(frozen=True, slots=True)
class Selection:
    """Columns and rows of one of the two tables.

    Attributes:
        schema: of the columns that the result has.
        read: names of the columns that must be read: those, and those that conditions name.
        defaults: values of the hidden parameters that the store lacks, by column; the same in every row.
        condition: a pyarrow expression, which is true for the rows that are wanted; None: all rows.
    """

    schema: Any
    read: tuple[str, ...]
    defaults: dict[str, float]
    condition: Any

    @classmethod
    def of(cls, table: str, known: Columns, columns: Sequence[str] | None, where: Sequence[Condition]) -> "Selection":
        """Check what is wanted.

        Args:
            table: what messages call the table.
            known: its columns.
            columns: names of those that are wanted; None: all.
            where: conditions, all of which a row must meet.

        Raises:
            UsageError: there is no such column or operator, or a value cannot be compared with its column.
        """
        there = schema_of(known)
        names = list(dict.fromkeys(there.names if columns is None else columns))
        tested = list(dict.fromkeys(_tested(condition) for condition in where))
        wanted = dict.fromkeys([*names, *tested])
        defaults = {name: value for name in wanted if name not in there.names for value in _defaults(name)}
        for name in wanted:
            if name not in there.names and name not in defaults:
                close = difflib.get_close_matches(name, there.names, n=1)
                hint = f"did you mean '{close[0]}'?" if close else f"allowed: {', '.join(there.names)}"
                raise UsageError(f"no column '{name}' in the {table}; {hint}")
        fields = {name: pa.field(name, pa.float64()) if name in defaults else there.field(name) for name in wanted}
        read = tuple(name for name in wanted if name not in defaults)
        schema = pa.schema([fields[name] for name in names])
        try:
            found = cls(schema, read, defaults, pq.filters_to_expression(list(where)) if where else None)
            found.of_table(pa.schema([fields[name] for name in read]).empty_table())
        except (pa.ArrowException, TypeError) as error:
            line = " ".join(str(error).split())[:120]
            raise UsageError(f"where {list(where)}: cannot be compared ({line}); see the columns' types") from None
        return found

    def of_table(self, table: Any) -> Any:
        """The selection from the table of a shard, of which the columns `read` were read."""
        for name, value in self.defaults.items():
            table = table.append_column(name, pa.array(np.full(len(table), value)))
        if self.condition is not None:
            table = table.filter(self.condition)
        return table.select(self.schema.names)


def _tested(condition: Condition) -> str:
    """The column that a condition names."""
    if not isinstance(condition, tuple) or len(condition) != 3 or condition[1] not in OPERATORS:
        raise UsageError(
            f"where: {str(condition)[:80]} is no condition; give tuples of column, operator and value, such as "
            f"('outcome', '=', 'ok'); operators: {', '.join(OPERATORS)}"
        )
    return condition[0]


def _defaults(column: str) -> list[float]:
    """What the hidden parameter of a column was where a store lacks it; empty where nothing says so."""
    found = [hidden_parameter(name) for name in added_in([column])]
    return [each.default for each in found if each is not None and each.default is not None]


def observations_of(store: "Store", rows: Any) -> Iterator[Observation]:
    """See `Store.observations`."""
    for name in ("shard", "observation"):
        if name not in rows.schema.names:
            raise UsageError(f"a table without the column '{name}' has no clouds; take it from `Store.interactions`")
    shards = (shard.as_py() for shard in rows.column("shard"))
    return observations_at(store, zip(shards, rows.column("observation").to_pylist(), strict=True))


def observations_at(store: "Store", places: Iterable[tuple[str, int]]) -> Iterator[Observation]:
    """The clouds at some places, each a shard and the cloud's number in it.

    Raises:
        StoreError: a shard is missing, damaged or foreign, or has no such cloud.
    """
    points = store.setting.collection.camera.points
    shard, arrays = "", None
    for name, index in places:
        if arrays is None or name != shard:
            shard, arrays = name, store.read_observations(name)
        if not 0 <= index < len(arrays) or arrays.points.shape[1] != points:
            raise StoreError(f"{store.where}: shard {name} has no observation {index}; it is damaged")
        yield arrays.observation(index)


def check_fields(names: Iterable[str]) -> None:
    """See that clouds have some fields.

    Raises:
        UsageError: one they have not.
    """
    fields = [kind.name for kind in ARRAYS]
    for name in names:
        if name not in fields:
            raise UsageError(f"clouds have no field '{name}'; allowed: {', '.join(fields)}")


def stacked(found: Iterable[Observation], count: int, camera: CameraConfig) -> ObservationArrays:
    """`count` observations of a camera as arrays, with their depth images where it keeps them."""
    # Filled one by one, since a list of so many arrays would be in memory beside what they are stacked into.
    pixels = camera.depth_size
    arrays = {kind.name: np.empty((count, *kind.shape(camera.points, pixels)), kind.seen) for kind in kinds(pixels)}
    for number, observation in enumerate(found):
        for name, field in fields_of(observation).items():
            arrays[name][number] = field
    return ObservationArrays(**arrays)
