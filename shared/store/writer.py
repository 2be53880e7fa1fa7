"""Committing shards: written beside, forced to the disk, manifest last, renamed into place."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from shared.errors import StoreError
from shared.files import exclusive_lock, remove_tree, sync_folder, temporary_name, write_durably
from shared.plan import Job
from shared.records import RolloutRecord
from shared.store import observations
from shared.store.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS, InteractionRow, RolloutRow
from shared.store.digest import rollout_digest
from shared.store.layout import (
    INTERACTIONS_FILE,
    LOCK_PREFIX,
    MANIFEST_FILE,
    OBSERVATIONS_FOLDER,
    ROLLOUTS_FILE,
    FileEntry,
    Quarantined,
    ShardManifest,
    parse_shard_id,
)
from shared.store.provenance import process_provenance, software_versions
from shared.store.reader import is_committed, read_manifest
from shared.store.sealed import seal
from shared.store.tables import table_bytes
from shared.store.validity import check_rollouts

_LOCK_WAIT_S = 60.0
"""Locks are held for milliseconds; one that lasts longer means a hung disk."""


def commit_shard(
    shards: Path,
    job: Job,
    rollouts: Sequence[RolloutRecord],
    points: int,
    provenance: Mapping[str, str],
    quarantined: Sequence[Quarantined],
) -> ShardManifest:
    """Write a shard and commit it; where another worker was faster, its shard stays and its manifest is returned.

    Args:
        shards: the folder of shards.
        job: the rollouts that the shard holds.
        rollouts: in order.
        points: N, of every cloud.
        provenance: what else is known of how they were made, such as seconds by stage.
        quarantined: why rollouts of that status are.

    Raises:
        StoreError: a rollout breaks the rules of a record, or the job overlaps another shard of its plan.
    """
    final = shards / job.shard_id
    if is_committed(final):
        return read_manifest(final)
    check_rollouts(rollouts, job, points, job.shard_id)
    files = _encode(rollouts, points)
    manifest = _describe(job, rollouts, files, points, provenance, quarantined)
    shards.mkdir(exist_ok=True)
    temporary = shards / temporary_name(job.shard_id)
    try:
        _write_files(temporary, files, seal(manifest.model_dump(mode="json")))
        return manifest if _move_into_place(temporary, job) else read_manifest(final)
    finally:
        # After success this name is gone; after a lost race, or an error, what lies here is of no use.
        remove_tree(temporary)


def _encode(rollouts: Sequence[RolloutRecord], points: int) -> dict[str, bytes]:
    """All files of a shard but its manifest, by path within it."""
    rollout_rows, interaction_rows, first = [], [], 0
    for rollout in rollouts:
        rollout_rows.append(RolloutRow(rollout, first))
        interaction_rows += [InteractionRow(rollout, interaction, first) for interaction in rollout.interactions]
        first += len(rollout.observations)
    clouds = observations.encode([o for rollout in rollouts for o in rollout.observations], points)
    return {
        ROLLOUTS_FILE: table_bytes(ROLLOUT_COLUMNS, rollout_rows),
        INTERACTIONS_FILE: table_bytes(INTERACTION_COLUMNS, interaction_rows),
        **{f"{OBSERVATIONS_FOLDER}/{name}": data for name, data in clouds.items()},
    }


def _describe(
    job: Job,
    rollouts: Sequence[RolloutRecord],
    files: Mapping[str, bytes],
    points: int,
    provenance: Mapping[str, str],
    quarantined: Sequence[Quarantined],
) -> ShardManifest:
    return ShardManifest(
        plan_key=job.plan_key,
        start=job.start,
        stop=job.stop,
        interactions=sum(len(rollout.interactions) for rollout in rollouts),
        observations=sum(len(rollout.observations) for rollout in rollouts),
        points=points,
        files={n: FileEntry(size=len(data), sha256=hashlib.sha256(data).hexdigest()) for n, data in files.items()},
        digests=tuple(rollout_digest(rollout) for rollout in rollouts),
        software=software_versions(),
        provenance=process_provenance() | {name: str(value) for name, value in provenance.items()},
        quarantined=tuple(quarantined),
    )


def _write_files(folder: Path, files: Mapping[str, bytes], manifest: bytes) -> None:
    folder.mkdir()
    folders = {folder}
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, data)
        folders |= {parent for parent in path.parents if parent.is_relative_to(folder)}
    for parent in sorted(folders, reverse=True):
        sync_folder(parent)
    write_durably(folder / MANIFEST_FILE, manifest)
    sync_folder(folder)


def _move_into_place(temporary: Path, job: Job) -> bool:
    """Rename a finished shard to its name; False where a committed one has it already.

    Raises:
        StoreError: another shard of the plan holds some of the same rollouts.
    """
    shards, final = temporary.parent, temporary.parent / job.shard_id
    # The lock makes one step of looking for overlaps and remnants and of renaming; the data were written without it.
    with exclusive_lock(shards / f"{LOCK_PREFIX}{job.plan_key}", _LOCK_WAIT_S):
        if is_committed(final):
            return False
        _refuse_overlap(shards, job)
        if final.exists():
            # An uncommitted folder of this name: half a copy, say. Set aside under a name that a sweep may remove.
            remnant = shards / temporary_name(job.shard_id)
            final.rename(remnant)
            remove_tree(remnant)
        temporary.rename(final)
        sync_folder(shards)
    return True


def _refuse_overlap(shards: Path, job: Job) -> None:
    for path in shards.iterdir():
        other = parse_shard_id(path.name)
        if other is None or other == job or other.plan_key != job.plan_key or not is_committed(path):
            continue
        if other.start < job.stop and job.start < other.stop:
            raise StoreError(f"{job.shard_id}: overlaps the committed shard {path.name}; plan only missing rollouts")
