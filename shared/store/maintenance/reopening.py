"""Reopening: rollouts that were quarantined are taken out of their shards, so that they count as missing again.

What else such a shard holds is committed first, in shards of its own before and after each such rollout; then the shard
is set aside. A crash at any moment loses nothing and doubles nothing: as long as the whole shard is there, readers take
its rollouts from it (see `shared.store.coverage`), and the same call goes on where it was ended.
"""

from collections.abc import Iterator, Sequence

from shared.plan import Job
from shared.records import RolloutStatus
from shared.store import reader
from shared.store.coverage import Part
from shared.store.layout import SHARDS_FOLDER
from shared.store.maintenance.repair import set_aside
from shared.store.store import Store
from shared.store.writer import Unknown, commit_shard


def reopen_quarantined(store: Store, plan_keys: Sequence[str]) -> int:
    """Take the quarantined rollouts of some plans out of their shards; returns how many.

    Args:
        store: which nobody else collects into.
        plan_keys: the plans.

    Raises:
        StoreError: a shard is damaged.
    """
    count = 0
    for part in [part for key in plan_keys for part in store.parts(key)]:
        manifest = store.manifest(part.shard)
        if not manifest.quarantined:
            continue
        rollouts = store.read_rollouts(manifest.shard_id)
        unknown = reader.unknown_of(reader.shard_folder(store.backend, manifest.shard_id), manifest)
        wanted = {rollout.index for rollout in rollouts if rollout.status is RolloutStatus.QUARANTINED}
        kept = [Job(manifest.plan_key, *ends) for ends in _ranges(manifest.start, manifest.stop, wanted)]
        # What a compaction has not set aside yet holds these rollouts as well.
        old = [job for job in store.jobs(manifest.plan_key) if job.start < manifest.stop and manifest.start < job.stop]
        for job in kept:
            rest = Part(manifest.job, job.start, job.stop)
            commit_shard(
                store.backend,
                job,
                rollouts[job.start - manifest.start : job.stop - manifest.start],
                manifest.points,
                {**manifest.provenance, "split_from": manifest.shard_id},
                (),
                vetted=True,
                unknown=Unknown({file: rest.of(table) for file, table in unknown.items()}, manifest.more),
            )
        for job in sorted(set(old) - set(kept), key=lambda job: job.stop - job.start):
            set_aside(store.backend, f"{SHARDS_FOLDER}/{job.shard_id}")
        count += len(wanted)
    return count


def _ranges(start: int, stop: int, without: set[int]) -> Iterator[tuple[int, int]]:
    """The half-open ranges from `start` to `stop` that are left without some numbers."""
    for number in [*sorted(without), stop]:
        if start < number:
            yield start, number
        start = number + 1
