"""The interface of a store for its users.

store = Store.create(path, setting)                       # or opens a store with the same setting
store.commit(plan, job, rollouts, {"physics_s": "6.1"})   # a worker, or many at once
table = store.interactions(["point", "success"])          # a learner
clouds = store.clouds(table)
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa

from shared.errors import StoreError, UnreadableError, UsageError
from shared.io.documents import difference_of, with_checksum
from shared.io.files import TEMPORARY_PREFIX
from shared.plan import Job, Plan, RolloutRecord, Setting
from shared.store import policies, reader
from shared.store.backends.base import Folder, StorageBackend, backend_of, is_url
from shared.store.backends.conformance import check_place
from shared.store.codecs.columns import interaction_columns, rollout_columns
from shared.store.codecs.observations import ObservationArrays
from shared.store.coverage import Part, Snapshot, parts_of
from shared.store.crash_log import CRASH_LOG_FOLDER, CrashLog
from shared.store.layout import (
    INTERACTIONS_FILE,
    LOCK_PREFIX,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    ROLLOUTS_FILE,
    SHARDS_FOLDER,
    STORE_FILE,
    Quarantined,
    ShardManifest,
    StoreDocument,
    parse_sealed,
    parse_shard_id,
    parse_store_document,
)
from shared.store.presence import DRIVER
from shared.store.provenance import store_software
from shared.store.selection import Condition, Selection, observations_of, stacked
from shared.store.writer import combined_digest, commit_shard
from shared.types import Observation

MAX_SEED = 2**64 - 1
_TABLES_AT_ONCE = 256


class Store:
    """Immutable shards, all with one setting; any number of processes may use a store at the same time."""

    def __init__(self, backend: StorageBackend, document: StoreDocument) -> None:
        """Use `Store.create` or `Store.open`."""
        self.backend = backend
        self.document = document
        self._recorded: dict[str, Plan] = {}
        self._snapshot: Snapshot | None = None

    @property
    def where(self) -> str:
        """The path or URL of the store, for messages and for `Store.open`."""
        return self.backend.where

    @property
    def setting(self) -> Setting:
        """What all rows have in common."""
        return self.document.setting

    @classmethod
    def create(cls, where: str | Path, setting: Setting, more: Mapping[str, Any] | None = None) -> "Store":
        """Create a store, or open an existing one with the same setting.

        Args:
            where: a folder, or s3://BUCKET/PREFIX.
            setting: of all its rows.
            more: fields that newer software wrote into the description of the store that this one is a copy of.

        Raises:
            StoreError: a store of another setting is there, or files that are no store, or it cannot be made, or the
                bucket's server lets several writers of one key win.
            UsageError: the setting's seed is too large to be stored, or the URL is not allowed.
        """
        if setting.seed > MAX_SEED:
            raise UsageError(f"seed {setting.seed} is too large; allowed: 0 to {MAX_SEED}")
        backend = backend_of(where)
        try:
            if not backend.exists(STORE_FILE):
                _refuse_foreign(backend)
                if backend.writes_in_place:
                    # Only what a server promises keeps two writers of a shard apart there; some break it.
                    check_place(backend)
                created = datetime.now(UTC).isoformat(timespec="seconds")
                known = {"setting": setting, "software": store_software(), "created": created}
                document = StoreDocument.model_validate(dict(more or {}) | known, extra="allow")
                backend.create(STORE_FILE, with_checksum(document.as_document()))
        except OSError as error:
            raise StoreError(f"{where}: no store can be made here ({error.strerror}); name another folder") from None
        store = cls.open(where)
        store._check_setting(where, setting)
        return store

    @classmethod
    def check_free(cls, where: str | Path, setting: Setting | None) -> None:
        """Refuse a place where `create` would refuse this setting; nothing is written.

        Args:
            where: as for `create`.
            setting: of the store that is wanted; None: any.

        Raises:
            StoreError: a store of another setting is there, or files that are no store.
            UsageError: the URL is not allowed.
        """
        backend = backend_of(where)
        if backend.exists(STORE_FILE):
            store = cls.open(where)
            if setting is not None:
                store._check_setting(where, setting)
        else:
            _refuse_foreign(backend)

    def _check_setting(self, where: str | Path, setting: Setting) -> None:
        if self.setting != setting:
            difference = difference_of(self.setting.as_document(), setting.as_document())
            raise StoreError(f"{where} holds another setting: {difference}; give the same, or another folder")

    @classmethod
    def open(cls, where: str | Path) -> "Store":
        """Open an existing store.

        Args:
            where: a folder, or s3://BUCKET/PREFIX.

        Raises:
            StoreError: it is missing, no store, damaged, or of another schema version.
            UsageError: the URL is not allowed.
        """
        backend = backend_of(where)
        if not backend.is_there():
            raise StoreError(f"{where}: there is no such folder; name an existing store")
        if not backend.exists(STORE_FILE):
            raise StoreError(f"{where}: is no store (it has no {STORE_FILE}); name an existing store")
        return cls(backend, parse_store_document(backend.read(STORE_FILE, MAX_DOCUMENT_BYTES), f"{where}/{STORE_FILE}"))

    @classmethod
    def begun_with(cls, where: str | Path) -> Setting | None:
        """The setting of the store that is there; None: there is none, or none that opens, as `open` then says."""
        try:
            return cls.open(where).setting
        except StoreError:
            return None

    def as_of(self, snapshot: Snapshot) -> "Store":
        """The store restricted to these rollouts, for readers while others collect into it."""
        store = Store(self.backend, self.document)
        store._snapshot = snapshot
        return store

    def add_plan(self, plan: Plan) -> None:
        """Record a plan; recording it again changes nothing.

        Raises:
            StoreError: the plan is of another setting, or another plan has its name.
        """
        if self._recorded.get(plan.key) == plan:
            return
        if plan.setting != self.setting:
            difference = difference_of(self.setting.as_document(), plan.setting.as_document())
            raise StoreError(f"{self.where}: plan {plan.key} is of another setting: {difference}")
        key = f"{PLANS_FOLDER}/{plan.key}.json"
        made = self.backend.create(key, with_checksum(plan.as_document()))
        # Compared as plans: a setting that came with later software has its default in a file that lacks it.
        if not made and self.read_plan(f"{plan.key}.json") != plan:
            raise StoreError(f"{self.where}/{key}: holds another plan of this name; give this one another store")
        self._recorded[plan.key] = plan

    def plans(self) -> tuple[Plan, ...]:
        """The plans, in order of name.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        names = [name for name in self.backend.names(PLANS_FOLDER) if not name.startswith(".")]
        return tuple(self.read_plan(name) for name in names if name.endswith(".json"))

    def read_plan(self, name: str) -> Plan:
        """A plan from the file of this name.

        Raises:
            StoreError: the file is damaged or foreign.
        """
        key = f"{PLANS_FOLDER}/{name}"
        file = f"{self.where}/{key}"
        plan = parse_sealed(Plan, self.backend.read(key, MAX_DOCUMENT_BYTES), file, "a plan")
        if f"{plan.key}.json" != name or plan.setting != self.setting:
            raise StoreError(f"{file}: is no plan of this store; the file is damaged or foreign")
        return plan

    def committed(self, plan_key: str | None = None) -> list[ShardManifest]:
        """Manifests of the committed shards, all at once: some 20 KB each; otherwise as `manifests`."""
        return list(self.manifests(plan_key))

    def manifests(self, plan_key: str | None = None) -> Iterator[ShardManifest]:
        """Manifests of the committed shards (of one plan), in order of plan and rollout; no data are read.

        Shards whose rollouts are also in a larger shard, as during a compaction, are left out.

        Raises:
            StoreError: a manifest is damaged or foreign.
        """
        return reader.read_manifests(self.backend, (part.shard for part in self.parts(plan_key)))

    def jobs(self, plan_key: str | None = None) -> list[Job]:
        """The jobs (of one plan) of all committed shards, sorted by name; their ranges may overlap.

        No manifest is read, because a million manifests take a quarter of an hour, and a million names take seconds.
        """
        jobs = reader.committed_jobs(self.backend, plan_key)
        if not self.backend.exists(STORE_FILE):
            raise UnreadableError(f"{self.where}: vanished while it was read; is its disk still there?")
        return jobs

    def manifest(self, job: Job) -> ShardManifest:
        """The manifest of a job's committed shard; raises as `committed` does."""
        return reader.read_manifest(reader.shard_folder(self.backend, job.shard_id))

    def parts(self, plan_key: str | None = None) -> list[Part]:
        """What counts of which shard, in order of plan and rollout; by the shards' names alone."""
        parts = parts_of(self.jobs(plan_key))
        return parts if self._snapshot is None else self._snapshot.limit(parts)

    def rollouts_of(self, part: Part) -> list[RolloutRecord]:
        """The rollouts of a shard that count, in order; raises as `read_rollouts` does."""
        rollouts = self.read_rollouts(part.shard.shard_id)
        return [rollout for rollout in rollouts if part.start <= rollout.index < part.stop]

    def tables_of(self, part: Part) -> tuple[Any, Any]:
        """The rollouts and the interactions of a shard that count, as tables.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        shard = reader.shard_folder(self.backend, part.shard.shard_id)
        manifest = reader.read_manifest(shard)
        rollouts = reader.read_rollout_table(shard, manifest)
        return part.of(rollouts), part.of(reader.read_interactions(shard, manifest))

    def holds(self, job: Job) -> bool:
        """Whether the shard of a job is committed."""
        return reader.is_committed(reader.shard_folder(self.backend, job.shard_id))

    def commit(
        self,
        plan: Plan,
        job: Job,
        rollouts: Sequence[RolloutRecord],
        provenance: Mapping[str, str],
        quarantined: Sequence[Quarantined] = (),
        *,
        vetted: bool = False,
    ) -> ShardManifest:
        """Store the rollouts of a job as one shard: atomically, and only once if several workers do it.

        Args:
            plan: the plan of the job.
            job: the range of rollouts.
            rollouts: all of them, in order.
            provenance: facts about their origin, such as seconds by stage; not part of the digest.
            quarantined: the reasons of quarantined rollouts; not part of the digest.
            vetted: whether the caller has checked that no shard has these rollouts. Otherwise the names of all shards
                are listed, which takes longer for larger stores. Readers count each rollout once in any case.

        Returns:
            The manifest; if another worker was faster, that of its shard.

        Raises:
            StoreError: the rollouts are not the job's, break the rules of a record, or overlap another shard.
        """
        if job.plan_key != plan.key:
            raise StoreError(f"job {job.shard_id} is not of plan {plan.key}; give the plan that made it")
        self.add_plan(plan)
        known = self.setting.identities
        for rollout in rollouts:
            if rollout.object.identity not in known or rollout.seed != self.setting.seed:
                raise StoreError(
                    f"{job.shard_id}: rollout {rollout.index} (object {rollout.object.id}, seed {rollout.seed}) "
                    "is of another object or seed than the store's"
                )
            if rollout.dynamics.added != self.setting.dynamics.added:
                raise StoreError(
                    f"{job.shard_id}: rollout {rollout.index} has other hidden parameters than the store's"
                )
        camera = self.setting.collection.camera
        kept = camera.keep_depth
        if any((seen.dense is not None) != kept for rollout in rollouts for seen in rollout.observations):
            raise StoreError(
                f"{job.shard_id}: a simulator must keep the depth image of each observation if, and only if, "
                f"collection.camera.keep_depth is set; here it is {str(kept).lower()}"
            )
        return commit_shard(self.backend, job, rollouts, camera.points, provenance, quarantined, vetted=vetted)

    def only_driver(self, *, alone: bool = False) -> AbstractContextManager[Any]:
        """Lock the store against other drivers, which would repeat the same work.

        Args:
            alone: also in a bucket, where several drivers of one plan do no harm. Drivers that follow a learner could
                hand out one number with two policies.

        Raises:
            UsageError: another driver, or a repair, holds it; the message names the process.
        """
        return self.backend.only_one(DRIVER, alone=alone)

    def sweep(self) -> int:
        """Remove unfinished files of dead writers; returns how many files and folders that was."""
        folders = ["", PLANS_FOLDER, SHARDS_FOLDER, POLICIES_FOLDER]
        return self.backend.sweep(folders) + self.crash_log.sweep()

    def digest(self) -> str:
        """Content digest of the store: independent of shards, workers, hosts and times."""
        parts = self.parts()
        manifests = reader.read_manifests(self.backend, (part.shard for part in parts))
        return combined_digest(
            (manifest.plan_key, index, manifest.digests[index - manifest.start])
            for part, manifest in zip(parts, manifests, strict=True)
            for index in range(part.start, part.stop)
        )

    def interactions(self, columns: Sequence[str] | None = None, where: Sequence[Condition] = ()) -> Any:
        """A pyarrow table, one row an interaction; "shard" and "observation" (index in it) find a row's cloud.

        Args:
            columns: names (see `shared.store.codecs.columns`); None: all. "shard" and "observation" always come. A
                hidden parameter that the store lacks has its default in every row, if its package is installed.
            where: rows that meet all of these conditions only, such as ("outcome", "=", "ok"). Rows of one shard at a
                time are in memory beside the result.

        Raises:
            UsageError: there is no such column, or a condition is none.
            StoreError: a file is damaged or foreign.
        """
        return self._table(INTERACTIONS_FILE, self.select(columns, where))

    def rollouts(self, columns: Sequence[str] | None = None, where: Sequence[Condition] = ()) -> Any:
        """A pyarrow table, one row a rollout, including those without interactions; "shard" is the name of its shard.

        Args:
            columns: names; None: all. "shard" always comes.
            where: as for `interactions`.

        Raises:
            UsageError: there is no such column, or a condition is none.
            StoreError: a file is damaged or foreign.
        """
        known = rollout_columns(self.setting.dynamics.added)
        return self._table(ROLLOUTS_FILE, Selection.of("rollouts", known, _stored(columns), where))

    def select(self, columns: Sequence[str] | None = None, where: Sequence[Condition] = ()) -> Selection:
        """Columns and rows of the interactions, checked; raises and takes arguments as `interactions`."""
        known = interaction_columns(self.setting.dynamics.added)
        names = _stored(columns)
        if names is not None:
            names.append("observation")
        return Selection.of("interactions", known, names, where)

    def _table(self, file: str, selection: Selection) -> Any:
        """What is selected from one of the two tables of all shards, and which shard each row is of."""
        tables = [_with_shard(selection.schema.empty_table(), "")]
        few: list[Any] = []
        for table in self._selected(file, selection, self.parts()):
            few.append(table)
            if len(few) == _TABLES_AT_ONCE:
                # Copied together: a column of one shard takes far more memory than its numbers.
                tables.append(pa.concat_tables(few).combine_chunks())
                few.clear()
        return pa.concat_tables([*tables, *few])

    def each(self, file: str, names: Sequence[str] | None = None) -> Iterator[tuple[Part, ShardManifest, Any]]:
        """What counts of each shard, its manifest, and one of its tables (see `reader.read_tables`), in order."""
        return reader.read_tables(self.backend, self.parts(), file, names)

    def selected(self, selection: Selection, parts: Iterable[Part]) -> Iterator[Any]:
        """What `select` chose of the interactions of some shards, a table each; raises as `interactions` does."""
        return self._selected(INTERACTIONS_FILE, selection, parts)

    def _selected(self, file: str, selection: Selection, parts: Iterable[Part]) -> Iterator[Any]:
        for part, _, table in reader.read_tables(self.backend, parts, file, selection.read):
            yield _with_shard(selection.of_table(table), part.shard.shard_id)

    def read_observations(self, shard_id: str) -> ObservationArrays:
        """All clouds of a shard.

        Raises:
            StoreError: there is no such shard, or it is damaged or foreign.
        """
        shard = self._committed_shard(shard_id)
        return reader.read_observations(shard, reader.read_manifest(shard))

    def observations(self, rows: Any) -> Iterator[Observation]:
        """The cloud of each row of a table of interactions, in order.

        A shard is read once for all rows of it that follow each other, as they do in `interactions()`.

        Args:
            rows: any table with the columns "shard" and "observation".

        Raises:
            UsageError: the table lacks these columns.
            StoreError: a shard is missing, damaged or foreign, or has no such observation.
        """
        return observations_of(self, rows)

    def clouds(self, rows: Any) -> ObservationArrays:
        """The clouds of all rows of a table of interactions as arrays, [rows, ...]; as `observations` otherwise."""
        return stacked(self.observations(rows), len(rows), self.setting.collection.camera)

    def cloud_batches(self, rows: Any, size: int) -> Iterator[tuple[Any, ObservationArrays]]:
        """At most `size` rows at a time and their clouds, in order; as `observations` otherwise.

        Raises:
            UsageError: the size is below 1.
        """
        if size < 1:
            raise UsageError(f"batches of {size} rows are not possible; give 1 or more")
        found = self.observations(rows)
        for start in range(0, len(rows), size):
            some = rows.slice(start, size)
            yield some, stacked(islice(found, len(some)), len(some), self.setting.collection.camera)

    def read_rollouts(self, shard_id: str) -> tuple[RolloutRecord, ...]:
        """The records of a shard, bit for bit as they were committed.

        Raises:
            StoreError: there is no such shard, or it is damaged or foreign.
        """
        shard = self._committed_shard(shard_id)
        return reader.read_rollouts(shard, reader.read_manifest(shard))

    def publish_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Publish a policy's files atomically; see `shared.store.policies`."""
        policies.publish_policy(self.backend, version, files)

    def read_policy(self, version: int) -> dict[str, bytes]:
        """A policy's files, checked; see `shared.store.policies`."""
        return policies.read_policy(self.backend, version)

    def policy_versions(self) -> tuple[int, ...]:
        """The published versions, ascending."""
        return policies.policy_versions(self.backend)

    @property
    def path(self) -> Path:
        """The folder of a store on a disk.

        Raises:
            UsageError: the store is in a bucket.
        """
        if is_url(self.where):
            raise UsageError(
                f"{self.where}: is not in a folder; copy it by `adaafford store merge {self.where} --out DIR`"
            )
        return Path(self.where)

    @property
    def crash_log(self) -> CrashLog:
        """The heartbeats and crash logs of workers."""
        return CrashLog(None, self.where) if is_url(self.where) else CrashLog(self.path / CRASH_LOG_FOLDER)

    def _committed_shard(self, shard_id: str) -> Folder:
        folder = reader.shard_folder(self.backend, shard_id)
        if parse_shard_id(shard_id) is None or not reader.is_committed(folder):
            raise StoreError(f"{self.where}: holds no committed shard {shard_id[:80]!r}; see `store info`")
        return folder


def _refuse_foreign(backend: StorageBackend) -> None:
    """Refuse a folder that holds anything but what another process, creating at this moment, may have put there."""
    for name in backend.names(""):
        # The other process may have finished since, and its first shard may be there.
        if not name.startswith((TEMPORARY_PREFIX, LOCK_PREFIX)) and not backend.exists(STORE_FILE):
            raise StoreError(f"{backend.where}: is not empty and no store (it holds {name!r}); name an empty folder")
    if not backend.is_there() and backend.exists(""):
        raise StoreError(f"{backend.where}: is a file, so no store can be made here; name a new folder")


def _stored(columns: Sequence[str] | None) -> list[str] | None:
    """Columns of the files among some names; "shard" is none of them, and comes in any case."""
    return None if columns is None else [name for name in columns if name != "shard"]


def _with_shard(table: Any, shard_id: str) -> Any:
    return table.append_column(
        pa.field("shard", pa.string(), nullable=False), pa.array([shard_id] * len(table), pa.string())
    )
