"""One conformance suite for both worker groups, and what only the worker group of processes must bear."""

import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

import psutil
import pytest

from cluster.workers.job_queue import PlannedJob
from cluster.workers.ray_group import RayWorkerGroup
from cluster.workers.retries import MAX_LOSSES
from cluster.workers.session import ray_session, worker_groups
from cluster.workers.slots import IN_FLIGHT
from cluster.workers.worker_group import SerialWorkerGroup, WorkerGroup
from collector.job_result import JobResult
from collector.watchdog import Limits
from shared.config import CollectionConfig
from shared.errors import StoreError, UsageError
from shared.plan import Job, ObjectRef, Plan, Setting, missing_jobs
from shared.store.crash_log import CrashLog
from tests.support.fake_worker import FakeWorker
from tests.support.waiting import wait_until

ROOT = Path(__file__).parents[2]
LIMITS = Limits(rollout_s=2.0, memory_mb=1000.0)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[WorkerGroup, Path]]:
    """A worker group of processes, which take seconds to start, and the link that says in which folder it works."""
    base = tmp_path_factory.mktemp("fleet")
    with worker_groups(workers=2, limits=LIMITS) as make:
        yield make(partial(FakeWorker, base / "now"), CrashLog(base / "underway")), base / "now"


@pytest.fixture
def ray_worker_group(shared: tuple[WorkerGroup, Path], tmp_path: Path) -> WorkerGroup:
    worker_group, link = shared
    link.unlink(missing_ok=True)
    link.symlink_to(tmp_path)
    worker_group.restarts = 0
    return worker_group


