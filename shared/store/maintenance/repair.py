"""Repair: what is broken is set aside, never deleted, and what it held is named, so that it can be collected again.

Whatever can be told from the rest is made anew: a plan from its name and the setting, store.json from any plan.

What cannot be read at this moment, or was written under another schema version, is not broken: it ends the repair.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from shared.errors import MissingError, SchemaVersionError, StoreError, UnreadableError
from shared.io.documents import canonical, with_checksum
from shared.plan import Job, Plan, Setting, covered, parse_plan_key
from shared.store import reader
from shared.store.backends.base import StorageBackend, backend_of
from shared.store.coverage import order
from shared.store.layout import (
    ASIDE_FOLDER,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STORE_FILE,
    StoreDocument,
    parse_sealed,
    parse_shard_id,
    parse_store_document,
)
from shared.store.maintenance.verify import Problem, lost_policy_key, verify
from shared.store.policies import folder_name
from shared.store.presence import alone
from shared.store.provenance import store_software
from shared.store.store import Store

_MOST_ROUNDS = 5
"""What is set aside in one round may show what it hid; two have always been enough."""


@dataclass(frozen=True, slots=True)
class Repair:
    """What a repair did."""

    problems: tuple[Problem, ...]
    """What was wrong."""
    set_aside: tuple[str, ...]
    """Keys as they were; all now begin with "aside/"."""
    made_anew: tuple[str, ...]
    """Keys of documents that were told from others."""
    lost_policies: tuple[int, ...]
    """Versions that plans name and that are gone; shards made by them stay."""
    to_collect: tuple[Job, ...]
    """Rollouts that were in shards which were set aside, and that no other shard holds."""


def repair(where: str | Path, progress: Callable[[int, int], None] | None = None) -> tuple[Store, Repair]:
    """Make a broken store one that verifies; nothing is changed in a sound one.

    Args:
        where: the store.
        progress: see `verify`.

    Raises:
        StoreError: there is no store, or nothing tells what its setting was.
        SchemaVersionError: the store, or a part of it, is of another schema version; nothing was changed.
        UnreadableError: something cannot be read at this moment; nothing was set aside for that.
        UsageError: a driver or a worker is at work on it.
    """
    backend = backend_of(where)
    if not backend.is_there():
        raise StoreError(f"{where}: there is no such folder; name an existing store")
    setting = _setting_to_restore(backend)
    moved: list[str] = []
    found: list[Problem] = []
    lost: list[int] = []
    with alone(backend):
        made = [] if setting is None else _restore_description(backend, setting, moved)
        store = Store.open(where)
        for _ in range(_MOST_ROUNDS):
            problems = [*verify(store, progress), *_unfinished(store)]
            if not problems:
                break
            found += problems
            for key in sorted({problem.broken for problem in problems} - {""}):
                set_aside(backend, key)
                moved.append(key)
            made += _make_plans(store)
            lost += _note_lost_policies(store)
        store.sweep()
        missing = _missing(store, moved)
    return store, Repair(tuple(found), tuple(moved), tuple(made), tuple(lost), tuple(missing))


def set_aside(backend: StorageBackend, key: str) -> str:
    """Move a file or folder of a store to a free name below "aside/", which nothing reads."""
    folder, _, name = f"{ASIDE_FOLDER}/{key}".rpartition("/")
    names = (f"{name}.{n}" if n else name for n in count())
    # Not by a list of what is there: a compaction sets a million shards aside.
    new = next(n for n in names if not backend.exists(f"{folder}/{n}") and not backend.leaves(f"{folder}/{n}"))
    backend.move(key, f"{folder}/{new}")
    return f"{folder}/{new}"


def _setting_to_restore(backend: StorageBackend) -> Setting | None:
    """What store.json must say where it is missing or broken, told from any plan; None where it is sound.

    Raises:
        StoreError: no plan tells it, or store.json, or a shard where it is broken, is not damaged but something else.
    """
    try:
        parse_store_document(backend.read(STORE_FILE, MAX_DOCUMENT_BYTES), f"{backend.where}/{STORE_FILE}")
    except (UnreadableError, SchemaVersionError):
        raise
    except StoreError as error:
        setting = _setting_of_any_plan(backend)
        if setting is None or (isinstance(error, MissingError) and backend.exists(STORE_FILE)):
            raise
        # A lost store.json says nothing of the version; the shards do.
        for manifest in reader.committed_jobs(backend):
            try:
                reader.read_manifest(reader.shard_folder(backend, manifest.shard_id))
            except (UnreadableError, SchemaVersionError):
                raise
            except StoreError:
                continue
        return setting
    return None


def _restore_description(backend: StorageBackend, setting: Setting, moved: list[str]) -> list[str]:
    """Make store.json anew."""
    if backend.exists(STORE_FILE):
        moved.append(STORE_FILE)
        set_aside(backend, STORE_FILE)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    document = StoreDocument(setting=setting, software=store_software(), created=created)
    backend.create(STORE_FILE, with_checksum(document.as_document()))
    return [STORE_FILE]


def _setting_of_any_plan(backend: StorageBackend) -> Setting | None:
    for name in backend.names(PLANS_FOLDER):
        key = f"{PLANS_FOLDER}/{name}"
        try:
            return parse_sealed(Plan, backend.read(key, MAX_DOCUMENT_BYTES), key, "a plan").setting
        except (UnreadableError, SchemaVersionError):
            raise
        except StoreError:
            continue
    return None


def _unfinished(store: Store) -> list[Problem]:
    """Shards without a manifest in a place where verification takes them for work in progress."""
    if not store.backend.writes_in_place:
        return []
    committed = set(reader.committed_jobs(store.backend))
    keys = [f"{SHARDS_FOLDER}/{job.shard_id}" for job in reader.named_jobs(store.backend) if job not in committed]
    return [Problem(key, "has no manifest, so counts for nothing", broken=key) for key in keys]


def _make_plans(store: Store) -> list[str]:
    """A plan is its name and the setting, so one that is missing can be written again."""
    known = {name.removesuffix(".json") for name in store.backend.names(PLANS_FOLDER)}
    made = []
    for key in sorted({job.plan_key for job in reader.committed_jobs(store.backend)} - known):
        proposer, version = parse_plan_key(key)
        store.add_plan(Plan(setting=store.setting, proposer=proposer, policy_version=version))
        made.append(f"{PLANS_FOLDER}/{key}.json")
    return made


def _note_lost_policies(store: Store) -> list[int]:
    """Note which policies are gone: their weights cannot be made anew, but what they proposed stays true."""
    there = set(store.backend.names(POLICIES_FOLDER))
    needed = {plan.policy_version for plan in store.plans() if plan.policy_version}
    lost = [version for version in sorted(needed) if folder_name(version) not in there]
    note = canonical({"noted": datetime.now(UTC).isoformat(timespec="seconds")})
    return [version for version in lost if store.backend.create(lost_policy_key(version), note)]


def _missing(store: Store, moved: list[str]) -> list[Job]:
    """The jobs of shards that were set aside, without what other shards hold."""
    jobs = {job for key in moved if (job := parse_shard_id(key.rpartition("/")[2])) is not None}
    held: dict[str, list[tuple[int, int]]] = {}
    for job in reader.committed_jobs(store.backend) if jobs else ():
        held.setdefault(job.plan_key, []).append((job.start, job.stop))

    def is_held(job: Job) -> bool:
        inside = [(max(low, job.start), min(high, job.stop)) for low, high in held.get(job.plan_key, ())]
        return covered(each for each in inside if each[0] < each[1]) == job.stop - job.start

    return [job for job in sorted(jobs, key=order) if not is_held(job)]
