"""A store's interactions as samples for PyTorch, shard by shard, so that memory does not grow with the store.

dataset = InteractionDataset(store, columns=["point_index", "success"], clouds=["points"], seed=1)
for epoch in range(dataset.epoch, epochs):
    dataset.set_epoch(epoch)
    for batch in DataLoader(dataset, batch_size=64, num_workers=2):
        ...
        dataset.consumed(batch["position"])        # Now `dataset.state_dict()` says what is left.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, distributed
from torch.utils.data import IterableDataset, get_worker_info

from shared.errors import UsageError
from shared.seeds import generator
from shared.store import reader
from shared.store.codecs.columns import LIST, interaction_columns
from shared.store.codecs.observations import ObservationArrays
from shared.store.codecs.tables import column_values
from shared.store.coverage import Part, Snapshot
from shared.store.layout import INTERACTIONS_FILE
from shared.store.selection import Condition, check_fields
from shared.store.store import Store

COLUMNS = ("object_id", "point_index", "point", "rotation", "motion", "success")
CLOUDS = ("points", "movable", "world_from_camera")
_STATE = ("shards", "snapshot", "epoch", "rank", "world", "workers", "next", "done")


class InteractionDataset(IterableDataset[dict[str, Any]]):
    """The interactions of a store, each with its cloud, in an order that depends on the seed and the epoch alone.

    A sample is a dict: a cell for each column (a number, a text, or an array), an array for each field of the cloud
    ([N, 3], see `shared.types.Observation`), and `position`, which `consumed` takes. Shards come in random order, and
    the rows of `together` consecutive shards are mixed, and these shards are in memory at once. Each process of
    `torch.distributed` and each worker of a `DataLoader` reads every n-th of these groups, so that together they read
    every row once an epoch; their numbers of rows may differ. What comes to the store later is not read.

    Args:
        store: a store, or its folder or s3:// URL.
        columns: of the interactions; those with lists of any length are not possible.
        where: rows that meet all of these conditions only, as for `Store.interactions`.
        clouds: fields of `shared.types.Observation`; none: no cloud is read.
        seed: of the order; None: the order of the store.
        together: shards whose rows are mixed.

    Raises:
        UsageError: there is no such column or field, or a condition is not valid.
        StoreError: a file is damaged or foreign; reading raises it, too.
    """

    def __init__(
        self,
        store: Store | str,
        columns: Sequence[str] = COLUMNS,
        where: Sequence[Condition] = (),
        clouds: Sequence[str] = CLOUDS,
        *,
        seed: int | None = 0,
        together: int = 1,
    ) -> None:
        super().__init__()
        if together < 1:
            raise UsageError(f"together={together}: give 1 shard or more")
        if seed is not None and seed < 0:
            raise UsageError(f"seed={seed}: give a number of 0 or more, or None for the order of the store")
        check_fields(clouds)
        opened = store if isinstance(store, Store) else Store.open(store)
        self.columns, self.clouds, self.seed, self.together = tuple(columns), tuple(clouds), seed, together
        self.epoch = 0
        self._where = tuple(where)
        self._open(opened, Snapshot.of(opened.parts()))
        for name in columns:
            if name in self._known and self._known[name].width == LIST:
                raise UsageError(f"column '{name}' has cells of different lengths; read it by `Store.interactions`")
        self._ranks = 0, 1
        self._next = 0
        self._done: dict[int, tuple[int, int]] = {}
        """By worker: the group that it was reading, and how many rows of it are consumed."""
        self._state_of: tuple[int, int, int] | None = None
        """Rank, processes and workers that `_done` is of."""
        self._to_continue = False

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch, or go on with it where a state that was loaded is of it.

        Raises:
            UsageError: the number is negative.
        """
        if epoch < 0:
            raise UsageError(f"epoch {epoch}: give a number of 0 or more")
        if epoch != self.epoch or not self._to_continue:
            self._done, self._next, self._state_of = {}, 0, None
        self.epoch = epoch

    def consumed(self, positions: Tensor | NDArray[np.int64]) -> None:
        """Note that samples were used, in this order.

        Only who uses a `DataLoader` with workers must say so: these read ahead, in processes of their own.

        Args:
            positions: the samples' `position`, [5] or [B, 5].
        """
        for epoch, workers, worker, group, row in np.asarray(positions).reshape(-1, 5).tolist():
            if epoch == self.epoch:
                self._done[worker] = group, row + 1
                self._state_of = *self._rank_and_world(), workers
                self._next = (worker + 1) % workers
                self._to_continue = False

    def state_dict(self) -> dict[str, Any]:
        """What of the epoch is consumed, as JSON can hold it; in several processes each has a state of its own."""
        rank, world, workers = self._state_of or (*self._rank_and_world(), 1)
        return {
            "shards": self._fingerprint,
            "snapshot": self._snapshot.model_dump(mode="json"),
            "epoch": self.epoch,
            "rank": rank,
            "world": world,
            "workers": workers,
            "next": self._next,
            "done": {str(worker): list(done) for worker, done in self._done.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where a data set with the same arguments was: the remaining samples of its epoch, in the same order.

        Raises:
            UsageError: it is no such state, or the store's shards were written anew since.
        """
        try:
            snapshot = Snapshot.model_validate(state["snapshot"])
            state_of = int(state["rank"]), int(state["world"]), int(state["workers"])
            done = {int(worker): (int(group), int(row)) for worker, (group, row) in state["done"].items()}
            fingerprint, epoch, following = state["shards"], int(state["epoch"]), int(state["next"])
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UsageError(f"no state of a data set; it has {', '.join(_STATE)}") from None
        self._open(self._store, snapshot)
        if self._fingerprint != fingerprint:
            raise UsageError(
                f"{self._store.where}: the state is of other shards or arguments; give the same arguments, or, where "
                "the store was compacted since, begin a new epoch"
            )
        self.epoch, self._next, self._done, self._state_of = epoch, following, done, state_of if done else None
        self._to_continue = True

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The samples of this worker of this process that are left in the epoch.

        Raises:
            UsageError: the state that was loaded is of another number of processes or workers; or some of the epoch
                was read already.
            StoreError: a file is damaged or foreign.
        """
        info = get_worker_info()
        rank, world = self._rank_and_world()
        workers = 1 if info is None else info.num_workers
        if self._done and not self._to_continue:
            raise UsageError(f"epoch {self.epoch} was begun already; call `set_epoch` before each epoch")
        if self._state_of not in (None, (rank, world, workers)):
            names = ("rank", "processes", "workers")
            given, now = (
                ", ".join(f"{name} {number}" for name, number in zip(names, numbers, strict=True))
                for numbers in (self._state_of or (), (rank, world, workers))
            )
            raise UsageError(f"the state is of {given}; here: {now}; use the same, or begin a new epoch")
        self._to_continue, self._state_of = False, (rank, world, workers)
        # The worker that comes first reads what comes next, so that batches come in the order in which they would have.
        worker = (self._next + (0 if info is None else info.id)) % workers
        # In its own process, a worker opens the store anew: clients of buckets do not survive a fork.
        store = self._store if info is None else Store.open(self._store.where)
        groups, first = self._groups(), self._done.get(worker, (0, 0))
        for number in range(rank * workers + worker, len(groups), world * workers):
            if number < first[0]:
                continue
            begin = first[1] if number == first[0] else 0
            for row, sample in enumerate(self._read(store, groups[number], number, begin), begin):
                self._done[worker] = number, row + 1
                yield sample | {"position": np.array([self.epoch, workers, worker, number, row])}

    def __getstate__(self) -> dict[str, Any]:
        """For a worker that is not forked: it opens the store itself, and knows no `torch.distributed`."""
        opened = ("_store", "_parts", "_known", "_selection")
        kept = {name: value for name, value in self.__dict__.items() if name not in opened}
        return kept | {"_ranks": self._rank_and_world(), "where": self._store.where}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See `__getstate__`."""
        self.__dict__.update(state)
        self._open(Store.open(self.__dict__.pop("where")), self._snapshot)

    def _open(self, store: Store, snapshot: Snapshot) -> None:
        """Read these rollouts of a store, whatever comes to it later."""
        self._store, self._snapshot = store, snapshot
        self._selection = store.select(self.columns, self._where)
        self._known = {column.name: column for column in interaction_columns(store.setting.dynamics.added)}
        self._parts = store.as_of(snapshot).parts()
        shards = [(part.shard.shard_id, part.start, part.stop) for part in self._parts]
        what = json.dumps([shards, self.seed, self.together, repr(self._where)])
        self._fingerprint = hashlib.sha256(what.encode()).hexdigest()

    def _rank_and_world(self) -> tuple[int, int]:
        if distributed.is_available() and distributed.is_initialized():
            return distributed.get_rank(), distributed.get_world_size()
        return self._ranks

    def _groups(self) -> list[list[Part]]:
        """The shards of the epoch in their order; the rows of those in one list are mixed."""
        count = len(self._parts)
        order = np.arange(count)
        if self.seed is not None:
            order = generator(self.seed, "reading/shards", self.epoch).permutation(count)
        starts = range(0, count, self.together)
        return [[self._parts[place] for place in order[start : start + self.together]] for start in starts]

    def _read(self, store: Store, parts: Sequence[Part], number: int, begin: int) -> Iterator[dict[str, Any]]:
        """The samples of a group from row `begin` on."""
        tables: list[Any] = []
        clouds: list[ObservationArrays] = []
        places: list[tuple[int, NDArray[np.int64]]] = []
        for part, manifest, table in reader.read_tables(store.backend, parts, INTERACTIONS_FILE, self._selection.read):
            chosen = self._selection.of_table(table)
            if self.clouds and len(chosen):
                shard = reader.shard_folder(store.backend, part.shard.shard_id)
                places.append((len(clouds), chosen.column("observation").to_numpy()))
                clouds.append(reader.read_observations(shard, manifest))
            tables.append(chosen)
        owner = np.repeat([owner for owner, _ in places], [len(found) for _, found in places])
        cloud = np.concatenate([found for _, found in places]) if places else np.empty(0, np.int64)
        count = sum(map(len, tables))
        order = np.arange(count)
        if self.seed is not None:
            order = generator(self.seed, "reading/rows", self.epoch, number).permutation(count)
        order = order[begin:]
        # Taken by index, which copies: Arrow's memory cannot be written to, of which PyTorch warns.
        cells = {name: np.concatenate([self._cells(table, name) for table in tables])[order] for name in self.columns}
        for place, row in enumerate(order):
            sample: dict[str, Any] = {name: values[place] for name, values in cells.items()}
            for name in self.clouds:
                sample[name] = getattr(clouds[owner[row]], name)[cloud[row]]
            yield sample

    def _cells(self, table: Any, name: str) -> NDArray[Any]:
        if name not in self._known:  # A hidden parameter that the store lacks.
            values: NDArray[Any] = table.column(name).to_numpy()
            return values
        values = column_values(table, self._known[name])
        return values if self._known[name].dtype else np.array(values, dtype=object)
