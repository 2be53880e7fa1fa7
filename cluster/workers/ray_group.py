"""The worker group of Ray actors: it submits jobs, receives job results, and replaces dead and hung actors.

The driver's cost of a shard does not depend on the number of actors: answers arrive by callbacks, so nothing polls all
actors, and slots are queued by state (`cluster.workers.slots`).

Prometheus metrics go through Ray's own exporter (in its full installation, `ray[default]`). Labels are few and fixed:
task, proposer, outcome, stage, cause. None is ever an object, a rollout, a shard or a worker, of which there are
millions.

    ray_adaafford_rollouts_total, ray_adaafford_quarantined_total           {task, proposer}
    ray_adaafford_interactions_total                                        {task, proposer, outcome}
    ray_adaafford_successes_total                                           {task, proposer}
    ray_adaafford_worker_seconds_total                                      {task, proposer, stage}
    ray_adaafford_restarts_total                                            {cause}: fault, loss, growth
    ray_adaafford_workers, ray_adaafford_policy                             gauges
"""

import logging
import socket
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Literal, Protocol

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.metrics import Counter, Gauge

from cluster.workers.job_queue import JobQueue, PlannedJob
from cluster.workers.retries import Failure, RetryPolicy, RetryQueue, of_environment
from cluster.workers.slots import Slot, Slots, Task
from cluster.workers.worker_group import WAIT_S, WorkerGroup
from collector.actor import WorkerActor
from collector.job_result import JobResult, WorkerFactory
from collector.watchdog import Limits
from shared.errors import AdaAffordError, WorkerError
from shared.io.files import end_if_here
from shared.plan import Job, Plan
from shared.store.crash_log import CrashLog

START_LIMIT_S = 120.0
"""The start of an actor's process imports an engine and PyTorch, which is slow on a busy machine or a cold disk."""
GRACE_S = 5.0
"""The driver waits this much longer than the actor's own watchdog, because only the watchdog writes a traceback."""
LOST = "its process was lost without a traceback: killed from outside, or out of memory"
KEPT = 3
"""How many plans and policies stay in the object store; only retries of failed jobs still need older ones."""
POLL_S = 1.0
"""How often the driver looks for hung actors."""
NODE_S = 2.0
"""How often the driver checks, while actors start, that its own node is alive; without the node none can start."""
LOOK_S = 0.1
"""How long each search for hung actors may take: a heartbeat in a bucket costs a request."""
Cause = Literal["fault", "loss", "growth"]
"""Why a worker was replaced: of a rollout's making, killed from outside, or grown too large."""

logger = logging.getLogger(__name__)


class Actor(Protocol):
    """The interface of an actor to a worker group; each answer is a future."""

    def arrive(self) -> "Future[str]":
        """The name of its process, when the process has started."""
        ...

    def run(self, plan: Any, job: Job, policy: list[Any], quarantined: Mapping[int, str]) -> "Future[JobResult]":
        """See `collector.actor.WorkerActor.run`; jobs are executed in the order of the calls."""
        ...

    def end(self) -> None:
        """Kill the process."""
        ...


class ProcessActor(Actor):
    """An `Actor` in a separate process with one CPU; without restarts by Ray, which only repeat `__init__`."""

    def __init__(self, make_worker: WorkerFactory, crash_log: CrashLog, limits: Limits) -> None:
        actor: Any = ray.remote(num_cpus=1, max_restarts=0)(WorkerActor)
        self._actor = actor.remote(make_worker, crash_log, limits)

    def arrive(self) -> "Future[str]":
        answer: Future[str] = self._actor.arrive.remote().future()
        return answer

    def run(self, plan: Any, job: Job, policy: list[Any], quarantined: Mapping[int, str]) -> "Future[JobResult]":
        answer: Future[JobResult] = self._actor.run.remote([plan], job, policy, quarantined).future()
        return answer

    def end(self) -> None:
        ray.kill(self._actor)


