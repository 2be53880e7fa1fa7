"""Committing shards: all files of one, and its manifest last; the place knows how that is made all or nothing."""

import hashlib
from collections.abc import Collection, Mapping, Sequence

from shared.errors import StoreError
from shared.plan import Job
from shared.records import RolloutRecord
from shared.reproduction import OBJECTS, STORE, reproduction
from shared.store import observations
from shared.store.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS, InteractionRow, RolloutRow
from shared.store.digest import rollout_digest
from shared.store.layout import (
    INTERACTIONS_FILE,
    MANIFEST_FILE,
    MAX_ROWS,
    OBSERVATIONS_FOLDER,
    ROLLOUTS_FILE,
    SHARDS_FOLDER,
    FileEntry,
    Quarantined,
    ShardManifest,
    parse_shard_id,
)
from shared.store.place import Folder, Place, Publication
from shared.store.provenance import process_provenance, software_versions
from shared.store.reader import (
    is_committed,
    read_manifest,
    read_rollouts,
    shard_folder,
)
from shared.store.sealed import seal
from shared.store.tables import table_bytes
from shared.store.validity import check_quarantined, check_rollouts


def commit_shard(
    place: Place,
    job: Job,
    rollouts: Sequence[RolloutRecord],
    points: int,
    provenance: Mapping[str, str],
    quarantined: Sequence[Quarantined],
    supersedes: Collection[str] = (),
    *,
    vetted: bool = False,
) -> ShardManifest:
    """Write a shard and commit it; where another worker was faster, its shard stays and its manifest is returned.

    Args:
        place: of the store.
        job: the rollouts that the shard holds.
        rollouts: in order.
        points: N, of every cloud.
        provenance: what else is known of how they were made, such as seconds by stage.
        quarantined: why rollouts of that status are.
        supersedes: shards whose rollouts this one holds too, and that it may overlap.
        vetted: whether it is known that it overlaps no other, so that this need not be looked for.

    Raises:
        StoreError: a rollout breaks the rules of a record, or the job overlaps another shard of its plan.
    """
    shard = shard_folder(place, job.shard_id)
    if is_committed(shard):
        return read_manifest(shard)
    check_rollouts(rollouts, job, points, job.shard_id)
    check_quarantined(rollouts, quarantined, job.shard_id)
    files = _encode(rollouts, points)

    def admit() -> None:
        if not vetted:
            _refuse_overlap(place, job, supersedes)

    def describe(held: Mapping[str, bytes]) -> bytes:
        manifest = _describe(job, rollouts, held, points, provenance, quarantined)
        if held != files:
            _check_taken_over(shard, manifest)
        return seal(manifest.model_dump(mode="json"))

    place.publish(
        Publication(
            folder=shard.key,
            files=files,
            mark=MANIFEST_FILE,
            describe=describe,
            admit=admit,
            lock=job.plan_key,
        )
    )
    return read_manifest(shard)


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
    """The manifest; no host's name and no path goes into it, also of shards that older software wrote."""
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
        provenance=process_provenance() | {n: str(value) for n, value in provenance.items() if n != "host"},
        quarantined=tuple(
            each.model_copy(update={"command": reproduction(STORE, job.shard_id, OBJECTS, each.rollout)})
            for each in quarantined
        ),
    )


def _check_taken_over(shard: Folder, manifest: ShardManifest) -> None:
    """Files of another attempt at the same job hold the same rollouts, though not the same wall times."""
    digests = tuple(rollout_digest(rollout) for rollout in read_rollouts(shard, manifest))
    if digests != manifest.digests:
        raise StoreError(f"{shard}: files of another attempt lie here, of other content; run `adaafford store repair`")


def _refuse_overlap(place: Place, job: Job, supersedes: Collection[str]) -> None:
    # No shard holds more than MAX_ROWS rollouts, so none that begins earlier reaches the job. From 10^8 rollouts on the
    # order of names is not that of numbers, and an overlap may be left for `verify` to find.
    first = Job(job.plan_key, max(job.start - MAX_ROWS, 0), job.stop).shard_id
    for name in place.names_from(SHARDS_FOLDER, first[: first.rindex("-")]):
        other = parse_shard_id(name)
        if other is None or other == job or name in supersedes:
            continue
        if other.plan_key != job.plan_key or other.start >= job.stop:
            return
        if job.start < other.stop and is_committed(shard_folder(place, name)):
            raise StoreError(f"{job.shard_id}: overlaps the committed shard {name}; plan only missing rollouts")
