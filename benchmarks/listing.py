"""What a large store costs those who begin with it: listing it, reading its manifests, committing one shard more.

The store is made up: folders with a manifest each, copies of a real one. Nobody who lists it looks further.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from shared.io.documents import with_checksum
from shared.plan import Job, RolloutRecord, missing_ranges
from shared.progress import Advance
from shared.store import Store
from shared.store.layout import MANIFEST_FILE, SHARDS_FOLDER

COMMITS = 7
"""The median of these counts."""
MOST_MANIFESTS = 20_000
"""Stores that are larger are not read by manifest: it takes minutes, and is as long for each."""


@dataclass(frozen=True, slots=True)
class StorePoint:
    """A store of so many shards.

    Attributes:
        shards: how many.
        start_s: what a driver does before it hands out the first job: sweep, list, find what is missing.
        start_mb: memory that it takes meanwhile.
        manifest_ms: reading and checking of a manifest, which verifying and learning do; None where not measured.
        commit_ms: one shard more, by a worker.
        commit_listing_ms: the same by somebody whom no driver has told that its rollouts are missing.
    """

    shards: int
    start_s: float
    start_mb: float
    manifest_ms: float | None
    commit_ms: float
    commit_listing_ms: float


class ListingBenchmark:
    """One store that grows.

    Args:
        template: whose first shard is copied.
        folder: where the store is made.
        sizes: numbers of shards, in order.
    """

    def __init__(self, template: Store, folder: Path, sizes: Sequence[int]) -> None:
        self._manifest = template.committed()[0]
        self._plan = next(plan for plan in template.plans() if plan.key == self._manifest.plan_key)
        self._rollouts = template.read_rollouts(self._manifest.shard_id)
        self._store = Store.create(folder, template.setting)
        self._sizes = sizes
        self.points: list[StorePoint] = []

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return len(self._sizes)

    def run(self, advance: Advance) -> None:
        """Measure."""
        there = 0
        self._store.add_plan(self._plan)
        for size in self._sizes:
            self._fill(there, size)
            self.points.append(self._measure(size))
            there = size + 2 * COMMITS
            advance()

    def _fill(self, there: int, size: int) -> None:
        """Make up shards until there are `size`."""
        content: dict[str, Any] = self._manifest.model_dump(mode="json")
        for number in range(there, size):
            job = self._job(number)
            folder = self._store.path / SHARDS_FOLDER / job.shard_id
            folder.mkdir(parents=True)
            (folder / MANIFEST_FILE).write_bytes(with_checksum(content | {"start": job.start, "stop": job.stop}))

    def _measure(self, size: int) -> StorePoint:
        process = psutil.Process()
        before, begun = process.memory_info().rss, time.perf_counter()
        self._store.sweep()
        jobs = self._store.jobs(self._plan.key)
        left = missing_ranges(size * self._manifest.rollouts, [(job.start, job.stop) for job in jobs])
        start_s, after = time.perf_counter() - begun, process.memory_info().rss
        assert not left, "the store does not hold what was made up"
        del jobs
        manifest_s = _seconds(self._store.committed) / size if size <= MOST_MANIFESTS else None
        commits = [[self._commit(size + 2 * turn + k, vetted=not k) for turn in range(COMMITS)] for k in range(2)]
        return StorePoint(
            shards=size,
            start_s=start_s,
            start_mb=max(after - before, 0) / 2**20,
            manifest_ms=None if manifest_s is None else 1e3 * manifest_s,
            commit_ms=1e3 * median(commits[0]),
            commit_listing_ms=1e3 * median(commits[1]),
        )

    def _commit(self, number: int, *, vetted: bool) -> float:
        job = self._job(number)
        rollouts = _renumbered(self._rollouts, job)
        return _seconds(lambda: self._store.commit(self._plan, job, rollouts, {}, vetted=vetted))

    def _job(self, number: int) -> Job:
        width = self._manifest.rollouts
        return Job(self._plan.key, number * width, (number + 1) * width)


def _renumbered(rollouts: Sequence[RolloutRecord], job: Job) -> list[RolloutRecord]:
    indices = range(job.start, job.stop)
    return [dataclasses.replace(one, index=index) for one, index in zip(rollouts, indices, strict=True)]


def _seconds(act: Callable[[], object]) -> float:
    begun = time.perf_counter()
    act()
    return time.perf_counter() - begun
