"""The rollouts of a store at one moment, because a training needs fixed data while collectors add shards."""

from collections.abc import Iterable

from pydantic import Field

from shared.config import StrictModel
from shared.store.coverage import Part


class Snapshot(StrictModel):
    """Rollouts by their numbers. Shards are immutable, so the numbers suffice, also after a compaction."""

    ranges: dict[str, tuple[tuple[int, int], ...]] = Field(default_factory=dict)
    """Half-open, in order and apart, by plan."""

    @classmethod
    def of(cls, parts: Iterable[Part]) -> "Snapshot":
        """The rollouts of some parts of a store, sorted by plan and number."""
        ranges: dict[str, list[tuple[int, int]]] = {}
        for part in parts:
            known = ranges.setdefault(part.shard.plan_key, [])
            start = known.pop()[0] if known and known[-1][1] == part.start else part.start
            known.append((start, part.stop))
        return cls(ranges={key: tuple(known) for key, known in ranges.items()})

    @property
    def rollouts(self) -> int:
        """Number of rollouts."""
        return sum(stop - start for known in self.ranges.values() for start, stop in known)

    def limit(self, parts: Iterable[Part]) -> list[Part]:
        """The parts of the store, restricted to this snapshot."""
        kept = []
        for part in parts:
            for low, high in self.ranges.get(part.shard.plan_key, ()):
                start, stop = max(part.start, low), min(part.stop, high)
                if start < stop:
                    kept.append(Part(part.shard, start, stop))
        return kept
