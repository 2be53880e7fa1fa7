"""What a store held at some moment: shards come to it while it is learnt from, and a training needs firm ground."""

from collections.abc import Iterable

from pydantic import Field

from shared.config import StrictModel
from shared.store.coverage import Part


class Snapshot(StrictModel):
    """Rollouts by their numbers; shards are immutable, so that says all, also after a compaction."""

    ranges: dict[str, tuple[tuple[int, int], ...]] = Field(default_factory=dict)
    """Half-open, in order and apart, by plan."""

    @classmethod
    def of(cls, parts: Iterable[Part]) -> "Snapshot":
        """What these parts of a store hold, which are in order of plan and rollout."""
        ranges: dict[str, list[tuple[int, int]]] = {}
        for part in parts:
            known = ranges.setdefault(part.shard.plan_key, [])
            start = known.pop()[0] if known and known[-1][1] == part.start else part.start
            known.append((start, part.stop))
        return cls(ranges={key: tuple(known) for key, known in ranges.items()})

    @property
    def rollouts(self) -> int:
        """How many there are."""
        return sum(stop - start for known in self.ranges.values() for start, stop in known)

    def limit(self, parts: Iterable[Part]) -> list[Part]:
        """What of some parts of the store belongs to the snapshot."""
        kept = []
        for part in parts:
            for low, high in self.ranges.get(part.shard.plan_key, ()):
                start, stop = max(part.start, low), min(part.stop, high)
                if start < stop:
                    kept.append(Part(part.shard, start, stop))
        return kept
