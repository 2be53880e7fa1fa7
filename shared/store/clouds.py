"""The clouds that rows of a table of interactions were decided on; each shard is read once for the rows that follow."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from shared.config import CameraConfig
from shared.errors import StoreError, UsageError
from shared.store.codecs.observations import ARRAYS, ObservationArrays, fields_of, kinds
from shared.types import Observation

if TYPE_CHECKING:
    from shared.store.store import Store


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
