"""Verification: everything that a store claims, recomputed from its bytes."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from shared.errors import MissingError, SchemaVersionError, StoreError, UnreadableError
from shared.io.files import TEMPORARY_PREFIX
from shared.plan import Job, RolloutRecord
from shared.store import reader
from shared.store.backends.base import Folder
from shared.store.codecs.columns import COPIED_COLUMNS, InteractionRow, added_in, hidden_names, interaction_columns
from shared.store.codecs.tables import column_values
from shared.store.coverage import Window, overlapping
from shared.store.crash_log import CRASH_LOG_FOLDER
from shared.store.layout import (
    ASIDE_FOLDER,
    LOCK_PREFIX,
    MANIFEST_FILE,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STATUS_FOLDER,
    STORE_FILE,
    ShardManifest,
    parse_shard_id,
)
from shared.store.policies import INDEX_FILE, folder_name
from shared.store.store import Store
from shared.store.writer import rollout_digest

_FRAME_TOLERANCE = 1e-9
"""Camera-frame columns were computed by a matrix product, whose last bits depend on the machine."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that is not as it should be."""

    where: str
    """Path within the store."""
    what: str
    """One line."""
    broken: str = ""
    """Key of the file or folder that `store repair` sets aside; "" for what is missing."""


def verify(store: Store, progress: Callable[[int, int], None] | None = None) -> list[Problem]:
    """All problems of a store; none for a sound one.

    Only what contradicts a checksum, a size or a format is a problem: whatever cannot be read at this moment, or was
    written under another schema version, ends the verification.

    Args:
        store: which one.
        progress: called after each shard with how many are done and how many there are.

    Raises:
        UnreadableError: a disk, a network or a server refused, or something vanished meanwhile.
        SchemaVersionError: a document is of another schema version.
    """
    jobs = reader.committed_jobs(store.backend)
    problems = [*_plans_and_policies(store, jobs), *_strangers(store, jobs)]
    unsound = set()
    for done, job in enumerate(jobs, 1):
        shard = reader.shard_folder(store.backend, job.shard_id)
        try:
            manifest = reader.read_manifest(shard)
        except StoreError as error:
            unsound.add(job)
            lost = partial(reader.read_manifest, shard)
            problems.append(_problem(shard.key, damage(error, lost, shard, MANIFEST_FILE), store))
        else:
            problems += _shard(store, shard, manifest)
        if progress is not None:
            progress(done, len(jobs))
    problems += _overlaps(store, [job for job in jobs if job not in unsound])
    if not store.backend.exists(STORE_FILE):
        raise UnreadableError(f"{store.where}: vanished while it was verified; is its disk still there?")
    return problems


def damage(error: StoreError, read: Callable[[], object], folder: Folder, mark: str) -> str:
    """What an error in reading a folder of a store says, if the folder is damaged.

    Args:
        error: what was raised.
        read: reads the same once more; that a file is missing must show twice.
        folder: whose file it was.
        mark: the file that makes the folder count, which was there before.

    Raises:
        StoreError: the error itself, where it tells of no damage; or the folder, or a file of it, comes and goes.
    """
    if isinstance(error, UnreadableError | SchemaVersionError):
        raise error
    if isinstance(error, MissingError):
        try:
            read()
            still_missing = False
        except MissingError:
            still_missing = folder.has(mark)
        if not still_missing:
            raise UnreadableError(
                f"{folder}: changed or vanished while it was read; end what moves it, then repeat the command"
            )
    return str(error)


def _shard(store: Store, shard: Folder, manifest: ShardManifest) -> Iterator[Problem]:
    """Problems of one shard; the first damaged file of it hides later checks."""
    yield from _strangers_in_shard(shard, manifest)
    damaged = False
    for name in manifest.files:
        try:
            reader.read_file(shard, manifest, name)
        except StoreError as error:
            damaged = True
            what = damage(error, partial(reader.read_file, shard, manifest, name), shard, MANIFEST_FILE)
            yield _problem(f"{shard.key}/{name}", what, store, broken=shard.key)
    if damaged:
        return
    try:
        yield from _content(store, shard, manifest)
    except StoreError as error:
        what = damage(error, partial(reader.read_rollouts, shard, manifest), shard, MANIFEST_FILE)
        yield _problem(shard.key, what, store)


def _content(store: Store, shard: Folder, manifest: ShardManifest) -> Iterator[Problem]:
    """Problems of what undamaged files hold."""
    rollouts = reader.read_rollouts(shard, manifest)
    for rollout, digest in zip(rollouts, manifest.digests, strict=True):
        if rollout_digest(rollout) != digest:
            yield _problem(shard.key, f"rollout {rollout.index} is not the one whose digest the manifest states")
    known = store.setting.identities
    added = store.setting.dynamics.added
    for rollout in rollouts:
        if rollout.object.identity not in known or rollout.seed != store.setting.seed:
            yield _problem(shard.key, f"rollout {rollout.index} is of another object or seed than the store's")
        if rollout.dynamics.added != added:
            yield _problem(shard.key, f"rollout {rollout.index} has other hidden parameters than the store's")
    yield from _copies(shard, manifest, rollouts)


