"""Merging: what several stores of one setting hold, in one; of a single store it is a copy, to a bucket, say."""

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path

from shared.errors import StoreError, UsageError
from shared.io.documents import difference_of
from shared.plan import Job, Plan, parse_plan_key
from shared.store import reader
from shared.store.coverage import Part, Window, overlapping, parts_of
from shared.store.presence import alone
from shared.store.store import Store
from shared.store.writer import commit_part, copy_shard


@dataclass(frozen=True, slots=True)
class Merged:
    """What a merge did."""

    shards: int
    rollouts: int
    in_several: int
    """Rollouts that more than one source held, alike."""
    policies: tuple[int, ...]


def merge(
    sources: Sequence[Store], out: str | Path, progress: Callable[[int, int], None] | None = None
) -> tuple[Store, Merged]:
    """Put what the sources hold into a store of the same setting; called again after a kill, it goes on.

    Args:
        sources: of one setting.
        out: a new store, or the one that an earlier merge of the same began.
        progress: called after each shard with how many are done and how many there are.

    Raises:
        StoreError: settings differ, or sources say otherwise of the same rollout or policy; or one is damaged.
        UsageError: the new store is one of the sources.
    """
    if str(out) in [source.where for source in sources]:
        raise UsageError(f"{out}: is one of the stores to merge; name another with --out")
    for source in sources[1:]:
        if source.setting != sources[0].setting:
            ours, theirs = (s.setting.as_document() for s in (sources[0], source))
            raise StoreError(
                f"{source.where}: of another setting than {sources[0].where}: {difference_of(ours, theirs)}"
            )
    held = [_Held(job, source) for source in sources for job in source.jobs()]
    in_several = _agreeing(held)
    plans = {plan.key: plan for source in sources for plan in source.plans()}
    for key in sorted({each.job.plan_key for each in held} - plans.keys()):
        # The file of a plan was lost; its name and the setting tell all of it.
        proposer, version = parse_plan_key(key)
        plans[key] = Plan(setting=sources[0].setting, proposer=proposer, policy_version=version)
    store = Store.create(out, sources[0].setting, sources[0].document.more)
    holders = {each.job: each.source for each in reversed(held)}
    with alone(store.backend):
        store.sweep()
        for plan in plans.values():
            store.add_plan(plan)
        for source in sources:
            for version in source.policy_versions():
                store.publish_policy(version, source.read_policy(version))
        parts = parts_of(holders)
        _refuse_overlaps(store, {part.job for part in parts})
        for done, part in enumerate(parts, 1):
            _copy(store, holders[part.shard], part)
            if progress is not None:
                progress(done, len(parts))
    rollouts = sum(part.stop - part.start for part in parts)
    return store, Merged(len(parts), rollouts, in_several, store.policy_versions())


@dataclass(frozen=True, slots=True)
class _Held:
    """A shard of a source."""

    job: Job
    source: Store


def _agreeing(held: Sequence[_Held]) -> int:
    """How many rollouts several sources hold.

    Raises:
        StoreError: they say otherwise of one.
    """
    window, in_several = Window(), 0
    for each in overlapping(held, lambda each: each.job):
        manifest = reader.read_manifest(reader.shard_folder(each.source.backend, each.job.shard_id))
        for twice in window.add(each.job, manifest.digests, each.source):
            if not twice.alike:
                raise StoreError(
                    f"rollout {twice.index} of {each.job.plan_key} is another in {twice.first.where} than in "
                    f"{each.source.where}; nothing was merged"
                )
            in_several += twice.is_second
    return in_several


def _refuse_overlaps(store: Store, ours: AbstractSet[Job]) -> None:
    """Refuse a store that holds, in another shard, a rollout that is to be copied into it."""
    there = set(store.jobs())
    other = next((job for job in overlapping(there | ours, lambda job: job) if job not in ours), None)
    if other is not None:
        raise StoreError(f"{store.where}: overlaps the committed shard {other.shard_id}; name another with --out")


def _copy(store: Store, source: Store, part: Part) -> None:
    if store.holds(part.job):
        return
    shard = reader.shard_folder(source.backend, part.shard.shard_id)
    manifest = reader.read_manifest(shard)
    if part.is_whole:
        copy_shard(shard, manifest, store.backend)
    else:
        commit_part(store.backend, shard, manifest, part, "merged_from")
