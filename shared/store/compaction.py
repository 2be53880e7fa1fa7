"""Compaction: adjacent small shards become large ones, which cost less to list and to open. The digest stays.

The large shard is committed first, then the small ones are set aside, so that a crash at any moment loses nothing; as
long as both are there, readers take each rollout from the large one (see `shared.store.coverage`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from shared.errors import StoreError, UsageError
from shared.plan import Job
from shared.store import reader
from shared.store.coverage import parts_of
from shared.store.layout import MAX_ALL_POINTS, MAX_ROWS, SHARDS_FOLDER, ShardManifest
from shared.store.repair import set_aside
from shared.store.store import Store
from shared.store.writer import commit_shard


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
        progress: called after each shard that is made, with how many are done and how many there are.

    Raises:
        UsageError: a driver is at work on the store, or `most` is not allowed.
        StoreError: a shard is damaged, or shards overlap that no compaction has left.
    """
    if not 2 <= most <= MAX_ROWS:
        raise UsageError(f"--rollouts {most} is not allowed; choose 2 to {MAX_ROWS}")
    with store.only_driver():
        manifests = reader.read_manifests(reader.committed_shards(store.place))
        counting = _counting(manifests)
        # What an earlier compaction was killed before it could set aside.
        aside = [_retire(store, m) for m in manifests if m not in counting]
        groups = _groups(counting, most)
        made = []
        for done, group in enumerate(groups, 1):
            made.append(_merge(store, group).shard_id)
            aside += [_retire(store, manifest) for manifest in group]
            if progress is not None:
                progress(done, len(groups))
    after = len(counting) - sum(map(len, groups)) + len(groups)
    return Compaction(len(manifests), after, tuple(made), tuple(aside))


def _counting(manifests: Sequence[ShardManifest]) -> list[ShardManifest]:
    """The shards that count wholly; the others must be held by these, and alike."""
    parts = parts_of(manifests)
    odd = next((part.manifest.shard_id for part in parts if not part.is_whole), None)
    if odd is not None:
        raise StoreError(f"{odd}: overlaps another shard; run `adaafford store repair`")
    counting = [part.manifest for part in parts]
    digests = {(m.plan_key, k): digest for m in counting for k, digest in enumerate(m.digests, m.start)}
    for manifest in manifests:
        if any(digests[manifest.plan_key, k] != digest for k, digest in enumerate(manifest.digests, manifest.start)):
            raise StoreError(f"{manifest.shard_id}: another shard says otherwise; run `adaafford store repair`")
    return counting


def _groups(manifests: Sequence[ShardManifest], most: int) -> list[list[ShardManifest]]:
    """Runs of adjacent shards that fit into one, from the left; runs of one are left out."""
    groups: list[list[ShardManifest]] = []
    for manifest in manifests:
        if groups and _fits([*groups[-1], manifest], most):
            groups[-1].append(manifest)
        else:
            groups.append([manifest])
    return [group for group in groups if len(group) > 1]


def _fits(group: Sequence[ShardManifest], most: int) -> bool:
    last, new = group[-2:]
    clouds = sum(manifest.observations for manifest in group)
    return (
        (last.plan_key, last.stop, last.points) == (new.plan_key, new.start, new.points)
        and new.stop - group[0].start <= most
        and clouds * new.points <= MAX_ALL_POINTS
        and max(clouds, sum(manifest.interactions for manifest in group)) <= MAX_ROWS
    )


def _merge(store: Store, group: Sequence[ShardManifest]) -> ShardManifest:
    """Commit one shard of what a run of them holds."""
    job = Job(group[0].plan_key, group[0].start, group[-1].stop)
    rollouts = [rollout for manifest in group for rollout in store.read_rollouts(manifest.shard_id)]
    whole = commit_shard(
        store.place,
        job,
        rollouts,
        group[0].points,
        {"compacted_from": str(len(group))},
        [each for manifest in group for each in manifest.quarantined],
        supersedes={manifest.shard_id for manifest in group},
    )
    if whole.digests != tuple(digest for manifest in group for digest in manifest.digests):
        raise StoreError(f"{whole.shard_id}: came out otherwise than its parts; run `adaafford store verify`")
    return whole


def _retire(store: Store, manifest: ShardManifest) -> str:
    key = f"{SHARDS_FOLDER}/{manifest.shard_id}"
    set_aside(store.place, key)
    return key
