"""Workers and actors that sleep instead of simulating: what a worker group costs its driver, and nothing else.

Two kinds. `Sleeper` is a worker like any other, in a process of its own, with heartbeats and limits. Where more actors
are wanted than processes fit on a machine, `Dormitory` is one process that many actors live in: the driver sees as many
actors, each with its own jobs in their order, and cannot tell the difference but by the processes' names.
"""

import asyncio
import time
from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import ray

from cluster.workers.ray_group import Actor
from collector.job_result import JobResult
from collector.watchdog import UnderWay
from shared.io.files import process_name
from shared.plan import Job, Plan

INTERACTIONS = 32
"""Of a rollout, as by default."""
STAGES = ("load", "settle", "observe", "propose", "simulate", "write")
"""Named so that job results are as large as those of a collector."""


def job_result_of(job: Job, slept_s: float) -> JobResult:
    """What a collector might have said of a job."""
    rollouts = job.stop - job.start
    each = INTERACTIONS // 4
    outcomes = dict.fromkeys(("ok", "no-contact", "start-collision", "wrong-part"), each * rollouts)
    seconds = {**dict.fromkeys(STAGES, slept_s / len(STAGES)), "total": slept_s}
    return JobResult(job.shard_id, rollouts, INTERACTIONS * rollouts, each * rollouts, outcomes, seconds)


@dataclass(frozen=True, slots=True)
class Sleeper:
    """A worker that sleeps `job_s` for each job, in equal parts for its rollouts."""

    job_s: float

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Sleepers propose nothing."""

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> JobResult:
        """Sleep, and leave heartbeats as a collector does."""
        begun = time.perf_counter()
        for rollout in range(job.start, job.stop):
            under_way(rollout)
            time.sleep(self.job_s / (job.stop - job.start))
        under_way(None)
        return job_result_of(job, time.perf_counter() - begun)


class Dormitory:
    """A process that many actors sleep in; each executes its jobs one after the other."""

    def __init__(self, job_s: float) -> None:
        self._job_s = job_s
        self._beds: dict[int, asyncio.Lock] = defaultdict(asyncio.Lock)

    async def arrive(self, bed: int) -> str:
        """Name of the actor in this bed, as of a process."""
        return f"{process_name()}{bed:05d}"

    async def run(self, bed: int, job: Job, *rest: Any) -> JobResult:
        """Sleep for a job."""
        begun = time.perf_counter()
        async with self._beds[bed]:
            await asyncio.sleep(self._job_s)
        return job_result_of(job, time.perf_counter() - begun)


@dataclass(frozen=True, slots=True)
class _Guest:
    """An `Actor` that lives in a dormitory."""

    dormitory: Any
    bed: int

    def arrive(self) -> "Future[str]":
        """See `Actor.arrive`."""
        answer: Future[str] = self.dormitory.arrive.remote(self.bed).future()
        return answer

    def run(self, plan: Any, job: Job, policy: list[Any], quarantined: Mapping[int, str]) -> "Future[JobResult]":
        """See `Actor.run`."""
        # All is sent that a worker would be sent, since that is part of what is measured.
        answer: Future[JobResult] = self.dormitory.run.remote(self.bed, job, [plan], policy, quarantined).future()
        return answer

    def end(self) -> None:
        """The dormitory goes on: others live there."""


class Dormitories:
    """Makes actors, spread over some processes; call it.

    Args:
        count: how many processes.
        beds: of each.
        job_s: how long a job is slept for.
    """

    def __init__(self, count: int, beds: int, job_s: float) -> None:
        remote: Any = ray.remote(Dormitory)
        options = {"num_cpus": 0, "max_concurrency": 2 * beds + 2}
        self._processes = [remote.options(**options).remote(job_s) for _ in range(count)]
        self._given = 0

    def __call__(self) -> Actor:
        """The next actor."""
        bed, index = divmod(self._given, len(self._processes))
        self._given += 1
        return _Guest(self._processes[index], bed)

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            ray.kill(process)