@pytest.fixture(params=["serial", "ray"])
def worker_group(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WorkerGroup:
    monkeypatch.setattr("cluster.workers.worker_group.WAIT_S", 0.02)
    if request.param == "ray":
        found: WorkerGroup = request.getfixturevalue("ray_worker_group")
        return found
    return SerialWorkerGroup(partial(FakeWorker, tmp_path))


class Listed:
    """Jobs of one plan that are known beforehand."""

    def __init__(self, plan: Plan, jobs: Sequence[Job]) -> None:
        self._left = [PlannedJob(plan, job) for job in reversed(jobs)]
        self.any_done = False

    @property
    def ended(self) -> bool:
        return not self._left

    def take(self) -> PlannedJob | None:
        return self._left.pop() if self._left else None


def plan(proposer: str = "random", version: int = 0) -> Plan:
    ref = ObjectRef(id="1", category="Box", content_hash="0" * 64)
    setting = Setting(task="push", seed=1, objects=(ref,), collection=CollectionConfig())
    return Plan(setting=setting, proposer=proposer, policy_version=version)


def jobs(count: int, key: str = "random-v0") -> list[Job]:
    return missing_jobs(key, count, [], 1)


def run(worker_group: WorkerGroup, count: int) -> list[str]:
    job_results: list[JobResult] = []
    worker_group.run(Listed(plan(), jobs(count)), job_results.append)
    return sorted(job_result.shard_id for job_result in job_results)


def begun(folder: Path, job: Job) -> int:
    return sum(line.split()[0] == job.shard_id for line in (folder / "begun").read_text().splitlines())


def processes(folder: Path, job: Job | None = None) -> list[int]:
    """The process of each time that a job, or this one, was begun."""
    lines = [line.split() for line in (folder / "begun").read_text().splitlines()]
    return [int(process) for shard_id, process in lines if job is None or shard_id == job.shard_id]


def test_every_job_is_reported_exactly_once(worker_group: WorkerGroup, tmp_path: Path) -> None:
    assert run(worker_group, 7) == [job.shard_id for job in jobs(7)]
    assert len(list(tmp_path.glob("shard-*"))) == 7


def test_nothing_to_do_is_no_error(worker_group: WorkerGroup) -> None:
    assert run(worker_group, 0) == []


def test_a_failure_of_infrastructure_is_tried_again(worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "raise-2").write_text("1")
    assert run(worker_group, 4) == [job.shard_id for job in jobs(4)]
    assert begun(tmp_path, jobs(4)[2]) == 2


@pytest.mark.parametrize("worker_group", ["serial"], indirect=True)
def test_a_rollout_that_always_fails_is_quarantined_after_three_attempts(
    worker_group: WorkerGroup, tmp_path: Path
) -> None:
    """Processes, which take seconds to start, are replaced as often in the test of one that crashes."""
    (tmp_path / "raise-1").write_text("99")
    assert run(worker_group, 3) == [job.shard_id for job in jobs(3)]
    assert begun(tmp_path, jobs(3)[1]) == 4
    assert (tmp_path / "quarantined-1").read_text() == "RuntimeError: the engine exploded (3 times)"
    assert [path.name for path in tmp_path.glob("quarantined-*")] == ["quarantined-1"]


def test_what_the_user_must_solve_is_not_tried_again(worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "refuse-0").write_text("99")
    with pytest.raises(StoreError, match=r"^the store is damaged$"):
        run(worker_group, 1)
    assert begun(tmp_path, jobs(1)[0]) == 1


def test_a_worker_group_goes_on_after_a_failed_run(worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "refuse-0").write_text("1")
    with pytest.raises(StoreError):
        run(worker_group, 3)
    assert run(worker_group, 3) == [job.shard_id for job in jobs(3)]


class Slow(Listed):
    """Jobs of which some are not there yet when they are asked for."""

    def __init__(self, count: int) -> None:
        super().__init__(plan(), jobs(count))
        self.asked = 0
        self.taken = 0

    def take(self) -> PlannedJob | None:
        self.asked += 1
        if self.asked % 2:
            return None
        self.taken += 1
        return super().take()


def test_a_queue_that_has_no_job_yet_is_asked_again(worker_group: WorkerGroup) -> None:
    job_results: list[JobResult] = []
    worker_group.run(Slow(5), job_results.append)
    assert sorted(job_result.shard_id for job_result in job_results) == [job.shard_id for job in jobs(5)]


def test_jobs_are_taken_no_earlier_than_a_worker_is_free(worker_group: WorkerGroup) -> None:
    orders, done = Slow(12), 0

    def count(job_result: JobResult) -> None:
        nonlocal done
        done += 1
        assert orders.taken <= done + 2 * worker_group.workers

    worker_group.run(orders, count)
    assert done == 12


def test_weights_reach_the_live_workers_once_a_version(worker_group: WorkerGroup, tmp_path: Path) -> None:
    run(worker_group, 4)
    for version in (1, 2):
        worker_group.load_policy(version, {"weights.safetensors": b"weights %d" % version})
        worker_group.run(Listed(plan("aip", version), jobs(8, f"aip-v{version}")), lambda job_result: None)
        pulls = (tmp_path / f"pulled-{version}").read_text().split()
        assert len(pulls) == len(set(pulls)) <= worker_group.workers
    assert worker_group.restarts == 0
    assert len({line.split()[1] for line in (tmp_path / "begun").read_text().splitlines()}) <= worker_group.workers


def test_a_replaced_actor_pulls_the_weights_itself(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    ray_worker_group.load_policy(1, {"weights.safetensors": b"weights 1"})
    (tmp_path / "die-2").write_text("1")
    done: list[JobResult] = []
    ray_worker_group.run(Listed(plan("aip", 1), jobs(6, "aip-v1")), done.append)
    assert len(done) == 6


def test_a_rollout_that_crashes_costs_itself_alone(
    ray_worker_group: WorkerGroup, shared: tuple[WorkerGroup, Path], tmp_path: Path
) -> None:
    crash_log = CrashLog(shared[1].parent / "underway")
    crash_log.sweep()
    (tmp_path / "crash-2").write_text("99")
    wide = missing_jobs("random-v0", 8, [], 4)
    done: list[JobResult] = []
    ray_worker_group.run(Listed(plan(), wide), done.append)
    assert sorted(job_result.shard_id for job_result in done) == [job.shard_id for job in wide]
    assert sum(job_result.quarantined for job_result in done) == 1
    assert begun(tmp_path, wide[0]) == 4
    reason = (tmp_path / "quarantined-2").read_text()
    assert re.fullmatch(
        r"Segmentation fault, in string_at \(.*\) of _misbehave \(fake_worker.py:\d+\) \(3 times\)", reason
    )
    assert crash_log.sweep() == 0, "processes that crashed have left something"


@pytest.mark.slow
def test_a_rollout_that_hangs_is_ended_with_a_traceback(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "hang-0").write_text("1")
    with warnings_of("cluster.workers.retries") as lines:
        assert run(ray_worker_group, 4) == [job.shard_id for job in jobs(4)]
    assert begun(tmp_path, jobs(4)[0]) == 2
    assert re.search(r"in rollout 0 \(took more than 0:00:02, in _misbehave \(fake_worker.py:\d+\)", lines[0])


@pytest.mark.slow
def test_memory_that_explodes_is_bounded(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "explode-1").write_text("1")
    with warnings_of("cluster.workers.retries") as lines:
        assert run(ray_worker_group, 3) == [job.shard_id for job in jobs(3)]
    assert "in rollout 1 (MemoryError" in lines[0]


def test_a_process_that_has_grown_is_replaced(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    # Growth is counted from a process's first job on, and one that came up late may not have had a job yet.
    run(ray_worker_group, 4)
    while len(set(processes(tmp_path))) < ray_worker_group.workers:
        run(ray_worker_group, 4)
    (tmp_path / "grow-2").write_text("1")
    with warnings_of("cluster.workers.ray_group") as lines:
        assert run(ray_worker_group, 12) == [job.shard_id for job in jobs(12)]
    assert lines == ["a worker has grown by 4900 MB and is replaced"]
    grown = processes(tmp_path, jobs(12)[2])[-1]
    wait_until(lambda: not psutil.pid_exists(grown))
    assert run(ray_worker_group, 4) == [job.shard_id for job in jobs(4)]


@pytest.mark.slow
def test_an_actor_that_does_not_even_hear_its_watchdog_is_killed(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "stop-1").write_text("1")
    with warnings_of("cluster.workers.retries") as lines:
        assert run(ray_worker_group, 3) == [job.shard_id for job in jobs(3)]
    assert "took more than 7 s, and had to be killed" in lines[0]


@pytest.mark.slow
def test_a_rollout_whose_process_is_always_killed_is_quarantined_at_last(
    ray_worker_group: WorkerGroup, tmp_path: Path
) -> None:
    (tmp_path / "die-1").write_text("99")
    assert run(ray_worker_group, 3) == [job.shard_id for job in jobs(3)]
    assert begun(tmp_path, jobs(3)[1]) == MAX_LOSSES + 1
    assert "killed from outside, or out of memory" in (tmp_path / "quarantined-1").read_text()


@pytest.mark.slow
def test_processes_killed_at_random_are_no_rollouts_fault(
    ray_worker_group: WorkerGroup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cluster.workers.retries.MAX_FAULTS", 1)
    (tmp_path / "die-1").write_text("2")
    assert run(ray_worker_group, 3) == [job.shard_id for job in jobs(3)]
    assert not list(tmp_path.glob("quarantined-*"))


@contextmanager
def warnings_of(name: str) -> Iterator[list[str]]:
    """What a logger warns of."""
    lines: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger(name).addHandler(handler)
    try:
        yield lines
    finally:
        logging.getLogger(name).removeHandler(handler)


def test_an_actor_holds_at_most_two_jobs(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    most = 0

    def watch(job_result: JobResult) -> None:
        nonlocal most
        slots = ray_worker_group._slots  # type: ignore[attr-defined]
        most = max(most, *(len(slot.planned_jobs) for slot in slots))

    ray_worker_group.run(Listed(plan(), jobs(12)), watch)
    assert most <= 2


def test_an_interrupt_leaves_no_actor_at_work(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    (tmp_path / "hang-1").write_text("9")
    # A shell's background jobs are started with the signal ignored, and then Python does not take it either.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            ray_worker_group.run(Listed(plan(), jobs(4)), lambda job_result: os.kill(os.getpid(), signal.SIGINT))
    finally:
        signal.signal(signal.SIGINT, before)
    assert not any(slot.planned_jobs for slot in ray_worker_group._slots)  # type: ignore[attr-defined]


class InstantActor:
    """An actor without a process: it answers at once, or never, or the other way round; it may grow with some job."""

    def __init__(self, number: int, comes: bool = True, backwards: bool = False, grows_with: int = -1) -> None:
        self._name, self._comes, self._backwards = f"host-1~{number}~1", comes, backwards
        self._grows_with, self.jobs = grows_with, list[Job]()
        self._held: list[tuple[Future[JobResult], JobResult]] = []

    def arrive(self) -> "Future[str]":
        answer: Future[str] = Future()
        if self._comes:
            answer.set_result(self._name)
        return answer

    def run(self, plan: object, job: Job, policy: list[object], quarantined: Mapping[int, str]) -> "Future[JobResult]":
        answer: Future[JobResult] = Future()
        self.jobs.append(job)
        memory_mb = 100.0 if job.start != self._grows_with else 5000.0
        self._held.append((answer, JobResult(job.shard_id, 1, 4, 1, {"ok": 4}, {"total": 0.01}, 0, memory_mb)))
        if len(self._held) == (IN_FLIGHT if self._backwards else 1):
            for future, job_result in reversed(self._held):
                future.set_result(job_result)
            self._held.clear()
        return answer

    def end(self) -> None: ...


def instant_worker_group(folder: Path, actors: Iterable[InstantActor], count: int) -> RayWorkerGroup:
    return RayWorkerGroup(make_nothing, CrashLog(folder), count, LIMITS, partial(next, iter(actors)))


def make_nothing() -> FakeWorker:
    raise AssertionError("these actors have no worker")


def test_no_job_waits_for_an_actor_that_never_comes(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    worker_group = instant_worker_group(tmp_path, [InstantActor(0, comes=False), InstantActor(1)], 2)
    assert run(worker_group, 9) == [job.shard_id for job in jobs(9)]
    assert run(worker_group, 9) == [job.shard_id for job in jobs(9)]
    assert worker_group.restarts == 0


def test_an_actor_that_has_grown_is_replaced_at_no_cost(tmp_path: Path) -> None:
    actors = [InstantActor(0, grows_with=4), InstantActor(1)]
    worker_group = instant_worker_group(tmp_path, actors, 1)
    assert run(worker_group, 12) == [job.shard_id for job in jobs(12)]
    assert worker_group.restarts == 1
    first, second = (actor.jobs for actor in actors)
    assert first + second == jobs(12), "no job was done twice"
    assert 5 <= len(first) <= 4 + IN_FLIGHT


def test_answers_are_taken_in_the_order_of_what_was_asked(ray_worker_group: WorkerGroup, tmp_path: Path) -> None:
    worker_group = instant_worker_group(tmp_path, [InstantActor(0, backwards=True)], 1)
    job_results: list[JobResult] = []
    worker_group.run(Listed(plan(), jobs(8)), job_results.append)
    assert [job_result.shard_id for job_result in job_results] == [job.shard_id for job in jobs(8)]


def test_a_shard_costs_the_driver_the_same_however_many_actors_there_are(
    ray_worker_group: WorkerGroup, tmp_path: Path
) -> None:
    few, many = (calls_a_shard(instant_worker_group(tmp_path, map(InstantActor, range(n)), n), n) for n in (10, 1000))
    assert many < 1.1 * few


def calls_a_shard(worker_group: RayWorkerGroup, actors: int, shards: int = 1500) -> float:
    """How many functions are called for a shard once all actors are up; unlike time, the same on a busy machine."""
    worker_group._poll_s = 60.0  # Looking for hung actors goes by time, not by shard.
    run(worker_group, 2 * actors)
    orders, calls = Listed(plan(), jobs(shards)), 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        worker_group.run(orders, lambda job_result: None)
    finally:
        sys.setprofile(None)
    return calls / shards


@pytest.mark.slow
def test_a_session_whose_raylet_has_died_is_given_up(tmp_path: Path) -> None:
    """Ray itself may wait for ever for the first actor. In a process of its own, which has no other session."""
    program = f"from tests.cluster.test_worker_groups import run_without_raylet; run_without_raylet({str(tmp_path)!r})"
    # A file, since what is left of Ray holds a pipe open for a while.
    with (tmp_path / "log").open("w") as log:
        subprocess.run([sys.executable, "-c", program], stdout=log, stderr=log, timeout=100, cwd=ROOT)
    assert "WorkerError: Ray's process on this machine (its raylet) has died" in (tmp_path / "log").read_text()


def run_without_raylet(folder: str) -> None:
    """Kill a session's raylet before it is asked for actors."""
    with ray_session(1):
        for child in psutil.Process().children(recursive=True):
            if child.name() == "raylet":
                child.kill()
        run(RayWorkerGroup(partial(FakeWorker, Path(folder)), CrashLog(Path(folder)), 1, LIMITS), 3)


@pytest.mark.parametrize(("workers", "missing"), [(0, "sapien"), (2, "ray"), (2, "sapien")])
def test_collecting_says_what_is_not_installed(
    workers: int, missing: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = find_spec
    monkeypatch.setattr("shared.extras.find_spec", lambda name: None if name == missing else found(name))
    with (
        worker_groups(workers, LIMITS) as make,
        pytest.raises(UsageError, match=rf"needs {missing}, not installed here: pip install 'adaafford\[collect\]'"),
    ):
        make(partial(FakeWorker, tmp_path / "now"), CrashLog(tmp_path / "underway"))
