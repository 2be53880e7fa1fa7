"""Merging: what several stores of one setting hold, in one; of a single store it is a copy, to a bucket, say."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.errors import StoreError, UsageError
from shared.plan import Job
from shared.store.coverage import Part, parts_of
from shared.store.difference import difference_of
from shared.store.layout import ShardManifest
from shared.store.store import Store


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
            ours, theirs = (s.setting.model_dump(mode="json") for s in (sources[0], source))
            raise StoreError(
                f"{source.where}: of another setting than {sources[0].where}: {difference_of(ours, theirs)}"
            )
    held = [(manifest, source) for source in sources for manifest in source.committed()]
    manifests, holders = [manifest for manifest, _ in held], {id(manifest): source for manifest, source in held}
    in_several = _agreeing(manifests, holders)
    store = Store.create(out, sources[0].setting)
    plans = {plan.key: plan for source in sources for plan in source.plans()}
    for plan in plans.values():
        store.add_plan(plan)
    for source in sources:
        for version in source.policy_versions():
            store.publish_policy(version, source.read_policy(version))
    parts = parts_of(manifests)
    for done, part in enumerate(parts, 1):
        _copy(store, holders[id(part.manifest)], part)
        if progress is not None:
            progress(done, len(parts))
    rollouts = sum(part.stop - part.start for part in parts)
    return store, Merged(len(parts), rollouts, in_several, store.policy_versions())


def _agreeing(manifests: Sequence[ShardManifest], holders: dict[int, Store]) -> int:
    """How many rollouts several sources hold.

    Raises:
        StoreError: they say otherwise of one.
    """
    seen: dict[tuple[str, int], tuple[str, Store]] = {}
    doubled = set()
    for manifest in manifests:
        source = holders[id(manifest)]
        for index, digest in enumerate(manifest.digests, manifest.start):
            known, first = seen.setdefault((manifest.plan_key, index), (digest, source))
            if known != digest:
                raise StoreError(
                    f"rollout {index} of {manifest.plan_key} is another in {first.where} than in {source.where}; "
                    "nothing was merged"
                )
            if first is not source:
                doubled.add((manifest.plan_key, index))
    return len(doubled)


def _copy(store: Store, source: Store, part: Part) -> None:
    manifest = part.manifest
    job = Job(manifest.plan_key, part.start, part.stop)
    if store.holds(job):
        return
    plan = next(plan for plan in store.plans() if plan.key == manifest.plan_key)
    rollouts = source.read_rollouts(manifest.shard_id)[part.start - manifest.start : part.stop - manifest.start]
    quarantined = [each for each in manifest.quarantined if part.start <= each.rollout < part.stop]
    store.commit(plan, job, rollouts, manifest.provenance | {"merged_from": manifest.shard_id}, quarantined)
