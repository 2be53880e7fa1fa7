"""How a worker group's driver scales: its processor time and memory by number of actors, with actors that sleep.

What is measured is fitted by two lines: processor time of the driver for a shard by the length of a job, and listing of
a store by shards. These say what more actors and more interactions would take. Why by the length of a job: all that the
driver does for each actor and not for each shard, it does every second (it looks for hung ones), and an actor makes
1 / length shards a second.
"""

import json
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import psutil
from pydantic import Field

from benchmarks.listing import ListingBenchmark, StorePoint
from benchmarks.script import check_picture, main
from benchmarks.sleeping import Dormitories, Sleeper
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from cluster.collection.status_writer import CollectionProgress
from cluster.workers.job_queue import RolloutQueue
from cluster.workers.ray_group import RayWorkerGroup
from cluster.workers.session import ray_session
from collector.job_result import JobResult
from collector.watchdog import Limits
from shared.errors import UsageError
from shared.plan import Plan
from shared.progress import Advance, Progress
from shared.store.crash_log import CrashLog

BEDS = 100
"""Of a dormitory."""
PER_SHARD = 4
LOOK_EVERY = 10
"""Shards, at the driver's memory."""
PREDICTED_PER_SHARD = (4, 32, 128, 256)
SERVERS = ("gcs_server", "raylet")
"""Ray's own processes on the driver's machine."""


class ScaleSettings(StoredSettings):
    """Serve worker groups of actors that sleep, and made-up stores; predict what many more of both would take."""

    rollouts: int = Field(4, ge=1, le=4096)
    """Of the store that is made where none is given, whose first shard is the pattern of a large store."""
    actors: tuple[Annotated[int, Field(ge=1, le=100_000)], ...] = (10, 100, 300, 1000, 2000)
    """Numbers of sleeping actors; a hundred share a process."""
    processes: tuple[Annotated[int, Field(ge=1, le=1000)], ...] = (10, 30)
    """Numbers of sleeping actors with a process each, as collectors have: about 100 MB."""
    shards_per_s: float = Field(50.0, gt=0, le=10_000)
    """That each worker group makes: jobs sleep the longer, the more actors there are."""
    seconds: float = Field(30.0, gt=0, le=3600)
    """Of each worker group."""
    shards: tuple[Annotated[int, Field(ge=1, le=10_000_000)], ...] = (1000, 10_000, 100_000)
    """Numbers of shards of a store on a disk that is made up, listed and added to; in order."""
    predict_actors: int = Field(10_000, ge=1)
    """Predicted by what was measured."""
    predict_interactions: int = Field(10**9, ge=1)
    """Likewise."""
    interactions_per_s: float = Field(100.0, gt=0)
    """Of an actor that does not sleep; `adaafford bench collect` tells."""
    figure: Path | None = None
    """A PNG file to draw."""
    before: Path | None = None
    """An earlier result (a file of --out), drawn beside."""


def measure(command: ScaleSettings) -> dict[str, Any]:
    """Measure, predict, and print both."""
    if list(command.shards) != sorted(set(command.shards)):
        raise UsageError(f"--shards {' '.join(map(str, command.shards))}: give them in order, each once")
    check_picture("--figure", command.figure)
    before = _read(command.before)
    with stored(command) as source, TemporaryDirectory(prefix="adaafford-bench-") as scratch:
        result: dict[str, Any] = source_of(command, source)
        sizes = command.actors, command.processes
        worker_groups = WorkerGroupBenchmark(source.plans()[0], *sizes, command.shards_per_s, command.seconds)
        with Progress("worker groups of sleeping actors", worker_groups.turns) as progress:
            worker_groups.run(progress.advance)
        listing = ListingBenchmark(source, Path(scratch) / "large", command.shards)
        with Progress("stores of made-up shards", listing.turns) as progress:
            listing.run(progress.advance)
        rollout = source.setting.collection.rollout.interactions
    result |= {"fleets": [asdict(point) for point in worker_groups.points]}
    result |= {"stores": [asdict(point) for point in listing.points]}
    wish = Wish(command.predict_actors, command.predict_interactions, rollout, command.interactions_per_s)
    result |= predictions(worker_groups.points, listing.points, wish)
    _print(result)
    if command.figure is not None:
        from benchmarks.scaling_figure import draw

        draw(result, before, command.figure)
        print(f"drawn in {command.figure}", file=sys.stderr)
    return result


@dataclass(frozen=True, slots=True)
class WorkerGroupPoint:
    """A worker group that was kept busy with sleep.

    Attributes:
        kind: "process", an actor a process, or "guest", many of them in one.
        actors: how many.
        job_s: what a job sleeps.
        shards: how many were timed.
        wall_s: which they took.
        driver_ms: processor time of the driver, milliseconds a shard, all threads of the process counted.
        servers_ms: of Ray's own processes on its machine.
        ideal_share: of the throughput that the actors would have if they never waited.
        memory_mb: of the driver in the end.
        growth_bytes: of that, a shard, over the second half.
    """

    kind: str
    actors: int
    job_s: float
    shards: int
    wall_s: float
    driver_ms: float
    servers_ms: float
    ideal_share: float
    memory_mb: float
    growth_bytes: float


