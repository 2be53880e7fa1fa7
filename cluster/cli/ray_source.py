"""A store as a source of Ray Data: one read task for a group of shards, so that no process reads all of it."""

from collections.abc import Iterator, Sequence
from typing import Any

from ray.data.block import BlockMetadata
from ray.data.datasource import Datasource, ReadTask
from ray.data.extensions import ArrowTensorArray

from shared.store import Store
from shared.store.coverage import Part
from shared.store.selection import Condition


class RaySource(Datasource):
    """See `cluster.cli.library.ray_source`."""

    def __init__(
        self, store: Store, columns: Sequence[str] | None, where: Sequence[Condition], clouds: Sequence[str]
    ) -> None:
        self._where, self._columns, self._conditions, self._clouds = store.where, columns, tuple(where), tuple(clouds)
        self._parts = store.parts()

    def get_name(self) -> str:
        """What Ray calls the source."""
        return "AdaAfford"

    def estimate_inmemory_data_size(self) -> int | None:
        """Not known before the tables are read."""
        return None

    def get_read_tasks(
        self, parallelism: int, per_task_row_limit: int | None = None, data_context: Any = None
    ) -> list[Any]:
        """A task for each group of shards that follow each other, as many as Ray asks for where there are enough."""
        count = max(1, min(parallelism, len(self._parts)))
        tasks = []
        for number in range(count):
            some = self._parts[len(self._parts) * number // count : len(self._parts) * (number + 1) // count]

            def read(some: Sequence[Part] = some) -> Iterator[Any]:
                return self._blocks(some)

            metadata = BlockMetadata(num_rows=None, size_bytes=None, input_files=None, exec_stats=None)
            tasks.append(ReadTask(read, metadata, per_task_row_limit=per_task_row_limit))
        return tasks

    def _blocks(self, parts: Sequence[Part]) -> Iterator[Any]:
        """A table for each shard."""
        store = Store.open(self._where)
        selection = store.select(self._columns, self._conditions)
        for rows in store.selected(selection, parts):
            if self._clouds:
                clouds = store.clouds(rows)
                for name in self._clouds:
                    rows = rows.append_column(name, ArrowTensorArray.from_numpy(getattr(clouds, name)))
            yield rows
