"""Commit of shards: all files of a shard, with its manifest last; the storage backend makes this atomic.

The content digest is over the data without times, hosts, versions or shards. Same plan, same seed, same policy: same
digest, whether one worker made the rollouts or a thousand.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from shared.errors import StoreError
from shared.io.documents import with_checksum
from shared.io.text import without_places
from shared.plan import Job, RolloutRecord, RolloutStatus
from shared.store.backends.base import Folder, StorageBackend, Transaction
from shared.store.codecs import observations
from shared.store.codecs.columns import (
    INTERACTION_COLUMNS,
    Column,
    InteractionRow,
    RolloutRow,
    interaction_columns,
    rollout_columns,
)
from shared.store.codecs.observations import Packed, pack
from shared.store.codecs.tables import table_bytes
from shared.store.coverage import Part
from shared.store.layout import (
    INTERACTIONS_FILE,
    MANIFEST_FILE,
    MAX_ROWS,
    OBJECTS,
    OBSERVATIONS_FOLDER,
    ROLLOUTS_FILE,
    SHARDS_FOLDER,
    STORE,
    Quarantined,
    ShardManifest,
    file_entries,
    parse_manifest,
    parse_shard_id,
    reproduction,
    schema_version,
)
from shared.store.provenance import process_provenance, store_software
from shared.store.reader import is_committed, read_files, read_manifest, read_rollouts, shard_folder, unknown_of
from shared.store.validity import check_quarantined, check_rollouts

Row = TypeVar("Row")


def rollout_digest(rollout: RolloutRecord, clouds: Sequence[Packed] | None = None) -> str:
    """SHA-256 of one rollout, over the canonical little-endian bytes of its columns and clouds.

    Args:
        rollout: the rollout.
        clouds: its observations as `observations.pack` makes them, where somebody has them.
    """
    digest = hashlib.sha256()
    if rollout.status is RolloutStatus.NEVER_AT_REST:
        # Earlier software did not tell the two apart; the same plan shall have the digest that it had.
        rollout = replace(rollout, status=RolloutStatus.NOTHING_TO_ACT_ON)
    _add_columns(digest, rollout_columns(rollout.dynamics.added), [RolloutRow(rollout, 0)])
    if rollout.arm_base:
        # Not every store has it, and those without keep their digests.
        _add(digest, "arm_base", [len(rollout.arm_base)], np.array(rollout.arm_base, "<f8").tobytes())
    rows = [InteractionRow(rollout, interaction, 0) for interaction in rollout.interactions]
    _add_columns(digest, INTERACTION_COLUMNS, rows)
    for cloud in map(pack, rollout.observations) if clouds is None else clouds:
        for name, packed in cloud.items():
            _add(digest, name, packed.shape, packed.tobytes())
    return digest.hexdigest()


def combined_digest(digests: Iterable[tuple[str, int, str]]) -> str:
    """SHA-256 of many rollouts, given as plan key, number within the plan and digest, in this order."""
    digest = hashlib.sha256()
    for plan_key, index, one in digests:
        digest.update(f"{plan_key} {index} {one}\n".encode())
    return digest.hexdigest()


def _add_columns(digest: Any, columns: Sequence[Column[Row]], rows: Sequence[Row]) -> None:
    for column in columns:
        if column.content:
            cells = column.gather(rows)
            # Lengths and texts are framed as JSON, so that no two columns of cells give the same bytes.
            frame = (len(rows), cells.lengths, cells.texts)
            _add(digest, column.name, frame, np.ascontiguousarray(cells.numbers).tobytes())


def _add(digest: Any, name: str, frame: Sequence[Any], data: bytes) -> None:
    digest.update(json.dumps([name, frame, len(data)], separators=(",", ":")).encode())
    digest.update(data)


@dataclass(frozen=True, slots=True)
class Unknown:
    """Columns and fields that newer software wrote, which are kept unchanged.

    Attributes:
        tables: unknown columns of the shard's two tables, by file (see `tables.unknown_columns`).
        fields: unknown fields of the manifest.
    """

    tables: Mapping[str, Any]
    fields: Mapping[str, Any]


def commit_shard(
    backend: StorageBackend,
    job: Job,
    rollouts: Sequence[RolloutRecord],
    points: int,
    provenance: Mapping[str, str],
    quarantined: Sequence[Quarantined],
    *,
    vetted: bool = False,
    unknown: Unknown | None = None,
) -> ShardManifest:
    """Write and commit a shard; if another worker has committed it, return the manifest of that shard.

    Args:
        backend: of the store.
        job: the range of rollouts.
        rollouts: all rollouts of the job, in order.
        points: N, of every cloud.
        provenance: further facts about their origin, such as seconds by stage.
        quarantined: the reasons of quarantined rollouts.
        vetted: whether the caller has checked that the job overlaps no other shard, or allows an overlap.
        unknown: columns and fields of newer software.

    Raises:
        StoreError: a rollout breaks the rules of a record, or the job overlaps another shard of its plan.
    """
    shard = shard_folder(backend, job.shard_id)
    if is_committed(shard):
        return read_manifest(shard)
    check_rollouts(rollouts, job, points, job.shard_id)
    check_quarantined(rollouts, quarantined, job.shard_id)
    unknown = unknown or Unknown({}, {})
    clouds = [[observations.pack(observation) for observation in rollout.observations] for rollout in rollouts]
    pixels = observations.depth_size(observation for rollout in rollouts for observation in rollout.observations)
    files = _encode(rollouts, clouds, points, pixels, unknown.tables)
    manifest = ShardManifest(
        schema_version=schema_version(rollouts[0].dynamics.added, pixels > 0, any(each.arm_base for each in rollouts)),
        plan_key=job.plan_key,
        start=job.start,
        stop=job.stop,
        interactions=sum(len(rollout.interactions) for rollout in rollouts),
        observations=sum(len(rollout.observations) for rollout in rollouts),
        points=points,
        depth_size=pixels,
        files=file_entries(files),
        digests=tuple(map(rollout_digest, rollouts, clouds)),
        software=store_software(),
        provenance=process_provenance() | {name: str(value) for name, value in provenance.items()},
        quarantined=tuple(quarantined),
    )
    described = manifest.as_document() | dict(unknown.fields)
    _publish(backend, parse_manifest(with_checksum(described), str(shard)), files, vetted=vetted)
    return read_manifest(shard)


def commit_part(backend: StorageBackend, source: Folder, manifest: ShardManifest, part: Part, note: str) -> None:
    """Commit some of a shard's rollouts as a shard of their own, in the same store or in another.

    Args:
        backend: of the store that gets them.
        source: the shard.
        manifest: of the source.
        part: which rollouts.
        note: what the provenance calls the shard that they are from.

    Raises:
        StoreError: the source is damaged.
    """
    commit_shard(
        backend,
        part.job,
        read_rollouts(source, manifest)[part.start - manifest.start : part.stop - manifest.start],
        manifest.points,
        manifest.provenance | {note: manifest.shard_id},
        [each for each in manifest.quarantined if part.start <= each.rollout < part.stop],
        vetted=True,
        unknown=Unknown({file: part.of(table) for file, table in unknown_of(source, manifest).items()}, manifest.more),
    )


def copy_shard(source: Folder, manifest: ShardManifest, backend: StorageBackend) -> None:
    """Commit a copy of a shard of another store: its files byte by byte, and its manifest with unknown fields.

    Args:
        source: the shard.
        manifest: its manifest.
        backend: of the target store, which has none of its rollouts, except in a shard with this name.

    Raises:
        StoreError: the shard is damaged.
    """
    if is_committed(shard_folder(backend, manifest.shard_id)):
        return
    if tuple(map(rollout_digest, read_rollouts(source, manifest))) != manifest.digests:
        raise StoreError(f"{source}: its rollouts are not those of its manifest; run `adaafford store verify`")
    _publish(backend, manifest, read_files(source, manifest), vetted=True)


def _publish(backend: StorageBackend, manifest: ShardManifest, files: Mapping[str, bytes], *, vetted: bool) -> None:
    manifest = _without_places(manifest)
    shard = shard_folder(backend, manifest.shard_id)

    def check() -> None:
        if not vetted:
            _refuse_overlap(backend, manifest.job)

    def describe(held: Mapping[str, bytes]) -> bytes:
        described = manifest
        if held != files:
            described = manifest.model_copy(update={"files": file_entries(held)})
            _check_taken_over(shard, described)
        return with_checksum(described.as_document())

    backend.publish(Transaction(shard.key, files, MANIFEST_FILE, describe, check, lock=manifest.plan_key))


def _without_places(manifest: ShardManifest) -> ShardManifest:
    """The manifest without host name and paths, which manifests of older software have."""
    provenance = {name: value for name, value in manifest.provenance.items() if name != "host"}
    quarantined = tuple(
        each.model_copy(
            update={
                "reason": without_places(each.reason),
                "command": reproduction(STORE, manifest.shard_id, OBJECTS, each.rollout),
            }
        )
        for each in manifest.quarantined
    )
    return manifest.model_copy(update={"provenance": provenance, "quarantined": quarantined})


def _encode(
    rollouts: Sequence[RolloutRecord],
    clouds: Sequence[Sequence[observations.Packed]],
    points: int,
    pixels: int,
    unknown: Mapping[str, Any],
) -> dict[str, bytes]:
    """All files of a shard but its manifest, by path within it; `clouds` are the observations of each rollout."""
    rollout_rows, interaction_rows, first = [], [], 0
    for rollout in rollouts:
        rollout_rows.append(RolloutRow(rollout, first))
        interaction_rows += [InteractionRow(rollout, interaction, first) for interaction in rollout.interactions]
        first += len(rollout.observations)
    added = rollouts[0].dynamics.added
    group = observations.encode([cloud for of_rollout in clouds for cloud in of_rollout], points, pixels)
    return {
        ROLLOUTS_FILE: table_bytes(rollout_columns(added), rollout_rows, unknown.get(ROLLOUTS_FILE)),
        INTERACTIONS_FILE: table_bytes(interaction_columns(added), interaction_rows, unknown.get(INTERACTIONS_FILE)),
        **{f"{OBSERVATIONS_FOLDER}/{name}": data for name, data in group.items()},
    }


def _check_taken_over(shard: Folder, manifest: ShardManifest) -> None:
    """Check that files of another attempt have the same rollouts; their wall times differ."""
    digests = tuple(rollout_digest(rollout) for rollout in read_rollouts(shard, manifest))
    if digests != manifest.digests:
        raise StoreError(f"{shard}: has files of another attempt with other content; run `adaafford store repair`")


def _refuse_overlap(backend: StorageBackend, job: Job) -> None:
    # No shard holds more than MAX_ROWS rollouts, so none that begins earlier reaches the job. From 10^8 rollouts on the
    # order of names is not that of numbers, and an overlap may be left for `verify` to find.
    first = Job(job.plan_key, max(job.start - MAX_ROWS, 0), job.stop).shard_id
    for name in backend.names_from(SHARDS_FOLDER, first[: first.rindex("-")]):
        other = parse_shard_id(name)
        if other is None or other == job:
            continue
        if other.plan_key != job.plan_key or other.start >= job.stop:
            return
        if job.start < other.stop and is_committed(shard_folder(backend, name)):
            raise StoreError(f"{job.shard_id}: overlaps the committed shard {name}; plan only missing rollouts")