class WorkerGroupBenchmark:
    """Worker groups of several sizes, one after the other.

    Args:
        plan: handed out; as large as that of a real store, since it names all objects.
        guests: numbers of actors that share processes.
        processes: numbers of actors of a process each.
        shards_per_s: of each worker group: jobs sleep longer with more actors, so that the driver has as much to do.
        seconds: of each worker group.
    """

    def __init__(
        self, plan: Plan, guests: Sequence[int], processes: Sequence[int], shards_per_s: float, seconds: float
    ) -> None:
        self._plan = plan
        self._sizes = {"guest": guests, "process": processes}
        self._shards_per_s = shards_per_s
        self._seconds = seconds
        self.points: list[WorkerGroupPoint] = []

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return sum(map(len, self._sizes.values()))

    def run(self, advance: Advance) -> None:
        """Measure."""
        for kind, sizes in self._sizes.items():
            if not sizes:
                continue
            with ray_session(max(sizes) if kind == "process" else 1):
                for actors in sizes:
                    self.points.append(self._measure(kind, actors))
                    advance()

    def _measure(self, kind: str, actors: int) -> WorkerGroupPoint:
        job_s = actors / self._shards_per_s
        each = max(2, round(self._seconds / job_s))
        with ExitStack() as stack:
            scratch = Path(stack.enter_context(TemporaryDirectory(prefix="adaafford-bench-")))
            call = None
            if kind == "guest":
                call = Dormitories(-(-actors // BEDS), BEDS, job_s)
                stack.callback(call.close)
            crash_log = CrashLog(scratch / "underway")
            limits = Limits(rollout_s=max(300.0, 2 * job_s))
            worker_group = RayWorkerGroup(partial(Sleeper, job_s), crash_log, actors, limits, call)
            stack.callback(worker_group.close)
            self._collect(worker_group, 0, 2 * actors)
            servers = _servers()
            begun, used, served = time.perf_counter(), time.process_time(), _cpu_s(servers)
            memory = self._collect(worker_group, 2 * actors, actors * each)
            wall_s, used_s, served_s = (
                time.perf_counter() - begun,
                time.process_time() - used,
                _cpu_s(servers) - served,
            )
        half = memory[len(memory) // 2 :]
        return WorkerGroupPoint(
            kind=kind,
            actors=actors,
            job_s=job_s,
            shards=actors * each,
            wall_s=wall_s,
            driver_ms=1e3 * used_s / (actors * each),
            servers_ms=1e3 * served_s / (actors * each),
            ideal_share=each * job_s / wall_s,
            memory_mb=memory[-1] / 2**20,
            growth_bytes=(half[-1] - half[0]) / max(LOOK_EVERY * (len(half) - 1), 1),
        )

    def _collect(self, worker_group: RayWorkerGroup, first: int, shards: int) -> list[int]:
        """Hand out so many jobs and take in their results as a collection does; the memory after every tenth."""
        progress = CollectionProgress("", 0, PER_SHARD * shards, "")
        process, memory = psutil.Process(), []

        def take(job_result: JobResult) -> None:
            progress.tally.add(job_result)
            if progress.tally.rollouts % (LOOK_EVERY * PER_SHARD) == 0:
                memory.append(process.memory_info().rss)

        rollouts = (PER_SHARD * first, PER_SHARD * (first + shards))
        worker_group.run(RolloutQueue(lambda: self._plan, [rollouts], PER_SHARD), take)
        return [*memory, process.memory_info().rss]


@dataclass(frozen=True, slots=True)
class Line:
    """y = at_zero + slope x."""

    at_zero: float
    slope: float

    @classmethod
    def through(cls, points: Iterable[tuple[float, float]]) -> "Line":
        """The line of least squares; level through a single point."""
        x, y = np.array(list(points), dtype=np.float64).T
        if len(set(x.tolist())) < 2:
            return cls(float(y.mean()), 0.0)
        slope, at_zero = np.polyfit(x, y, 1)
        return cls(float(at_zero), float(slope))

    def __call__(self, x: float) -> float:
        """The line at x."""
        return self.at_zero + self.slope * x


@dataclass(frozen=True, slots=True)
class Wish:
    """What is to be predicted.

    Attributes:
        actors: how many.
        interactions: in all.
        per_rollout: interactions of a rollout.
        interactions_per_s: of one actor.
    """

    actors: int
    interactions: int
    per_rollout: int
    interactions_per_s: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """A large collection.

    Attributes:
        per_shard: rollouts a shard.
        job_s: a job takes.
        shards: in all.
        shards_per_s: that arrive.
        driver_load: share of one processor that the driver needs; it keeps up while this is well below 1.
        start_s: until a driver has listed the finished store, on a disk.
        most_actors: that one processor could serve.
    """

    per_shard: int
    job_s: float
    shards: int
    shards_per_s: float
    driver_load: float
    start_s: float
    most_actors: int


def predict(driver_ms: Line, start_s: Line, wish: Wish, per_shard: int) -> Prediction:
    """What the lines say.

    Args:
        driver_ms: processor time of the driver, milliseconds a shard, by seconds a job.
        start_s: listing of a store, by shards.
        wish: for what.
        per_shard: rollouts a shard.
    """
    job_s = per_shard * wish.per_rollout / wish.interactions_per_s
    shards = -(-wish.interactions // (per_shard * wish.per_rollout))
    rate, each_s = wish.actors / job_s, driver_ms(job_s) / 1e3
    return Prediction(per_shard, job_s, shards, rate, rate * each_s, start_s(shards), int(job_s / each_s))


def predictions(worker_groups: Sequence[WorkerGroupPoint], stores: Sequence[StorePoint], wish: Wish) -> dict[str, Any]:
    """The lines through what was measured, and what they say of some sizes of shards."""
    guests = [point for point in worker_groups if point.kind == "guest"] or worker_groups
    # A slope below zero is noise, and would make the large look cheap.
    driver_ms = Line.through((point.job_s, point.driver_ms) for point in guests)
    if driver_ms.slope < 0:
        driver_ms = Line(max(point.driver_ms for point in guests), 0.0)
    # An actor with a process has a connection of its own, which costs more than a share of one.
    above = [point.driver_ms - driver_ms(point.job_s) for point in worker_groups if point.kind == "process"]
    driver_ms = Line(driver_ms.at_zero + max(0.0, float(np.mean(above or [0.0]))), driver_ms.slope)
    start_s = Line.through((point.shards, point.start_s) for point in stores)
    return {
        "driver_ms_by_job_s": asdict(driver_ms),
        "start_s_by_shards": asdict(start_s),
        "predicted_for": asdict(wish),
        "predictions": [asdict(predict(driver_ms, start_s, wish, per_shard)) for per_shard in PREDICTED_PER_SHARD],
    }


def _servers() -> list[psutil.Process]:
    """Ray's own processes, which are this one's children."""
    return [child for child in psutil.Process().children(recursive=True) if child.name() in SERVERS]


def _cpu_s(processes: Sequence[psutil.Process]) -> float:
    times = [process.cpu_times() for process in processes]
    return float(sum(each.user + each.system for each in times))


def _read(path: Path | None) -> dict[str, Any] | None:
    """An earlier result.

    Raises:
        UsageError: the file is missing, or no result.
    """
    if path is None:
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["result"]
        _ = [point["driver_ms"] for point in found["fleets"]]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{path}: no result of this benchmark; name a file that its --out left") from None
    return found


def _print(result: dict[str, Any]) -> None:
    print(f"  {'actors':<16}{'driver, ms a shard':>19}{'of the ideal':>14}{'driver, MB':>12}{'growth, B a shard':>19}")
    for each in result["fleets"]:
        name = f"{each['actors']} {'processes' if each['kind'] == 'process' else ''}"
        share, memory, growth = each["ideal_share"], each["memory_mb"], each["growth_bytes"]
        print(f"  {name:<16}{each['driver_ms']:>19.2f}{share:>14.1%}{memory:>12.0f}{growth:>19.0f}")
    print(f"  {'shards':<16}{'start, s':>10}{'start, MB':>11}{'commit, ms':>12}{'manifest, ms':>14}")
    for each in result["stores"]:
        manifest = "" if each["manifest_ms"] is None else f"{each['manifest_ms']:.2f}"
        print(f"  {each['shards']:<16}{each['start_s']:>10.2f}{each['start_mb']:>11.0f}", end="")
        print(f"{each['commit_ms']:>12.1f}{manifest:>14}")
    print("predicted: ", end="")
    wish = result["predicted_for"]
    print(f"{wish['actors']:,} actors of {wish['interactions_per_s']:g}/s, {wish['interactions']:,} interactions")
    print(f"  {'rollouts a shard':<18}{'job, s':>8}{'shards':>13}{'shards/s':>10}{'driver load':>13}{'start, s':>10}")
    for each in result["predictions"]:
        print(
            f"  {each['per_shard']:<18}{each['job_s']:>8.1f}{each['shards']:>13,}{each['shards_per_s']:>10,.0f}", end=""
        )
        print(f"{each['driver_load']:>13.2f}{each['start_s']:>10.1f}")


if __name__ == "__main__":
    main("scaling", ScaleSettings, measure)
