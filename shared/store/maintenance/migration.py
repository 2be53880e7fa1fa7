"""Migration: what a store of an older schema version holds, as a new store of the current one; the old one stays.

It is for what cannot be read in place (docs/compatibility.md). After a kill the same call goes on: each shard is
committed once, and store.json, without which the new folder is no store, is written last.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from shared.errors import SchemaVersionError, StoreError, UsageError
from shared.io.documents import parse_object, with_checksum, without_checksum
from shared.store import policies, reader
from shared.store.backends.base import Folder, StorageBackend, backend_of
from shared.store.layout import (
    MANIFEST_FILE,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    READ_VERSIONS,
    SCHEMA_VERSION,
    STATUS_FOLDER,
    STORE_FILE,
    FileEntry,
    file_entries,
    parse_manifest,
)
from shared.store.presence import alone
from shared.store.store import Store
from shared.store.writer import commit_files

Content = dict[str, Any]

_NOTE = f"{STATUS_FOLDER}/migration.json"
"""Says which store is being migrated, so that a second one is not mixed with it."""


@dataclass(frozen=True, slots=True)
class MigrationStep:
    """What leads from one schema version to the next.

    Attributes:
        document: the new content of store.json or of a plan, given which of the two ("store", "plan") and its content.
        shard: the new files of a shard and the new content of its manifest, given the old ones.
    """

    document: Callable[[str, Content], Content]
    shard: Callable[[dict[str, bytes], Content], tuple[dict[str, bytes], Content]]


STEPS: dict[int, MigrationStep] = {}
"""By the version that a step begins with; version 1 is the first that was ever published."""


@dataclass(frozen=True, slots=True)
class Migrated:
    """What a migration did."""

    version: int
    """Schema version of the old store."""
    shards: int
    digest: str
    """Of the new store."""


def migrate(where: str | Path, out: str | Path, progress: Callable[[int, int], None] | None = None) -> Migrated:
    """Write a store of an older schema version as a new one of the current version.

    Args:
        where: the old store.
        out: the new one: an empty folder, or what an earlier call left.
        progress: called after each shard with how many are done and how many there are.

    Raises:
        UsageError: the store is of the current version, or both are one place.
        SchemaVersionError: the store is of a newer version, or of one from which no step leads here.
        StoreError: a file is damaged, or the new folder holds something else.
    """
    source, target = backend_of(where), backend_of(out)
    if source.where == target.where:
        raise UsageError(f"{out}: is the store to migrate; name another with --out")
    if not source.is_there():
        raise StoreError(f"{where}: there is no such folder; name an existing store")
    content = _document(source, STORE_FILE)
    version = content.get("schema_version")
    steps = _steps(version, str(where))
    note = with_checksum({"from": hashlib.sha256(with_checksum(content)).hexdigest()})
    if not target.create(_NOTE, note) and target.read(_NOTE, MAX_DOCUMENT_BYTES) != note:
        raise StoreError(f"{out}: holds the migration of another store; name another folder with --out")
    jobs = reader.committed_jobs(source)
    with alone(target):
        for name in source.names(PLANS_FOLDER):
            if name.endswith(".json") and not name.startswith("."):
                plan = _applied(steps, "plan", _document(source, f"{PLANS_FOLDER}/{name}"))
                target.create(f"{PLANS_FOLDER}/{name}", with_checksum(plan))
        for policy in policies.policy_versions(source):
            policies.publish_policy(target, policy, _policy(source, policy))
        for done, job in enumerate(jobs, 1):
            shard = reader.shard_folder(target, job.shard_id)
            if not reader.is_committed(shard):
                _migrate_shard(steps, reader.shard_folder(source, job.shard_id), target)
            if progress is not None:
                progress(done, len(jobs))
        target.create(STORE_FILE, with_checksum(_applied(steps, "store", content) | {"schema_version": SCHEMA_VERSION}))
    return Migrated(SCHEMA_VERSION - len(steps), len(jobs), Store.open(out).digest())


def _steps(version: Any, where: str) -> list[MigrationStep]:
    """What leads from a version to the current one."""
    if version in READ_VERSIONS:
        raise UsageError(f"{where}: is of schema version {version}, which this software reads; nothing to migrate")
    if not isinstance(version, int) or not all(number in STEPS for number in range(version, SCHEMA_VERSION)):
        raise SchemaVersionError(f"{where}: no migration leads from schema version {version} to {SCHEMA_VERSION}")
    if version > SCHEMA_VERSION:
        raise SchemaVersionError(f"{where}: schema version {version} is newer than this software's {SCHEMA_VERSION}")
    return [STEPS[number] for number in range(version, SCHEMA_VERSION)]


def _document(backend: StorageBackend, key: str) -> Content:
    return without_checksum(backend.read(key, MAX_DOCUMENT_BYTES), f"{backend.where}/{key}")


def _applied(steps: list[MigrationStep], what: str, content: Content) -> Content:
    for step in steps:
        content = step.document(what, content)
    return content


def _migrate_shard(steps: list[MigrationStep], old: Folder, target: StorageBackend) -> None:
    described = _document(old.backend, f"{old.key}/{MANIFEST_FILE}")
    files = _checked_files(old, described.get("files"))
    for step in steps:
        files, described = step.shard(files, described)
    source = f"{old}/{MANIFEST_FILE}"
    manifest = parse_manifest(with_checksum(described | {"schema_version": SCHEMA_VERSION}), source)
    commit_files(target, manifest, files)


def _policy(backend: StorageBackend, version: int) -> dict[str, bytes]:
    """A policy's files, whatever schema version its index names."""
    folder = Folder(backend, f"{POLICIES_FOLDER}/{policies.folder_name(version)}")
    index = parse_object(folder.read(policies.INDEX_FILE, MAX_DOCUMENT_BYTES), str(folder))
    return _checked_files(folder, index.get("files"))


def _checked_files(folder: Folder, entries: Any) -> dict[str, bytes]:
    """The files that a document of an older version names, of the sizes and checksums that it states."""
    try:
        stated: Mapping[str, FileEntry] = {name: FileEntry.model_validate(entry) for name, entry in entries.items()}
    except (ValidationError, AttributeError):
        raise StoreError(f"{folder}: its list of files is malformed; it is damaged or foreign") from None
    if any(".." in name.split("/") or name.startswith("/") for name in stated):
        raise StoreError(f"{folder}: names a file outside of it; it is foreign")
    files = {name: folder.read(name, entry.size) for name, entry in stated.items()}
    for name, entry in file_entries(files).items():
        if entry != stated[name]:
            raise StoreError(f"{folder}/{name}: its size or SHA-256 is not what was committed; restore it from a copy")
    return files
