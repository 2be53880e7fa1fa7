"""Which shard counts for which rollout, where several hold the same.

Compaction commits a large shard before it sets the small ones aside, and two drivers on a bucket may divide the same
rollouts differently. What both hold is the same, so each rollout is taken from one shard: the first that begins with or
before it, the larger of two that begin together.

Names of shards tell all of this, so that no manifest has to be kept in memory: there may be a million of them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import pyarrow.compute as pc
from pydantic import Field

from shared.config import StrictModel
from shared.plan import Job

ROLLOUT_COLUMN = "rollout"

Shard = TypeVar("Shard")


@dataclass(frozen=True, slots=True)
class Part:
    """The rollouts `start` (included) to `stop` (not included) of a shard, which is named by its job."""

    shard: Job
    start: int
    stop: int

    @property
    def is_whole(self) -> bool:
        """Whether all of the shard counts."""
        return (self.start, self.stop) == (self.shard.start, self.shard.stop)

    @property
    def job(self) -> Job:
        """The rollouts that count."""
        return Job(self.shard.plan_key, self.start, self.stop)

    def of(self, table: Any) -> Any:
        """The rows that count, of one of the shard's tables."""
        if self.is_whole:
            return table
        rollouts = table.column(ROLLOUT_COLUMN)
        return table.filter(pc.and_(pc.greater_equal(rollouts, self.start), pc.less(rollouts, self.stop)))


def order(job: Job) -> tuple[str, int, int]:
    """Sorts shards by plan and first rollout, the larger of two that begin together first."""
    return job.plan_key, job.start, -job.stop


def parts_of(shards: Iterable[Job]) -> list[Part]:
    """What counts of each shard, in order of plan and rollout; nothing of shards whose rollouts others hold."""
    parts: list[Part] = []
    for shard in sorted(shards, key=order):
        before = parts[-1] if parts and parts[-1].shard.plan_key == shard.plan_key else None
        start = shard.start if before is None else max(before.stop, shard.start)
        if start < shard.stop:
            parts.append(Part(shard, start, shard.stop))
    return parts


def overlapping(shards: Iterable[Shard], job_of: Callable[[Shard], Job]) -> Iterator[Shard]:
    """Those of some shards that hold a rollout which another of them holds too, in order."""
    ordered: Sequence[Shard | None] = [*sorted(shards, key=lambda shard: order(job_of(shard))), None]
    plan_key, reach = "", 0
    for one, following in pairwise(ordered):
        assert one is not None
        job, after = job_of(one), None if following is None else job_of(following)
        if job.plan_key != plan_key:
            plan_key, reach = job.plan_key, 0
        if job.start < reach or (after is not None and after.plan_key == plan_key and after.start < job.stop):
            yield one
        reach = max(reach, job.stop)


@dataclass(slots=True)
class Twice:
    """A rollout that two shards hold."""

    index: int
    alike: bool
    first: Any
    """What was said to hold the first of them."""
    is_second: bool
    """Whether it was held once before, not more often."""


class Window:
    """Compares shards that are added in order of plan and first rollout; remembers no more than may come again."""

    def __init__(self) -> None:
        self._plan_key = ""
        self._seen: dict[int, tuple[str, Any, int]] = {}

    def add(self, job: Job, digests: Sequence[str], holder: Any) -> list[Twice]:
        """The rollouts of a shard that an earlier one holds too.

        Args:
            job: the shard.
            digests: of its rollouts.
            holder: who holds it, for the answers about later shards.
        """
        if job.plan_key != self._plan_key:
            self._plan_key, self._seen = job.plan_key, {}
        for index in [index for index in self._seen if index < job.start]:
            del self._seen[index]
        found = []
        for index, digest in enumerate(digests, job.start):
            known, first, count = self._seen.get(index, (digest, holder, 0))
            if count:
                found.append(Twice(index, known == digest, first, count == 1))
            self._seen[index] = known, first, count + 1
        return found


class Snapshot(StrictModel):
    """The rollouts of a store at one moment, for a training beside collectors, which needs fixed data.

    Shards are immutable, so the rollouts' numbers suffice, also after a compaction.
    """

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
