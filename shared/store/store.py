"""The store as its users see it.

store = Store.create(path, setting)                       # or opens it, if it holds the same setting
store.commit(plan, job, rollouts, {"physics_s": "6.1"})   # a worker, or many at once
table = store.interactions(["point", "success"])          # a learner
clouds = store.read_observations(shard_id)
"""

import difflib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
from pydantic import ValidationError

from shared.errors import StoreError, UsageError
from shared.files import TEMPORARY_PREFIX, create_exclusively, read_bounded, remove_if_abandoned
from shared.plan import Job, Plan, Setting
from shared.records import RolloutRecord
from shared.store import policies, reader
from shared.store.difference import difference_of
from shared.store.digest import combined_digest
from shared.store.layout import (
    LOCK_PREFIX,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STORE_FILE,
    UNDERWAY_FOLDER,
    Quarantined,
    ShardManifest,
    StoreDocument,
    parse_shard_id,
    parse_store_document,
)
from shared.store.observations import ObservationArrays
from shared.store.provenance import software_versions
from shared.store.sealed import seal, unseal
from shared.store.tables import INTERACTION_SCHEMA, ROLLOUT_SCHEMA
from shared.store.writer import commit_shard
from shared.underway import Underway

MAX_SEED = 2**64 - 1


class Store:
    """A folder of immutable shards, all of one setting. Any number of processes may use it at once."""

    def __init__(self, path: Path, document: StoreDocument) -> None:
        """Use `Store.create` or `Store.open`."""
        self.path = path
        self.document = document

    @property
    def setting(self) -> Setting:
        """What all rows have in common."""
        return self.document.setting

    @classmethod
    def create(cls, path: Path, setting: Setting) -> "Store":
        """Make a store, or open the one that is there.

        Raises:
            StoreError: a store of another setting is there, or files that are no store, or the folder cannot be made.
            UsageError: the setting's seed is too large to be stored.
        """
        if setting.seed > MAX_SEED:
            raise UsageError(f"seed {setting.seed} is too large; allowed: 0 to {MAX_SEED}")
        try:
            path.mkdir(parents=True, exist_ok=True)
            if not (path / STORE_FILE).exists():
                _refuse_foreign(path)
                created = datetime.now(UTC).isoformat(timespec="seconds")
                document = StoreDocument(setting=setting, software=software_versions(), created=created)
                create_exclusively(path / STORE_FILE, seal(document.model_dump(mode="json")))
        except OSError as error:
            raise StoreError(f"{path}: no store can be made here ({error.strerror}); name another folder") from None
        store = cls.open(path)
        if store.setting != setting:
            difference = difference_of(store.setting.model_dump(mode="json"), setting.model_dump(mode="json"))
            raise StoreError(f"{path} holds another setting: {difference}; give the same, or another folder")
        return store

    @classmethod
    def open(cls, path: Path) -> "Store":
        """Open a store that is there.

        Raises:
            StoreError: it is missing, no store, damaged, or of another schema version.
        """
        file = path / STORE_FILE
        if not path.is_dir():
            raise StoreError(f"{path}: there is no such folder; name an existing store")
        if not file.exists():
            raise StoreError(f"{path}: is no store (it has no {STORE_FILE}); name an existing store")
        return cls(path, parse_store_document(read_bounded(file, MAX_DOCUMENT_BYTES), str(file)))

    def add_plan(self, plan: Plan) -> None:
        """Record a plan; recording it again changes nothing.

        Raises:
            StoreError: the plan is of another setting, or another plan has its name.
        """
        if plan.setting != self.setting:
            difference = difference_of(self.setting.model_dump(mode="json"), plan.setting.model_dump(mode="json"))
            raise StoreError(f"{self.path}: plan {plan.key} is of another setting: {difference}")
        file = self._plans / f"{plan.key}.json"
        self._plans.mkdir(exist_ok=True)
        if not file.exists() and create_exclusively(file, seal(plan.model_dump(mode="json"))):
            return
        # Compared as plans: a setting that came with later software has its default in a file that lacks it.
        if self.read_plan(file) != plan:
            raise StoreError(f"{file}: holds another plan of this name; give this one another store")

    def plans(self) -> tuple[Plan, ...]:
        """The plans, in order of name.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        files = sorted(self._plans.glob("[!.]*.json")) if self._plans.is_dir() else []
        return tuple(self.read_plan(file) for file in files)

    def read_plan(self, file: Path) -> Plan:
        """A plan from its file.

        Raises:
            StoreError: the file is damaged or foreign.
        """
        data = read_bounded(file, MAX_DOCUMENT_BYTES)
        try:
            plan = Plan.model_validate(unseal(data, str(file)))
        except ValidationError:
            raise StoreError(f"{file}: is no plan; the file is damaged or foreign") from None
        if plan.key != file.stem or plan.setting != self.setting:
            raise StoreError(f"{file}: is no plan of this store; the file is damaged or foreign")
        return plan

    def committed(self, plan_key: str | None = None) -> list[ShardManifest]:
        """Manifests of the committed shards (of one plan), in order of name; no data are read.

        Raises:
            StoreError: a manifest is damaged or foreign.
        """
        return [reader.read_manifest(shard) for shard in reader.committed_shards(self.shards_folder, plan_key)]

    def holds(self, job: Job) -> bool:
        """Whether the shard of a job is committed."""
        return reader.is_committed(self.shards_folder / job.shard_id)

    def commit(
        self,
        plan: Plan,
        job: Job,
        rollouts: Sequence[RolloutRecord],
        provenance: Mapping[str, str],
        quarantined: Sequence[Quarantined] = (),
    ) -> ShardManifest:
        """Store the rollouts of a job as one shard: wholly or not at all, and once, however many workers try.

        Args:
            plan: whose job it is.
            job: the range of rollouts.
            rollouts: all of them, in order.
            provenance: what is known of how they were made, such as seconds by stage; not part of the digest.
            quarantined: why rollouts of that status are; likewise no part of it.

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
        return commit_shard(self.shards_folder, job, rollouts, points, provenance, quarantined)

    def sweep(self) -> int:
        """Remove what dead writers left unfinished; returns how many files and folders that was."""
        folders = [self.path, self._plans, self.shards_folder, self.policies_folder]
        remnants = [p for folder in folders if folder.is_dir() for p in folder.glob(f"{TEMPORARY_PREFIX}*")]
        return sum(remove_if_abandoned(remnant) for remnant in remnants) + self.underway.sweep()

    def digest(self, plan_key: str | None = None) -> str:
        """Content digest of the store, or of one plan: independent of shards, workers, hosts and times."""
        return combined_digest(
            (manifest.plan_key, index, digest)
            for manifest in self.committed(plan_key)
            for index, digest in enumerate(manifest.digests, manifest.start)
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
        shards = [m for m in self.committed() if plan_keys is None or m.plan_key in plan_keys]
        tables = [
            _with_shard(reader.read_interactions(self._shard(m), m, names).select(names), m.shard_id) for m in shards
        ]
        return pa.concat_tables([_with_shard(schema.empty_table(), ""), *tables])

    def rollouts(self) -> Any:
        """A pyarrow table, one row a rollout, those without interactions included; "shard" says where it lies.

        Raises:
            StoreError: a file is damaged or foreign.
        """
        tables = [_with_shard(reader.read_rollout_table(self._shard(m), m), m.shard_id) for m in self.committed()]
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
        policies.publish_policy(self.policies_folder, version, files)

    def read_policy(self, version: int) -> dict[str, bytes]:
        """A policy's files, checked; see `shared.store.policies`."""
        return policies.read_policy(self.policies_folder, version)

    def policy_versions(self) -> tuple[int, ...]:
        """The versions that are published, in order."""
        return policies.policy_versions(self.policies_folder)

    @property
    def shards_folder(self) -> Path:
        """Where shards lie."""
        return self.path / SHARDS_FOLDER

    @property
    def policies_folder(self) -> Path:
        """Where policies lie."""
        return self.path / POLICIES_FOLDER

    @property
    def underway(self) -> Underway:
        """Where workers leave their breadcrumbs."""
        return Underway(self.path / UNDERWAY_FOLDER)

    @property
    def _plans(self) -> Path:
        return self.path / PLANS_FOLDER

    def _shard(self, manifest: ShardManifest) -> Path:
        return self.shards_folder / manifest.shard_id

    def _committed_shard(self, shard_id: str) -> Path:
        if parse_shard_id(shard_id) is None or not reader.is_committed(self.shards_folder / shard_id):
            raise StoreError(f"{self.path}: holds no committed shard {shard_id[:80]!r}; see `store info`")
        return self.shards_folder / shard_id


def _refuse_foreign(path: Path) -> None:
    """Refuse a folder that holds anything but what another process, creating at this moment, may have put there."""
    for entry in path.iterdir():
        # The other process may have finished since, and its first shard may be there.
        if not entry.name.startswith((TEMPORARY_PREFIX, LOCK_PREFIX)) and not (path / STORE_FILE).exists():
            raise StoreError(f"{path}: is not empty and no store (it holds {entry.name!r}); name an empty folder")


def _with_shard(table: Any, shard_id: str) -> Any:
    return table.append_column(
        pa.field("shard", pa.string(), nullable=False), pa.array([shard_id] * len(table), pa.string())
    )