class _SharedObjects:
    """The newest few plans or policies, each put into Ray's object store once; actors pull them when needed."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, tuple[Any, Any]] = {}

    def put(self, key: Hashable, value: Any) -> Any:
        """The reference to a value."""
        kept = self._kept.get(key)
        if kept is None or (kept[0] is not value and kept[0] != value):
            self._kept.pop(key, None)
            while len(self._kept) >= KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = kept = value, ray.put(value)
        return kept[1]

    def get(self, key: Hashable) -> list[Any]:
        """The reference in a list; an empty list if the value is no longer kept."""
        return [self._kept[key][1]] if key in self._kept else []


class RayWorkerGroup(WorkerGroup):
    """Actors of `collector.actor`, one CPU each, alive over all rounds; needs a session (`cluster.workers.session`)."""

    def __init__(
        self,
        make_worker: WorkerFactory,
        crash_log: CrashLog,
        workers: int,
        limits: Limits,
        call: Callable[[], Actor] | None = None,
    ) -> None:
        """Start nothing yet: actors start with the first jobs.

        Args:
            make_worker: makes the worker within an actor.
            crash_log: where actors leave their heartbeats.
            workers: how many actors.
            limits: time and memory of a rollout; an actor that exceeds them is ended.
            call: makes an actor; None: a process with a worker.
        """
        self.workers = workers
        self.restarts = 0
        self._call = call or partial(ProcessActor, make_worker, crash_log, limits)
        self._crash_log = crash_log
        self._limits = limits
        self._poll_s = min(POLL_S, limits.rollout_s / 4)
        self._looked = self._looked_at_node = time.monotonic()
        self._slots = Slots(workers)
        self._in_flight = 0
        self._answered: SimpleQueue[Slot] = SimpleQueue()
        self._plans, self._policies = _SharedObjects(), _SharedObjects()
        self._metrics = WorkerMetrics(workers)

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """See `WorkerGroup.load_policy`: one `ray.put`; actors pull it when a plan first needs it."""
        self._policies.put(version, dict(files))

    def run(self, queue: JobQueue, on_result: Callable[[JobResult], None]) -> None:
        retries = RetryPolicy(self.workers)
        backlog = RetryQueue(queue, retries)
        try:
            while not backlog.ended or self._in_flight:
                self._hand_out(backlog, retries)
                for slot in self._wait():
                    # An actor's answers are taken in the order of its tasks, whatever the order of the callbacks. A
                    # callback of a dismissed actor finds no task.
                    while slot.tasks and slot.tasks[0].answer.done():
                        self._take_in(slot, backlog, retries, on_result)
                self._replace_hung(backlog, retries)
        finally:
            # Jobs are left only after a failure or an interrupt. Nobody would wait for their results, so their actors
            # are ended; the next run makes these rollouts again.
            for slot in self._slots:
                if slot.planned_jobs:
                    self._dismiss(slot)

    def close(self) -> None:
        for slot in self._slots:
            self._dismiss(slot)

    def _wait(self) -> Iterator[Slot]:
        """Slots whose actors have answered; waits for the first. Later answers are returned by the next call."""
        timeout_s = self._poll_s if self._in_flight or self._slots.called else WAIT_S
        for _ in range(max(1, self._answered.qsize())):
            try:
                yield self._answered.get(timeout=timeout_s)
            except Empty:
                return

    def _hand_out(self, backlog: RetryQueue, retries: RetryPolicy) -> None:
        """Submit jobs to the actors that are up, and start an actor for each job that has to wait.

        An actor may start late or never (its machine may be gone), so no job waits for a particular actor.

        Args:
            backlog: gives the jobs, and keeps those for which actors were started.
            retries: knows the quarantined rollouts.
        """
        while (slot := self._slots.most_idle) is not None:
            planned = backlog.take(idle=not self._in_flight)
            if planned is None:
                return
            self._give(slot, planned, retries)
        while (slot := self._slots.empty) is not None:
            if len(backlog) <= self._slots.called:
                planned = backlog.take_new(idle=not self._in_flight and not backlog)
                if planned is None:
                    return
                backlog.append(planned)
            slot.actor, slot.busy_since = self._call(), time.monotonic()
            self._ask(slot, None, slot.actor.arrive())

    def _give(self, slot: Slot, planned: PlannedJob, retries: RetryPolicy) -> None:
        """Submit a job to the slot's actor."""
        if not slot.tasks:
            slot.busy_since = time.monotonic()
        plan = self._plans.put(planned.plan.key, planned.plan)
        # If a version is no longer kept here, the worker reads its weights from the store.
        policy = self._policies.get(planned.plan.policy_version)
        self._in_flight += 1
        self._ask(slot, planned, slot.actor.run(plan, planned.job, policy, retries.quarantined(planned.job)))

    def _ask(self, slot: Slot, planned: PlannedJob | None, answer: "Future[Any]") -> None:
        """Add a task to the slot, and be called when its answer arrives."""
        slot.tasks.append(Task(planned, answer))
        self._slots.update(slot)
        answer.add_done_callback(lambda _: self._answered.put(slot))

    def _take_in(
        self, slot: Slot, backlog: RetryQueue, retries: RetryPolicy, on_result: Callable[[JobResult], None]
    ) -> None:
        """Report the result of the slot's oldest task, or handle its failure."""
        task = slot.tasks[0]
        try:
            message = task.answer.result()
        except RayTaskError as error:
            if isinstance(error.cause, AdaAffordError):
                raise error.cause from None
            cause = error.cause or error
            self._fail(slot, backlog, retries, Failure.of_exception(cause, None), in_rollout=not of_environment(cause))
            return
        except RayError:
            words = self._crash_log.fault_of(slot.process) if slot.process else ""
            self._fail(slot, backlog, retries, Failure(words or LOST, None, fault=bool(words)))
            return
        slot.complete()
        if task.planned is None:
            slot.process = message
            logger.info("a worker is up", extra={"worker": slot.process})
        else:
            self._in_flight -= 1
            retries.reset(task.planned.job)
            self._note_done(slot, task.planned.plan, message)
            self._retire_if_grown(slot, message)
        if slot.retiring and not slot.tasks:
            self._dismiss(slot)
            self._count_replaced("growth")
        self._slots.update(slot)
        if task.planned is not None:
            on_result(message)

    def _replace_hung(self, backlog: RetryQueue, retries: RetryPolicy) -> None:
        """Replace hung actors that their own watchdog did not end.

        A rollout exceeds its limit when the driver has seen the same heartbeat for that long by the driver's clock,
        because clocks of machines differ.
        """
        now = time.monotonic()
        if now - self._looked < self._poll_s:
            return
        self._looked = now
        if self._slots.called and now - self._looked_at_node > NODE_S:
            self._looked_at_node = now
            _require_own_node()
        for slot in self._slots.round_robin():
            if time.monotonic() - now > LOOK_S:
                return
            busy_s = now - slot.busy_since if slot.tasks else 0.0
            if slot.process:
                if busy_s > self._limits.rollout_s:
                    self._look(slot, backlog, retries)
            elif busy_s > START_LIMIT_S:
                self._call_again(slot, retries)

    def _look(self, slot: Slot, backlog: RetryQueue, retries: RetryPolicy) -> None:
        """Replace a slot's actor if it hangs."""
        heartbeat, since = slot.look(self._crash_log)
        limit = START_LIMIT_S if heartbeat is None else self._limits.rollout_s + GRACE_S
        if time.monotonic() - since > limit:
            # A stopped process does not react to Ray.
            end_if_here(slot.process)
            reason = f"took more than {limit:g} s, and had to be killed"
            self._fail(slot, backlog, retries, Failure(reason, None, fault=True))

    def _call_again(self, slot: Slot, retries: RetryPolicy) -> None:
        """Give up an actor that did not start; if others run, only a machine is missing, and it may come back."""
        self._dismiss(slot)
        if not any(other.process for other in self._slots):
            retries.record_harmless(f"the start of its process took more than {START_LIMIT_S:g} s")

    def _note_done(self, slot: Slot, plan: Plan, job_result: JobResult) -> None:
        """Write a committed shard to the log and the metrics."""
        self._metrics.add(plan, job_result)
        about = {"plan": plan.key, "policy": plan.policy_version, "shard": job_result.shard_id, "worker": slot.process}
        about |= {"interactions": job_result.interactions, "successes": job_result.successes}
        about |= {"seconds": job_result.seconds.get("total", 0.0)}
        logger.info("shard %s is committed", job_result.shard_id, extra=about)

    def _retire_if_grown(self, slot: Slot, job_result: JobResult) -> None:
        """Submit no further jobs to an actor whose memory has grown by half of its limit."""
        if slot.first_mb is None:
            slot.first_mb = job_result.memory_mb
        grown_mb = job_result.memory_mb - slot.first_mb
        if not slot.retiring and grown_mb > self._limits.memory_mb / 2:
            about = {"worker": slot.process, "shard": job_result.shard_id}
            logger.warning("a worker has grown by %.0f MB and is replaced", grown_mb, extra=about)
            slot.retiring = True

    def _fail(
        self, slot: Slot, backlog: RetryQueue, retries: RetryPolicy, failure: Failure, *, in_rollout: bool = True
    ) -> None:
        """Replace the slot's actor, put its jobs back in front, and count the failure for the rollout that was running.

        Args:
            slot: whose actor failed.
            backlog: receives the jobs.
            retries: counts the failure.
            failure: the failure; the rollout that was running is found here.
            in_rollout: whether that rollout may be the cause.
        """
        planned_jobs = slot.planned_jobs
        heartbeat = self._crash_log.heartbeat_of(slot.process) if slot.process else None
        about = {"worker": slot.process, "rollout": heartbeat.rollout if heartbeat else None, "reason": failure.reason}
        logger.info("a worker is replaced: %s", failure.reason, extra=about)
        self._dismiss(slot)
        self._count_replaced("fault" if failure.fault else "loss")
        if not planned_jobs:
            retries.record_harmless(failure.reason)
            return
        jobs = [planned.job for planned in planned_jobs]
        job = next((job for job in jobs if heartbeat is not None and heartbeat.shard_id == job.shard_id), jobs[0])
        known = heartbeat is not None and heartbeat.shard_id == job.shard_id and in_rollout
        retries.record_failure(
            job, replace(failure, rollout=heartbeat.rollout if known and heartbeat is not None else None)
        )
        backlog.put_back(planned_jobs)

    def _count_replaced(self, cause: Cause) -> None:
        self.restarts += 1
        self._metrics.replaced(cause)

    def _dismiss(self, slot: Slot) -> None:
        """End the slot's actor, drop its jobs, and remove its heartbeat and crash log."""
        if slot.actor is not None:
            slot.actor.end()
        if slot.process:
            self._crash_log.forget(slot.process)
        self._in_flight -= len(slot.planned_jobs)
        slot.clear()
        self._slots.update(slot)


