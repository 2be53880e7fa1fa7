"""Verification: everything that a store claims, recomputed from its bytes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from shared.errors import StoreError
from shared.files import TEMPORARY_PREFIX
from shared.records import RolloutRecord
from shared.store import reader
from shared.store.columns import COPIED_COLUMNS, INTERACTION_COLUMNS, InteractionRow
from shared.store.digest import rollout_digest
from shared.store.layout import (
    LOCK_PREFIX,
    MANIFEST_FILE,
    PLANS_FOLDER,
    POLICIES_FOLDER,
    SHARDS_FOLDER,
    STORE_FILE,
    UNDERWAY_FOLDER,
    ShardManifest,
    parse_shard_id,
)
from shared.store.policies import INDEX_FILE, folder_name
from shared.store.store import Store
from shared.store.tables import column_values

_FRAME_TOLERANCE = 1e-9
"""Camera-frame columns were computed by a matrix product, whose last bits depend on the machine."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that is not as it should be."""

    where: str
    """Path within the store."""
    what: str
    """One line."""


def verify(store: Store, progress: Callable[[int, int], None] | None = None) -> list[Problem]:
    """All problems of a store; none for a sound one.

    Args:
        store: which one.
        progress: called after each shard with how many are done and how many there are.
    """
    problems = [*_plans_and_policies(store), *_strangers(store)]
    shards = list(reader.committed_shards(store.shards_folder))
    sound = []
    for done, shard in enumerate(shards, 1):
        try:
            manifest = reader.read_manifest(shard)
            sound.append(manifest)
            problems += _shard(store, shard, manifest)
        except StoreError as error:
            problems.append(_problem(store, shard, str(error)))
        if progress is not None:
            progress(done, len(shards))
    return problems + list(_overlaps(store, sound))


def _shard(store: Store, shard: Path, manifest: ShardManifest) -> Iterator[Problem]:
    """Problems of one shard; the first damaged file of it hides later checks."""
    yield from _strangers_in_shard(store, shard, manifest)
    damaged = False
    for name in manifest.files:
        try:
            reader.read_file(shard, manifest, name)
        except StoreError as error:
            damaged = True
            yield _problem(store, shard / name, str(error))
    if damaged:
        return
    rollouts = reader.read_rollouts(shard, manifest)
    for rollout, digest in zip(rollouts, manifest.digests, strict=True):
        if rollout_digest(rollout) != digest:
            yield _problem(store, shard, f"rollout {rollout.index} is not the one whose digest the manifest states")
    known = set(store.setting.objects)
    for rollout in rollouts:
        if rollout.object not in known or rollout.seed != store.setting.seed:
            yield _problem(store, shard, f"rollout {rollout.index} is of another object or seed than the store's")
    yield from _copies(store, shard, manifest, rollouts)


def _copies(
    store: Store, shard: Path, manifest: ShardManifest, rollouts: tuple[RolloutRecord, ...]
) -> Iterator[Problem]:
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
            yield _problem(store, shard, f"column {column.name} does not agree with the columns that it restates")


def _plans_and_policies(store: Store) -> Iterator[Problem]:
    plans = store.path / PLANS_FOLDER
    known = {}
    for file in sorted(plans.iterdir()) if plans.is_dir() else []:
        if file.name.startswith(TEMPORARY_PREFIX):
            continue
        try:
            plan = store.read_plan(file)
            known[plan.key] = plan
        except StoreError as error:
            yield _problem(store, file, str(error))
    versions = set(store.policy_versions())
    for version in sorted(versions | {plan.policy_version for plan in known.values()} - {0}):
        folder = store.policies_folder / folder_name(version)
        try:
            files = store.read_policy(version)
            for entry in folder.iterdir():
                if entry.name not in (*files, INDEX_FILE):
                    yield _problem(store, entry, "no file of this policy; remove it")
        except StoreError as error:
            yield _problem(store, folder, str(error))
    for key in sorted({shard.name.rsplit("-", 2)[0] for shard in reader.committed_shards(store.shards_folder)}):
        if key not in known:
            yield _problem(store, plans / f"{key}.json", "shards of this plan exist, but no sound plan")


def _strangers(store: Store) -> Iterator[Problem]:
    """Files and folders that the store did not make, and shards that were never committed."""
    ours = {STORE_FILE, PLANS_FOLDER, SHARDS_FOLDER, POLICIES_FOLDER, UNDERWAY_FOLDER}
    passing = (TEMPORARY_PREFIX, LOCK_PREFIX)
    for entry in sorted(store.path.iterdir()):
        if entry.name not in ours and not entry.name.startswith(passing):
            yield _problem(store, entry, "no part of a store; remove it")
    versions = {folder_name(version) for version in store.policy_versions()}
    for entry in sorted(store.policies_folder.iterdir()) if store.policies_folder.is_dir() else []:
        if entry.name not in versions and not entry.name.startswith(passing):
            yield _problem(store, entry, "no policy; remove it")
    for entry in sorted(store.shards_folder.iterdir()) if store.shards_folder.is_dir() else []:
        if parse_shard_id(entry.name) is None:
            if not entry.name.startswith(passing):
                yield _problem(store, entry, "no shard; remove it")
        elif not reader.is_committed(entry):
            yield _problem(store, entry, "has no manifest, so counts for nothing; collecting again replaces it")


def _strangers_in_shard(store: Store, shard: Path, manifest: ShardManifest) -> Iterator[Problem]:
    ours = {MANIFEST_FILE, *manifest.files}
    folders = {str(parent) for name in ours for parent in Path(name).parents}
    for entry in sorted(shard.rglob("*")):
        if str(entry.relative_to(shard)) not in ours | folders:
            yield _problem(store, entry, "no file of this shard; remove it")


def _overlaps(store: Store, manifests: list[ShardManifest]) -> Iterator[Problem]:
    """Shards that hold the same rollout of a plan: its rows would count twice."""
    for one, next_one in pairwise(sorted(manifests, key=lambda m: (m.plan_key, m.start, m.stop))):
        if one.plan_key == next_one.plan_key and next_one.start < one.stop:
            where = store.shards_folder / next_one.shard_id
            yield _problem(store, where, f"holds rollouts that {one.shard_id} holds too; remove one of the two")


def _problem(store: Store, path: Path, what: str) -> Problem:
    return Problem(str(path.relative_to(store.path)), what.removeprefix(f"{path}: "))
