"""Which shard counts for which rollout, where several hold the same.

Compaction commits a large shard before it sets the small ones aside, and two drivers on a bucket may divide the same
rollouts differently. What both hold is the same, so each rollout is taken from one shard: the first that begins with or
before it, the larger of two that begin together.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow.compute as pc

from shared.store.layout import ShardManifest

ROLLOUT_COLUMN = "rollout"


@dataclass(frozen=True, slots=True)
class Part:
    """The rollouts `start` (included) to `stop` (not included) of a shard."""

    manifest: ShardManifest
    start: int
    stop: int

    @property
    def is_whole(self) -> bool:
        """Whether all of the shard counts."""
        return (self.start, self.stop) == (self.manifest.start, self.manifest.stop)

    def of(self, table: Any) -> Any:
        """The rows that count, of one of the shard's tables."""
        if self.is_whole:
            return table
        rollouts = table.column(ROLLOUT_COLUMN)
        return table.filter(pc.and_(pc.greater_equal(rollouts, self.start), pc.less(rollouts, self.stop)))


def parts_of(manifests: Iterable[ShardManifest]) -> list[Part]:
    """What counts of each shard, in order of plan and rollout; nothing of shards whose rollouts others hold."""
    parts: list[Part] = []
    for manifest in sorted(manifests, key=lambda m: (m.plan_key, m.start, -m.stop)):
        before = parts[-1] if parts and parts[-1].manifest.plan_key == manifest.plan_key else None
        start = manifest.start if before is None else max(before.stop, manifest.start)
        if start < manifest.stop:
            parts.append(Part(manifest, start, manifest.stop))
    return parts
