"""The store as its users see it.

store = Store.create(path, setting)                       # or opens it, if it holds the same setting
store.commit(plan, job, rollouts, {"physics_s": "6.1"})   # a worker, or many at once
table = store.interactions(["point", "success"])          # a learner
clouds = store.read_observations(shard_id)
"""

import difflib
import hashlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import pyarrow as pa
from pydantic import ValidationError

from shared.errors import StoreError, UsageError
from shared.files import TEMPORARY_PREFIX
from shared.plan import Job, Plan, Setting
from shared.records import RolloutRecord
from shared.store import policies, reader
from shared.store.conformance import check_place
from shared.store.coverage import ROLLOUT_COLUMN, Part, parts_of
from shared.store.difference import difference_of
from shared.store.digest import combined_digest
from shared.store.layout import (
    LOCK_PREFIX,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STORE_FILE,
    Quarantined,
    ShardManifest,
    StoreDocument,
    parse_shard_id,
    parse_store_document,
)
from shared.store.observations import ObservationArrays
from shared.store.place import Folder, Place, is_url, place_of
from shared.store.provenance import software_versions
from shared.store.sealed import seal, unseal
from shared.store.snapshot import Snapshot
from shared.store.tables import INTERACTION_SCHEMA, ROLLOUT_SCHEMA
from shared.store.writer import commit_shard
from shared.underway import UNDERWAY_FOLDER, Underway

MAX_SEED = 2**64 - 1
DRIVER = "driver"
"""Whoever hands out jobs."""