def _require_own_node() -> None:
    """Check that the Ray node of this process is alive; in a session of our own it is the only node.

    Ray notices its death only after a quarter of a minute, and then ends this process without a message.
    """
    own = ray.get_runtime_context().get_node_id()
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    node = next((node for node in nodes if node["NodeID"] == own and node["Alive"]), None)
    try:
        if node is None:
            raise ConnectionError
        socket.create_connection((node["NodeManagerAddress"], node["NodeManagerPort"]), timeout=NODE_S).close()
    except ConnectionError:
        raise WorkerError("Ray's process on this machine (its raylet) has died; run the same command again") from None
    except OSError:  # It is too busy to answer, say.
        return


class WorkerMetrics:
    """Counters of one driver, which start at 0 with its process, as Prometheus expects."""

    def __init__(self, workers: int) -> None:
        of_plan = ("task", "proposer")
        self._rollouts = Counter("adaafford_rollouts", "Rollouts committed.", of_plan)
        self._quarantined = Counter("adaafford_quarantined", "Rollouts given up.", of_plan)
        self._interactions = Counter("adaafford_interactions", "Interactions by outcome.", (*of_plan, "outcome"))
        self._successes = Counter("adaafford_successes", "Interactions that succeeded.", of_plan)
        self._seconds = Counter("adaafford_worker_seconds", "What workers spend their time on.", (*of_plan, "stage"))
        self._restarts = Counter("adaafford_restarts", "Workers that were replaced.", ("cause",))
        self._policy = Gauge("adaafford_policy", "Version of the policy of the last shard.", of_plan)
        self._workers = Gauge("adaafford_workers", "Workers that the driver keeps busy.")
        self._workers.set(workers)

    def add(self, plan: Plan, job_result: JobResult) -> None:
        """Count a shard."""
        tags = {"task": plan.setting.task, "proposer": plan.proposer}
        for counter, amount in (
            (self._rollouts, job_result.rollouts),
            (self._quarantined, job_result.quarantined),
            (self._successes, job_result.successes),
        ):
            _increase(counter, amount, tags)
        for outcome, count in job_result.outcomes.items():
            _increase(self._interactions, count, {**tags, "outcome": outcome})
        for stage, seconds in job_result.seconds.items():
            _increase(self._seconds, seconds, {**tags, "stage": stage})
        self._policy.set(plan.policy_version, tags)

    def replaced(self, cause: Cause) -> None:
        """Count a worker that was replaced."""
        self._restarts.inc(1, {"cause": cause})


def _increase(counter: Counter, amount: float, tags: dict[str, str]) -> None:
    # Ray refuses to increase a counter by nothing.
    if amount > 0:
        counter.inc(amount, tags)
