"""Verification: everything that a store claims, recomputed from its bytes."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shared.errors import StoreError
from shared.files import TEMPORARY_PREFIX
from shared.records import RolloutRecord
from shared.store import reader
from shared.store.columns import COPIED_COLUMNS, INTERACTION_COLUMNS, InteractionRow
from shared.store.digest import rollout_digest
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
from shared.store.place import Folder
from shared.store.policies import INDEX_FILE, folder_name
from shared.store.store import Store
from shared.store.tables import column_values
from shared.underway import UNDERWAY_FOLDER

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

    Args:
        store: which one.
        progress: called after each shard with how many are done and how many there are.
    """
    shards = reader.committed_shards(store.place)
    problems = [*_plans_and_policies(store, shards), *_strangers(store, shards)]
    sound = []
    for done, shard in enumerate(shards, 1):
        try:
            manifest = reader.read_manifest(shard)
            sound.append(manifest)
            problems += _shard(store, shard, manifest)
        except StoreError as error:
            problems.append(_problem(shard.key, str(error), store))
        if progress is not None:
            progress(done, len(shards))
    return problems + list(_overlaps(sound))


def _shard(store: Store, shard: Folder, manifest: ShardManifest) -> Iterator[Problem]:
    """Problems of one shard; the first damaged file of it hides later checks."""
    yield from _strangers_in_shard(shard, manifest)
    damaged = False
    for name in manifest.files:
        try:
            reader.read_file(shard, manifest, name)
        except StoreError as error:
            damaged = True
            yield _problem(f"{shard.key}/{name}", str(error), store, broken=shard.key)
    if damaged:
        return
    rollouts = reader.read_rollouts(shard, manifest)
    for rollout, digest in zip(rollouts, manifest.digests, strict=True):
        if rollout_digest(rollout) != digest:
            yield _problem(shard.key, f"rollout {rollout.index} is not the one whose digest the manifest states")
    known = set(store.setting.objects)
    for rollout in rollouts:
        if rollout.object not in known or rollout.seed != store.setting.seed:
            yield _problem(shard.key, f"rollout {rollout.index} is of another object or seed than the store's")
    yield from _copies(shard, manifest, rollouts)


def _copies(shard: Folder, manifest: ShardManifest, rollouts: tuple[RolloutRecord, ...]) -> Iterator[Problem]:
    """Columns that repeat or restate others must agree with them."""
    firsts = np.cumsum([0, *(len(rollout.observations) for rollout in rollouts)]).tolist()
    rows = [InteractionRow(r, i, first) for r, first in zip(rollouts, firsts, strict=False) for i in r.interactions]
    table = reader.read_interactions(shard, manifest)
    for column in INTERACTION_COLUMNS:
        if column.name not in (*COPIED_COLUMNS, "observation", "point_camera", "rotation_camera"):
            continue
        cells, kept = column.gather(rows), column_values(table, column)
        if column.dtype:
            agree = np.allclose(cells.numbers, np.ravel(kept), rtol=0.0, atol=_FRAME_TOLERANCE if column.width else 0.0)
        else:
            agree = list(cells.texts) == kept
        if not agree:
            yield _problem(shard.key, f"column {column.name} does not agree with the columns that it restates")


def _plans_and_policies(store: Store, shards: Sequence[Folder]) -> Iterator[Problem]:
    known = {}
    for name in store.place.names(PLANS_FOLDER):
        if name.startswith(TEMPORARY_PREFIX):
            continue
        try:
            plan = store.read_plan(name)
            known[plan.key] = plan
        except StoreError as error:
            yield _problem(f"{PLANS_FOLDER}/{name}", str(error), store)
    versions = set(store.policy_versions())
    for version in sorted(versions | {plan.policy_version for plan in known.values()} - {0}):
        folder = f"{POLICIES_FOLDER}/{folder_name(version)}"
        try:
            files = store.read_policy(version)
            for name in store.place.names(folder):
                if name not in (*files, INDEX_FILE):
                    yield _problem(f"{folder}/{name}", "no file of this policy; remove it")
        except StoreError as error:
            there = folder_name(version) in store.place.names(POLICIES_FOLDER)
            if there or not store.place.exists(lost_policy_key(version)):
                yield _problem(folder, str(error), store, broken=folder if there else "")
    for key in sorted({shard.name.rsplit("-", 2)[0] for shard in shards}):
        if key not in known:
            yield _problem(f"{PLANS_FOLDER}/{key}.json", "shards of this plan exist, but no sound plan", broken="")


def _strangers(store: Store, shards: Sequence[Folder]) -> Iterator[Problem]:
    """Files and folders that the store did not make, and shards that were never committed."""
    ours = {STORE_FILE, PLANS_FOLDER, SHARDS_FOLDER, POLICIES_FOLDER, UNDERWAY_FOLDER, STATUS_FOLDER, ASIDE_FOLDER}
    passing = (TEMPORARY_PREFIX, LOCK_PREFIX)
    for name in store.place.names(""):
        if name not in ours and not name.startswith(passing):
            yield _problem(name, "no part of a store; remove it")
    for name in store.place.names(POLICIES_FOLDER):
        if not re.fullmatch(r"[0-9]{6}", name) and not name.startswith(passing):
            yield _problem(f"{POLICIES_FOLDER}/{name}", "no policy; remove it")
    committed = {shard.name for shard in shards}
    for name in store.place.names(SHARDS_FOLDER):
        if parse_shard_id(name) is None:
            if not name.startswith(passing):
                yield _problem(f"{SHARDS_FOLDER}/{name}", "no shard; remove it")
        elif name not in committed and not store.place.writes_in_place:
            where = f"{SHARDS_FOLDER}/{name}"
            yield _problem(where, "has no manifest, so counts for nothing; collecting again replaces it")


def _strangers_in_shard(shard: Folder, manifest: ShardManifest) -> Iterator[Problem]:
    ours = {f"{shard.key}/{name}" for name in (MANIFEST_FILE, *manifest.files)}
    for key in shard.place.leaves(shard.key):
        if key not in ours:
            yield _problem(key, "no file of this shard; remove it")


def _overlaps(manifests: Sequence[ShardManifest]) -> Iterator[Problem]:
    """Shards that hold the same rollout of a plan; one that another holds wholly, and alike, awaits compaction."""
    digests: dict[tuple[str, int], tuple[str, ShardManifest]] = {}
    reach: dict[str, ShardManifest] = {}
    for one in sorted(manifests, key=lambda m: (m.plan_key, m.start, -m.stop)):
        before = reach.get(one.plan_key)
        if before is None or one.stop > before.stop:
            reach[one.plan_key] = one
        alike = all(
            digests.setdefault((one.plan_key, index), (digest, one))[0] == digest
            for index, digest in enumerate(one.digests, one.start)
        )
        if before is not None and one.start < before.stop and not (alike and one.stop <= before.stop):
            where = f"{SHARDS_FOLDER}/{one.shard_id}"
            yield _problem(where, f"holds rollouts that {before.shard_id} holds too; run `adaafford store repair`")


def _problem(where: str, what: str, store: Store | None = None, broken: str | None = None) -> Problem:
    """A problem with what lies at `where`; what an error says of its own place is not said twice."""
    line = what if store is None else what.removeprefix(f"{store.where}/{where}: ")
    return Problem(where, line, where if broken is None else broken)


def lost_policy_key(version: int) -> str:
    """Where a repair notes that a policy is gone, which then is no problem any more."""
    return f"{ASIDE_FOLDER}/lost-policies/{folder_name(version)}.json"
