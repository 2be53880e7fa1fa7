"""Compaction: adjacent small shards become large ones, which cost less to list and to open; and its reverse, reopening.

What is new is committed first, then what it replaces is set aside, so that a crash at any moment loses nothing; as long
as both are there, readers take each rollout from the larger shard (see `shared.store.coverage`). The digest stays.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from shared.errors import StoreError, UsageError
from shared.plan import Job, RolloutStatus, missing_ranges
from shared.store import reader
from shared.store.codecs.tables import joined
from shared.store.coverage import Part, Window, order, overlapping, parts_of
from shared.store.layout import MAX_ALL_PIXELS, MAX_ALL_POINTS, MAX_ROWS, SHARDS_FOLDER, ShardManifest
from shared.store.maintenance.repair import set_aside
from shared.store.presence import alone
from shared.store.store import Store
from shared.store.writer import Unknown, commit_part, commit_shard


@dataclass(frozen=True, slots=True)
class Compaction:
    """What a compaction did."""

    before: int
    """Shards."""
    after: int
    made: tuple[str, ...]
    """Shards."""
    set_aside: tuple[str, ...]
    """Keys as they were."""


def compact(store: Store, most: int, progress: Callable[[int, int], None] | None = None) -> Compaction:
    """Merge adjacent shards of a plan, up to a number of rollouts; called again, it has nothing left to do.

    Args:
        store: nobody may collect into it meanwhile, and readers should begin anew afterwards.
        most: rollouts of a shard.
        progress: called with how many of the shards are done, and how many there are.

    Raises:
        UsageError: a driver or a worker is at work on the store, or `most` is not allowed.
        StoreError: a shard is damaged, or shards overlap that no compaction has left.
    """
    if not 2 <= most <= MAX_ROWS:
        raise UsageError(f"--rollouts {most} is not allowed; choose 2 to {MAX_ROWS}")
    with alone(store.backend):
        store.sweep()
        jobs = store.jobs()
        counting = _counting(jobs)
        # What an earlier compaction was killed before it could set aside.
        spare = sorted(set(jobs) - set(counting), key=order)
        _check_alike(store, jobs)
        aside = [_retire(store, job) for job in spare]
        made, after = [], 0
        for done, group in _groups(reader.read_manifests(store.backend, counting), most):
            after += 1
            if len(group) > 1:
                made.append(_merge(store, group).shard_id)
                aside += [_retire(store, manifest.job) for manifest in group]
            if progress is not None:
                progress(done, len(counting))
    return Compaction(len(jobs), after, tuple(made), tuple(aside))


def _counting(jobs: Sequence[Job]) -> list[Job]:
    """The shards that count wholly; the others must be held by these."""
    parts = parts_of(jobs)
    odd = next((part.shard.shard_id for part in parts if not part.is_whole), None)
    if odd is not None:
        raise StoreError(f"{odd}: overlaps another shard; run `adaafford store repair`")
    return [part.shard for part in parts]


def _check_alike(store: Store, jobs: Sequence[Job]) -> None:
    """Hold shards that hold the same rollouts to each other."""
    suspects, window = list(overlapping(jobs, lambda job: job)), Window()
    for job, manifest in zip(suspects, reader.read_manifests(store.backend, suspects), strict=True):
        if any(not twice.alike for twice in window.add(job, manifest.digests, job)):
            raise StoreError(f"{job.shard_id}: another shard says otherwise; run `adaafford store repair`")


def _groups(manifests: Iterable[ShardManifest], most: int) -> Iterator[tuple[int, list[ShardManifest]]]:
    """Runs of adjacent shards that fit into one, from the left, each with how many shards there were up to its end."""
    group: list[ShardManifest] = []
    done = 0
    for manifest in manifests:
        if group and not _fits([*group, manifest], most):
            yield done, group
            group = []
        group.append(manifest)
        done += 1
    if group:
        yield done, group


def _fits(group: Sequence[ShardManifest], most: int) -> bool:
    last, new = group[-2:]
    clouds = sum(manifest.observations for manifest in group)
    return (
        (last.plan_key, last.stop, last.points, last.more) == (new.plan_key, new.start, new.points, new.more)
        and new.stop - group[0].start <= most
        and (not last.observations or not new.observations or last.depth_size == new.depth_size)
        and clouds * new.points <= MAX_ALL_POINTS
        and clouds * max(manifest.depth_size for manifest in group) ** 2 <= MAX_ALL_PIXELS
        and max(clouds, sum(manifest.interactions for manifest in group)) <= MAX_ROWS
    )


def _merge(store: Store, group: Sequence[ShardManifest]) -> ShardManifest:
    """Commit one shard of what a run of them holds."""
    job = Job(group[0].plan_key, group[0].start, group[-1].stop)
    shards = [reader.shard_folder(store.backend, manifest.shard_id) for manifest in group]
    rollouts = [rollout for pair in zip(shards, group, strict=True) for rollout in reader.read_rollouts(*pair)]
    tables = [reader.unknown_of(shard, manifest) for shard, manifest in zip(shards, group, strict=True)]
    whole = commit_shard(
        store.backend,
        job,
        rollouts,
        group[0].points,
        {"compacted_from": str(len(group))},
        [each for manifest in group for each in manifest.quarantined],
        vetted=True,
        unknown=Unknown(
            {file: joined([table[file] for table in tables], job.shard_id) for file in tables[0]},
            group[0].more,
        ),
    )
    if whole.digests != tuple(digest for manifest in group for digest in manifest.digests):
        raise StoreError(f"{whole.shard_id}: came out otherwise than its parts; run `adaafford store verify`")
    return whole


def _retire(store: Store, job: Job) -> str:
    key = f"{SHARDS_FOLDER}/{job.shard_id}"
    set_aside(store.backend, key)
    return key


def reopen_quarantined(store: Store, plan_keys: Sequence[str]) -> int:
    """Take the quarantined rollouts of some plans out of their shards, so that they count as missing; returns how many.

    What else such a shard holds is committed in shards of its own, before and after each such rollout.

    Raises:
        StoreError: a shard is damaged.
    """
    count = 0
    for part in [part for key in plan_keys for part in store.parts(key)]:
        manifest = store.manifest(part.shard)
        if not manifest.quarantined:
            continue
        shard, rollouts = reader.shard_folder(store.backend, manifest.shard_id), store.read_rollouts(manifest.shard_id)
        wanted = {rollout.index for rollout in rollouts if rollout.status is RolloutStatus.QUARANTINED}
        left = missing_ranges(manifest.stop, [(0, manifest.start), *((number, number + 1) for number in wanted)])
        kept = [Job(manifest.plan_key, *ends) for ends in left]
        # What a compaction has not set aside yet holds these rollouts as well.
        old = [job for job in store.jobs(manifest.plan_key) if job.start < manifest.stop and manifest.start < job.stop]
        for job in kept:
            commit_part(store.backend, shard, manifest, Part(manifest.job, job.start, job.stop), "split_from")
        for job in sorted(set(old) - set(kept), key=lambda job: job.stop - job.start):
            set_aside(store.backend, f"{SHARDS_FOLDER}/{job.shard_id}")
        count += len(wanted)
    return count
