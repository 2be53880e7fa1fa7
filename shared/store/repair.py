"""Repair: what is broken is set aside, never deleted, and what it held is named, so that it can be collected again.

Whatever can be told from the rest is made anew: a plan from its name and the setting, store.json from any plan.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from shared.errors import StoreError
from shared.plan import Job, Plan, Setting
from shared.store import reader
from shared.store.layout import (
    ASIDE_FOLDER,
    MAX_DOCUMENT_BYTES,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STORE_FILE,
    StoreDocument,
    parse_shard_id,
    parse_store_document,
)
from shared.store.place import Place, place_of
from shared.store.policies import folder_name
from shared.store.provenance import software_versions
from shared.store.sealed import canonical, seal, unseal
from shared.store.store import Store
from shared.store.verify import Problem, lost_policy_key, verify

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
        UsageError: a driver is at work on it.
    """
    place = place_of(where)
    moved: list[str] = []
    made = _restore_description(place, moved)
    store = Store.open(where)
    found: list[Problem] = []
    lost: list[int] = []
    with store.only_driver():
        store.sweep()
        for _ in range(_MOST_ROUNDS):
            problems = [*verify(store, progress), *_unfinished(store)]
            if not problems:
                break
            found += problems
            for key in sorted({problem.broken for problem in problems} - {""}):
                set_aside(place, key)
                moved.append(key)
            made += _make_plans(store)
            lost += _note_lost_policies(store)
        missing = _missing(store, moved)
    return store, Repair(tuple(found), tuple(moved), tuple(made), tuple(lost), tuple(missing))


def set_aside(place: Place, key: str) -> str:
    """Move a file or folder of a store to a free name below "aside/", which nothing reads."""
    folder, _, name = f"{ASIDE_FOLDER}/{key}".rpartition("/")
    taken = set(place.names(folder))
    new = next(free for n in range(len(taken) + 1) if (free := f"{name}.{n}" if n else name) not in taken)
    place.move(key, f"{folder}/{new}")
    return f"{folder}/{new}"


def _restore_description(place: Place, moved: list[str]) -> list[str]:
    """Make store.json anew from a plan where it is missing or broken."""
    try:
        parse_store_document(place.read(STORE_FILE, MAX_DOCUMENT_BYTES), f"{place.where}/{STORE_FILE}")
        return []
    except StoreError as error:
        setting = _setting_of_any_plan(place)
        if setting is None:
            raise error
    if place.exists(STORE_FILE):
        moved.append(STORE_FILE)
        set_aside(place, STORE_FILE)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    document = StoreDocument(setting=setting, software=software_versions(), created=created)
    place.create(STORE_FILE, seal(document.model_dump(mode="json")))
    return [STORE_FILE]


def _setting_of_any_plan(place: Place) -> Setting | None:
    for name in place.names(PLANS_FOLDER):
        key = f"{PLANS_FOLDER}/{name}"
        try:
            return Plan.model_validate(unseal(place.read(key, MAX_DOCUMENT_BYTES), key)).setting
        except (StoreError, ValidationError):
            continue
    return None


def _unfinished(store: Store) -> list[Problem]:
    """Shards without a manifest in a place where verification takes them for work in progress."""
    if not store.place.writes_in_place:
        return []
    committed = {shard.name for shard in reader.committed_shards(store.place)}
    names = [shard.name for shard in reader.shard_folders(store.place) if shard.name not in committed]
    keys = [f"{SHARDS_FOLDER}/{name}" for name in names]
    return [Problem(key, "has no manifest, so counts for nothing", broken=key) for key in keys]


def _make_plans(store: Store) -> list[str]:
    """A plan is its name and the setting, so one that is missing can be written again."""
    known = {name.removesuffix(".json") for name in store.place.names(PLANS_FOLDER)}
    made = []
    for key in sorted({shard.name.rsplit("-", 2)[0] for shard in reader.committed_shards(store.place)} - known):
        proposer, _, version = key.rpartition("-v")
        store.add_plan(Plan(setting=store.setting, proposer=proposer, policy_version=int(version)))
        made.append(f"{PLANS_FOLDER}/{key}.json")
    return made


def _note_lost_policies(store: Store) -> list[int]:
    """Note which policies are gone: their weights cannot be made anew, but what they proposed stays true."""
    there = set(store.place.names(POLICIES_FOLDER))
    needed = {plan.policy_version for plan in store.plans() if plan.policy_version}
    lost = [version for version in sorted(needed) if folder_name(version) not in there]
    note = canonical({"noted": datetime.now(UTC).isoformat(timespec="seconds")})
    return [version for version in lost if store.place.create(lost_policy_key(version), note)]


def _missing(store: Store, moved: list[str]) -> list[Job]:
    """The jobs of shards that were set aside, without what other shards hold."""
    jobs = {job for key in moved if (job := parse_shard_id(key.rpartition("/")[2])) is not None}
    held = {(m.plan_key, index) for m in store.committed() for index in range(m.start, m.stop)}
    return [
        job
        for job in sorted(jobs, key=lambda job: (job.plan_key, job.start))
        if any((job.plan_key, index) not in held for index in range(job.start, job.stop))
    ]