def _copies(shard: Folder, manifest: ShardManifest, rollouts: tuple[RolloutRecord, ...]) -> Iterator[Problem]:
    """Columns that repeat or restate others must agree with them."""
    firsts = np.cumsum([0, *(len(rollout.observations) for rollout in rollouts)]).tolist()
    rows = [InteractionRow(r, i, first) for r, first in zip(rollouts, firsts, strict=False) for i in r.interactions]
    table = reader.read_interactions(shard, manifest)
    added = rollouts[0].dynamics.added
    if added_in(table.column_names) != added:
        yield _problem(shard.key, "the interactions have columns of other hidden parameters than the rollouts")
        return
    restated = {*COPIED_COLUMNS, *hidden_names(added).values(), "observation", "point_camera", "rotation_camera"}
    for column in interaction_columns(added):
        if column.name not in restated:
            continue
        cells, kept = column.gather(rows), column_values(table, column)
        if column.dtype:
            agree = np.allclose(cells.numbers, np.ravel(kept), rtol=0.0, atol=_FRAME_TOLERANCE if column.width else 0.0)
        else:
            agree = list(cells.texts) == kept
        if not agree:
            yield _problem(shard.key, f"column {column.name} does not agree with the columns that it restates")


def _plans_and_policies(store: Store, jobs: Sequence[Job]) -> Iterator[Problem]:
    known, plans = {}, Folder(store.backend, PLANS_FOLDER)
    for name in store.backend.names(PLANS_FOLDER):
        if name.startswith(TEMPORARY_PREFIX):
            continue
        try:
            plan = store.read_plan(name)
            known[plan.key] = plan
        except StoreError as error:
            what = damage(error, partial(store.read_plan, name), plans, name)
            yield _problem(f"{PLANS_FOLDER}/{name}", what, store)
    versions = set(store.policy_versions())
    for version in sorted(versions | {plan.policy_version for plan in known.values()} - {0}):
        folder = f"{POLICIES_FOLDER}/{folder_name(version)}"
        try:
            files = store.read_policy(version)
            for name in store.backend.names(folder):
                if name not in (*files, INDEX_FILE):
                    yield _problem(f"{folder}/{name}", "no file of this policy; remove it")
        except StoreError as error:
            damage(error, partial(store.read_policy, version), Folder(store.backend, folder), INDEX_FILE)
            there = folder_name(version) in store.backend.names(POLICIES_FOLDER)
            if there or not store.backend.exists(lost_policy_key(version)):
                yield _problem(folder, str(error), store, broken=folder if there else "")
    for key in sorted({job.plan_key for job in jobs}):
        if key not in known:
            yield _problem(f"{PLANS_FOLDER}/{key}.json", "shards of this plan exist, but no sound plan", broken="")


def _strangers(store: Store, jobs: Sequence[Job]) -> Iterator[Problem]:
    """Files and folders that the store did not make, and shards that were never committed."""
    ours = {STORE_FILE, PLANS_FOLDER, SHARDS_FOLDER, POLICIES_FOLDER, CRASH_LOG_FOLDER, STATUS_FOLDER, ASIDE_FOLDER}
    passing = (TEMPORARY_PREFIX, LOCK_PREFIX)
    for name in store.backend.names(""):
        if name not in ours and not name.startswith(passing):
            yield _problem(name, "no part of a store; remove it")
    for name in store.backend.names(POLICIES_FOLDER):
        if not re.fullmatch(r"[0-9]{6}", name) and not name.startswith(passing):
            yield _problem(f"{POLICIES_FOLDER}/{name}", "no policy; remove it")
    committed = set(jobs)
    for name in store.backend.names(SHARDS_FOLDER):
        job = parse_shard_id(name)
        if job is None:
            if not name.startswith(passing):
                yield _problem(f"{SHARDS_FOLDER}/{name}", "no shard; remove it")
        elif job not in committed and not store.backend.writes_in_place and not store.holds(job):
            where = f"{SHARDS_FOLDER}/{name}"
            yield _problem(where, "has no manifest, so counts for nothing; collecting again replaces it")


def _strangers_in_shard(shard: Folder, manifest: ShardManifest) -> Iterator[Problem]:
    ours = {f"{shard.key}/{name}" for name in (MANIFEST_FILE, *manifest.files)}
    for key in shard.backend.leaves(shard.key):
        if key not in ours:
            yield _problem(key, "no file of this shard; remove it")


def _overlaps(store: Store, jobs: Sequence[Job]) -> Iterator[Problem]:
    """Shards that hold the same rollout of a plan; one that another holds wholly, and alike, awaits compaction."""
    suspects = list(overlapping(jobs, lambda job: job))
    window, before = Window(), None
    for one, manifest in zip(suspects, reader.read_manifests(store.backend, suspects), strict=True):
        alike = all(twice.alike for twice in window.add(one, manifest.digests, one))
        if before is None or before.plan_key != one.plan_key:
            before = one
            continue
        if one.start < before.stop and not (alike and one.stop <= before.stop):
            where = f"{SHARDS_FOLDER}/{one.shard_id}"
            yield _problem(where, f"holds rollouts that {before.shard_id} holds too; run `adaafford store repair`")
        if one.stop > before.stop:
            before = one


def _problem(where: str, what: str, store: Store | None = None, broken: str | None = None) -> Problem:
    """A problem with what lies at `where`; what an error says of its own place is not said twice."""
    line = what if store is None else what.removeprefix(f"{store.where}/{where}: ")
    return Problem(where, line, where if broken is None else broken)


def lost_policy_key(version: int) -> str:
    """Where a repair notes that a policy is gone, which then is no problem any more."""
    return f"{ASIDE_FOLDER}/lost-policies/{folder_name(version)}.json"
