"""What storing costs, and how fast a store is read: from a cold and a warm disk, and from a bucket on loopback.

Beside each reading, the same bytes are read raw: all files of all shards, unchecked and undecoded.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import Field

from benchmarks.s3_server import loopback_bucket
from benchmarks.script import main
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from shared.errors import StoreError
from shared.plan import Job, RolloutRecord
from shared.progress import Advance, Progress
from shared.store import Store, info
from shared.store.layout import MAX_DOCUMENT_BYTES, SHARDS_FOLDER

MAX_FILE_BYTES = 1 << 30


class StoreSettings(StoredSettings):
    """Time commits, and reading everything again from a cold and a warm disk and from a bucket, beside raw reading."""

    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""
    bucket: bool = True
    """Whether a bucket is measured as well, on an S3 server that is started on loopback for it."""


def measure(command: StoreSettings) -> dict[str, Any]:
    """Measure, and print a table."""
    with stored(command) as source:
        benchmark = StoringBenchmark(source, command.repeats, command.bucket)
        with Progress("turns of writing and reading", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, source)
    print(f"{result['interactions']} interactions in {result['shards']} shards, {command.repeats} times; medians")
    print(f"  bytes an interaction  {result['bytes_per_interaction']:.0f}")
    for name, cost in result["commit_ms_per_shard"].items():
        each = result["commit_ms_per_interaction"][name]
        print(f"  commit, {name:<13} {cost:.1f} ms a shard, {each:.2f} ms an interaction")
    print(f"  {'reading':<14}{'interactions/s':>15}{'MB/s':>8}{'raw MB/s':>10}{'times raw':>11}")
    for name, figures in result["read"].items():
        rate, speed = figures["interactions_per_second"], figures["megabytes_per_second"]
        raw = figures["raw_megabytes_per_second"]
        print(f"  {name:<14}{rate:>15,.0f}{speed:>8.1f}{raw:>10.1f}{figures['times_raw']:>11.1f}")
    return result


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of the whole store, wall seconds."""

    decoded_s: float
    """Manifests, all rows and all clouds, checked against their checksums."""
    raw_s: float


@dataclass(slots=True)
class StoringBenchmark:
    """Commits what a store holds into fresh ones, and reads these again.

    Attributes:
        source: the store.
        repeats: the medians of these count.
        bucket: whether a bucket on loopback is measured as well.
    """

    source: Store
    repeats: int
    bucket: bool
    commit_s: dict[str, list[float]] = field(default_factory=dict)
    """By place, of each shard."""
    readings: dict[str, list[Reading]] = field(default_factory=dict)
    """By place and state of the cache."""

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return self.repeats * (2 if self.bucket else 1)

    def run(self, advance: Advance) -> None:
        """Measure; `advance` is called after each repeat at each place."""
        shards = [(m.plan_key, m.start, m.stop, self.source.read_rollouts(m.shard_id)) for m in self.source.committed()]
        if not shards:
            raise StoreError(f"{self.source.where}: holds no shard; collect some first")
        jobs = [(Job(key, start, stop), rollouts) for key, start, stop, rollouts in shards]
        for _ in range(self.repeats):
            with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
                copy = self._commit("disk", str(Path(scratch) / "store"), jobs)
                self._read("disk, cold", copy, lambda copy=copy: drop_cache(copy.path))  # type: ignore[misc]
                self._read("disk, warm", copy, lambda: None)
            advance()
        if self.bucket:
            with loopback_bucket() as url:
                for turn in range(self.repeats):
                    copy = self._commit("bucket", f"{url}/{turn}", jobs)
                    self._read("bucket", copy, lambda: None)
                    advance()

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        held = info(self.source)
        megabytes = held.bytes / 1e6
        return {
            "shards": held.shards,
            "interactions": held.interactions,
            "bytes_per_interaction": held.bytes_per_interaction,
            "commit_ms_per_shard": {name: 1e3 * median(each) for name, each in self.commit_s.items()},
            "commit_ms_per_interaction": {
                name: 1e3 * sum(each) / self.repeats / held.interactions for name, each in self.commit_s.items()
            },
            "read": {
                name: {
                    "interactions_per_second": held.interactions / median(one.decoded_s for one in each),
                    "megabytes_per_second": megabytes / median(one.decoded_s for one in each),
                    "raw_megabytes_per_second": megabytes / median(one.raw_s for one in each),
                    "times_raw": median(one.decoded_s for one in each) / median(one.raw_s for one in each),
                }
                for name, each in self.readings.items()
            },
        }

    def _commit(self, name: str, where: str, jobs: list[tuple[Job, tuple[RolloutRecord, ...]]]) -> Store:
        """Commit everything to a fresh store."""
        copy = Store.create(where, self.source.setting)
        plans = {plan.key: plan for plan in self.source.plans()}
        for job, rollouts in jobs:
            begun = time.perf_counter()
            copy.commit(plans[job.plan_key], job, rollouts, {})
            self.commit_s.setdefault(name, []).append(time.perf_counter() - begun)
        return copy

    def _read(self, name: str, store: Store, prepare: Callable[[], None]) -> None:
        prepare()
        decoded = _seconds(lambda: read_everything(store))
        keys = store.backend.leaves(SHARDS_FOLDER)
        wanted = [(key, MAX_FILE_BYTES if key.count("/") > 1 else MAX_DOCUMENT_BYTES) for key in keys]
        prepare()
        raw = _seconds(lambda: sum(map(len, store.backend.read_all(wanted))))
        self.readings.setdefault(name, []).append(Reading(decoded, raw))


def read_everything(store: Store) -> int:
    """All rows and all clouds, as the learner reads them; returns how many rows."""
    for manifest in store.committed():
        store.read_observations(manifest.shard_id)
    return len(store.interactions())


def drop_cache(folder: Path) -> None:
    """Ask the system to forget the content of all files of a folder; what is not on the disk yet is written first."""
    for path in folder.rglob("*"):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(descriptor)


def _seconds(act: Callable[[], object]) -> float:
    begun = time.perf_counter()
    act()
    return time.perf_counter() - begun


if __name__ == "__main__":
    main("storing", StoreSettings, measure)