class Store:
    """A folder of immutable shards, all of one setting. Any number of processes may use it at once."""

    def __init__(self, place: Place, document: StoreDocument) -> None:
        """Use `Store.create` or `Store.open`."""
        self.place = place
        self.document = document
        self._recorded: dict[str, Plan] = {}
        self._snapshot: Snapshot | None = None

    @property
    def where(self) -> str:
        """What people call the store's place: a folder or a URL; `Store.open` takes it."""
        return self.place.where

    @property
    def setting(self) -> Setting:
        """What all rows have in common."""
        return self.document.setting

    @classmethod
    def create(cls, where: str | Path, setting: Setting) -> "Store":
        """Make a store, or open the one that is there.

        Args:
            where: a folder, or s3://BUCKET/PREFIX.
            setting: of all its rows.

        Raises:
            StoreError: a store of another setting is there, or files that are no store, or it cannot be made, or the
                bucket's server lets several writers of one key win.
            UsageError: the setting's seed is too large to be stored, or the URL is not allowed.
        """
        if setting.seed > MAX_SEED:
            raise UsageError(f"seed {setting.seed} is too large; allowed: 0 to {MAX_SEED}")
        place = place_of(where)
        try:
            if not place.exists(STORE_FILE):
                _refuse_foreign(place)
                if place.writes_in_place:
                    # Only what a server promises keeps two writers of a shard apart there; some break it.
                    check_place(place)
                created = datetime.now(UTC).isoformat(timespec="seconds")
                document = StoreDocument(setting=setting, software=software_versions(), created=created)
                place.create(STORE_FILE, seal(document.model_dump(mode="json")))
        except OSError as error:
            raise StoreError(f"{where}: no store can be made here ({error.strerror}); name another folder") from None
        store = cls.open(where)
        if store.setting != setting:
            difference = difference_of(store.setting.model_dump(mode="json"), setting.model_dump(mode="json"))
            raise StoreError(f"{where} holds another setting: {difference}; give the same, or another folder")
        return store

    @classmethod
    def open(cls, where: str | Path) -> "Store":
        """Open a store that is there.

        Args:
            where: a folder, or s3://BUCKET/PREFIX.

        Raises:
            StoreError: it is missing, no store, damaged, or of another schema version.
            UsageError: the URL is not allowed.
        """
        place = place_of(where)
        if not place.is_there():
            raise StoreError(f"{where}: there is no such folder; name an existing store")
        if not place.exists(STORE_FILE):
            raise StoreError(f"{where}: is no store (it has no {STORE_FILE}); name an existing store")
        return cls(place, parse_store_document(place.read(STORE_FILE, MAX_DOCUMENT_BYTES), f"{where}/{STORE_FILE}"))

    def as_of(self, snapshot: Snapshot) -> "Store":
        """The store as it was when it held these rollouts, for whoever reads it while others add to it."""
        store = Store(self.place, self.document)
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
            difference = difference_of(self.setting.model_dump(mode="json"), plan.setting.model_dump(mode="json"))
            raise StoreError(f"{self.where}: plan {plan.key} is of another setting: {difference}")
        key = f"{PLANS_FOLDER}/{plan.key}.json"
        made = self.place.create(key, seal(plan.model_dump(mode="json")))
        # Compared as plans: a setting that came with later software has its default in a file that lacks it.
        if not made and self.read_plan(f"{plan.key}.json") != plan:
            raise StoreError(f"{self.where}/{key}: holds another plan of this name; give this one another store")
        self._recorded[plan.key] = plan

    def plans(self) -> tuple[Plan, ...]:
        """The plans, in order of name.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        names = [name for name in self.place.names(PLANS_FOLDER) if not name.startswith(".")]
        return tuple(self.read_plan(name) for name in names if name.endswith(".json"))

    def read_plan(self, name: str) -> Plan:
        """A plan from the file of this name.

        Raises:
            StoreError: the file is damaged or foreign.
        """
        key = f"{PLANS_FOLDER}/{name}"
        file = f"{self.where}/{key}"
        data = self.place.read(key, MAX_DOCUMENT_BYTES)
        try:
            plan = Plan.model_validate(unseal(data, file))
        except ValidationError:
            raise StoreError(f"{file}: is no plan; the file is damaged or foreign") from None
        if f"{plan.key}.json" != name or plan.setting != self.setting:
            raise StoreError(f"{file}: is no plan of this store; the file is damaged or foreign")
        return plan

    def committed(self, plan_key: str | None = None) -> list[ShardManifest]:
        """Manifests of the committed shards (of one plan), in order of name; no data are read.

        Shards whose rollouts larger ones hold as well, as a compaction leaves them until it ends, are left out.

        Raises:
            StoreError: a manifest is damaged or foreign.
        """
        return [part.manifest for part in self.parts(plan_key)]

    def jobs(self, plan_key: str | None = None) -> list[Job]:
        """The jobs (of one plan) whose shards are committed, by name; their ranges may overlap.

        No manifest is read: of a million shards that would take a quarter of an hour, and their names take seconds.
        """
        return reader.committed_jobs(self.place, plan_key)

    def parts(self, plan_key: str | None = None) -> list[Part]:
        """What counts of which shard, in order; raises as `committed` does."""
        parts = parts_of(reader.read_manifests(reader.committed_shards(self.place, plan_key)))
        return parts if self._snapshot is None else self._snapshot.limit(parts)

    def rollouts_of(self, part: Part) -> list[RolloutRecord]:
        """The rollouts of a shard that count, in order; raises as `read_rollouts` does."""
        rollouts = self.read_rollouts(part.manifest.shard_id)
        return [rollout for rollout in rollouts if part.start <= rollout.index < part.stop]

    def tables_of(self, part: Part) -> tuple[Any, Any]:
        """The rollouts and the interactions of a shard that count, as tables.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        shard = reader.shard_folder(self.place, part.manifest.shard_id)
        rollouts = reader.read_rollout_table(shard, part.manifest)
        return part.of(rollouts), part.of(reader.read_interactions(shard, part.manifest))

    def holds(self, job: Job) -> bool:
        """Whether the shard of a job is committed."""
        return reader.is_committed(reader.shard_folder(self.place, job.shard_id))

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
        """Store the rollouts of a job as one shard: wholly or not at all, and once, however many workers try.

        Args:
            plan: whose job it is.
            job: the range of rollouts.
            rollouts: all of them, in order.
            provenance: what is known of how they were made, such as seconds by stage; not part of the digest.
            quarantined: why rollouts of that status are; likewise no part of it.
            vetted: whether a driver has seen that no shard holds these rollouts. Otherwise the names of all shards are
                listed for it, which takes the longer the more there are. Readers count each rollout once in any case.

        Returns:
            The manifest; that of the shard which was there already, where another worker was faster.

        Raises:
            StoreError: the rollouts are not the job's, break the rules of a record, or overlap another shard.
        """
        if job.plan_key != plan.key:
            raise StoreError(f"job {job.shard_id} is not of plan {plan.key}; give the plan that made it")
        self.add_plan(plan)
        known = set(self.setting.objects)
        for rollout in rollouts:
            if rollout.object not in known or rollout.seed != self.setting.seed:
                raise StoreError(
                    f"{job.shard_id}: rollout {rollout.index} (object {rollout.object.id}, seed {rollout.seed}) "
                    "is of another object or seed than the store's"
                )
        points = self.setting.collection.camera.points
        return commit_shard(self.place, job, rollouts, points, provenance, quarantined, vetted=vetted)

    def only_driver(self) -> AbstractContextManager[None]:
        """Hold the store against other drivers, which would do everything twice; in a bucket they may, without harm.

        Raises:
            UsageError: another driver holds it; the message names the process.
        """
        return self.place.only_one(DRIVER)

    def sweep(self) -> int:
        """Remove what dead writers left unfinished; returns how many files and folders that was."""
        folders = ["", PLANS_FOLDER, SHARDS_FOLDER, POLICIES_FOLDER]
        return self.place.sweep(folders) + self.underway.sweep()

    def digest(self, plan_key: str | None = None) -> str:
        """Content digest of the store, or of one plan: independent of shards, workers, hosts and times."""
        return combined_digest(
            (part.manifest.plan_key, index, part.manifest.digests[index - part.manifest.start])
            for part in self.parts(plan_key)
            for index in range(part.start, part.stop)
        )

    def interactions(self, columns: Sequence[str] | None = None, plan_keys: Sequence[str] | None = None) -> Any:
        """A pyarrow table, one row an interaction; "shard" and "observation" (index in it) find a row's cloud.

        Args:
            columns: names (see `shared.store.columns`); None: all. "shard" and "observation" always come.
            plan_keys: rows of these plans only; None: all.

        Raises:
            UsageError: there is no such column.
            StoreError: a file is damaged or foreign.
        """
        names = list(INTERACTION_SCHEMA.names if columns is None else dict.fromkeys([*columns, "observation"]))
        names = [name for name in names if name != "shard"]
        for name in names:
            if name not in INTERACTION_SCHEMA.names:
                close = difflib.get_close_matches(name, INTERACTION_SCHEMA.names, n=1)
                hint = f"did you mean '{close[0]}'?" if close else f"allowed: {', '.join(INTERACTION_SCHEMA.names)}"
                raise UsageError(f"no column '{name}' in the interactions; {hint}")
        schema = pa.schema([INTERACTION_SCHEMA.field(name) for name in names])
        parts = [part for part in self.parts() if plan_keys is None or part.manifest.plan_key in plan_keys]
        wanted = [names if part.is_whole else list(dict.fromkeys([*names, ROLLOUT_COLUMN])) for part in parts]
        found = reader.read_many_interactions(self.place, [part.manifest for part in parts], wanted)
        tables = [
            _with_shard(part.of(table).select(names), part.manifest.shard_id)
            for part, table in zip(parts, found, strict=True)
        ]
        return pa.concat_tables([_with_shard(schema.empty_table(), ""), *tables])

    def rollouts(self) -> Any:
        """A pyarrow table, one row a rollout, those without interactions included; "shard" says where it lies.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        parts = self.parts()
        found = reader.read_many_rollout_tables(self.place, [part.manifest for part in parts])
        tables = [_with_shard(part.of(table), part.manifest.shard_id) for part, table in zip(parts, found, strict=True)]
        return pa.concat_tables([_with_shard(ROLLOUT_SCHEMA.empty_table(), ""), *tables])

    def read_observations(self, shard_id: str) -> ObservationArrays:
        """All clouds of a shard.

        Raises:
            StoreError: there is no such shard, or it is damaged or foreign.
        """
        shard = self._committed_shard(shard_id)
        return reader.read_observations(shard, reader.read_manifest(shard))

    def read_rollouts(self, shard_id: str) -> tuple[RolloutRecord, ...]:
        """The records of a shard, bit for bit as they were committed.

        Raises:
            StoreError: there is no such shard, or it is damaged or foreign.
        """
        shard = self._committed_shard(shard_id)
        return reader.read_rollouts(shard, reader.read_manifest(shard))

    def publish_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Put a policy's files into the store, all or none; see `shared.store.policies`."""
        policies.publish_policy(self.place, version, files)

    def read_policy(self, version: int) -> dict[str, bytes]:
        """A policy's files, checked; see `shared.store.policies`."""
        return policies.read_policy(self.place, version)

    def policy_versions(self) -> tuple[int, ...]:
        """The versions that are published, in order."""
        return policies.policy_versions(self.place)

    @property
    def path(self) -> Path:
        """The folder of a store that lies on a disk.

        Raises:
            UsageError: it lies in a bucket.
        """
        if is_url(self.where):
            raise UsageError(
                f"{self.where}: lies in no folder; copy it by `adaafford store merge {self.where} --out DIR`"
            )
        return Path(self.where)

    @property
    def shards_folder(self) -> Path:
        """Where shards lie; raises as `path` does."""
        return self.path / SHARDS_FOLDER

    @property
    def policies_folder(self) -> Path:
        """Where policies lie; raises as `path` does."""
        return self.path / POLICIES_FOLDER

    @property
    def underway(self) -> Underway:
        """Where workers leave their breadcrumbs."""
        if is_url(self.where):
            # Last words come from a handler of signals, which knows files alone.
            name = f"adaafford-underway-{hashlib.sha256(self.where.encode()).hexdigest()[:16]}"
            return Underway(Path(gettempdir()) / name, self.where)
        return Underway(self.path / UNDERWAY_FOLDER)

    def _committed_shard(self, shard_id: str) -> Folder:
        folder = reader.shard_folder(self.place, shard_id)
        if parse_shard_id(shard_id) is None or not reader.is_committed(folder):
            raise StoreError(f"{self.where}: holds no committed shard {shard_id[:80]!r}; see `store info`")
        return folder


def _refuse_foreign(place: Place) -> None:
    """Refuse a folder that holds anything but what another process, creating at this moment, may have put there."""
    for name in place.names(""):
        # The other process may have finished since, and its first shard may be there.
        if not name.startswith((TEMPORARY_PREFIX, LOCK_PREFIX)) and not place.exists(STORE_FILE):
            raise StoreError(f"{place.where}: is not empty and no store (it holds {name!r}); name an empty folder")


def _with_shard(table: Any, shard_id: str) -> Any:
    return table.append_column(
        pa.field("shard", pa.string(), nullable=False), pa.array([shard_id] * len(table), pa.string())
    )
