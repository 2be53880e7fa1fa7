"""The fleet of Ray actors: bounded work in flight, dead and hung actors replaced, only receipts coming back.

What the driver does for a shard does not depend on how many actors there are: answers call back by themselves, instead
of being looked for among all that are expected, and seats are filed by what they want (`cluster.workers.slots`).
"""

import logging
import socket
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Protocol

import ray
from ray.exceptions import RayError, RayTaskError

from cluster.workers.job_queue import Orders, PlannedJob
from cluster.workers.metrics import Cause, FleetMetrics
from cluster.workers.retries import Backlog, Blame, Failure, of_environment
from cluster.workers.slots import Seat, Seats, Task
from cluster.workers.worker_group import WAIT_S
from collector.actor import WorkerActor
from collector.job_result import Receipt, WorkerFactory
from collector.watchdog import Limits
from shared.errors import AdaAffordError, WorkerError
from shared.io.files import end_if_here
from shared.plan import Job, Plan
from shared.store.crash_log import Underway

START_LIMIT_S = 120.0
"""An actor's process imports an engine and PyTorch, which a busy machine or a cold disk may slow; no job's fault."""
GRACE_S = 5.0
"""What an actor's own watchdog, which leaves a traceback, has in advance of the driver, which cannot."""
LOST = "its process was lost without a word: killed from outside, or for want of memory"
KEPT = 3
"""Plans and policies that the object store holds; older ones were replaced, and only jobs that failed want them."""
POLL_S = 1.0
"""How often the driver looks for hung actors, however many receipts come."""
NODE_S = 2.0
"""How often it looks, while actors are awaited, whether its own node lives: without it none may ever come."""
LOOK_S = 0.1
"""How long it looks each time, at one after the other: a breadcrumb in a bucket takes a request."""

logger = logging.getLogger(__name__)


class Actor(Protocol):
    """What a fleet asks of an actor; each answer comes later."""

    def arrive(self) -> "Future[str]":
        """The name of its process, once that is up."""
        ...

    def run(self, plan: Any, job: Job, policy: list[Any], quarantined: Mapping[int, str]) -> "Future[Receipt]":
        """See `collector.actor.WorkerActor.run`; executed in the order asked."""
        ...

    def end(self) -> None:
        """End it at once."""
        ...


class ProcessActor:
    """An `Actor`: a process of its own, with one CPU. No restarts by Ray, which would run only `__init__` again."""

    def __init__(self, make_worker: WorkerFactory, underway: Underway, limits: Limits) -> None:
        actor: Any = ray.remote(num_cpus=1, max_restarts=0)(WorkerActor)
        self._actor = actor.remote(make_worker, underway, limits)

    def arrive(self) -> "Future[str]":
        """See `Actor.arrive`."""
        answer: Future[str] = self._actor.arrive.remote().future()
        return answer

    def run(self, plan: Any, job: Job, policy: list[Any], quarantined: Mapping[int, str]) -> "Future[Receipt]":
        """See `Actor.run`."""
        answer: Future[Receipt] = self._actor.run.remote([plan], job, policy, quarantined).future()
        return answer

    def end(self) -> None:
        """See `Actor.end`."""
        ray.kill(self._actor)


class _Shelf:
    """What actors pull when they first need it: the newest few, each put into Ray's object store once."""

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
        """The reference, or nothing if there is none any more."""
        return [self._kept[key][1]] if key in self._kept else []


class RayFleet:
    """Actors of `collector.actor`, one CPU each, alive over all rounds. Needs a session (`cluster.workers.session`)."""

    def __init__(
        self,
        make_worker: WorkerFactory,
        underway: Underway,
        workers: int,
        limits: Limits,
        call: Callable[[], Actor] | None = None,
    ) -> None:
        """Start nothing yet: actors come up with the first jobs.

        Args:
            make_worker: makes the worker within an actor.
            underway: where actors leave their breadcrumbs.
            workers: how many actors.
            limits: what a rollout may take; an actor that goes beyond is ended.
            call: makes an actor; None: a process with a worker.
        """
        self.workers = workers
        self.restarts = 0
        self._call = call or partial(ProcessActor, make_worker, underway, limits)
        self._underway = underway
        self._limits = limits
        self._poll_s = min(POLL_S, limits.rollout_s / 4)
        self._looked = self._looked_at_node = time.monotonic()
        self._seats = Seats(workers)
        self._in_flight = 0
        self._answered: SimpleQueue[Seat] = SimpleQueue()
        self._plans, self._policies = _Shelf(), _Shelf()
        self._metrics = FleetMetrics(workers)

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """See `Fleet.load_policy`: one `ray.put`; actors pull it when a plan first needs it."""
        self._policies.put(version, dict(files))

    def run(self, orders: Orders, on_receipt: Callable[[Receipt], None]) -> None:
        """See `Fleet.run`."""
        blame = Blame(self.workers)
        backlog = Backlog(orders, blame)
        try:
            while not backlog.ended or self._in_flight:
                self._hand_out(backlog, blame)
                for seat in self._wait():
                    # An actor's answers are taken in the order of what was asked, in whichever they are announced; of
                    # one that was dismissed some are announced that nobody waits for.
                    while seat.tasks and seat.tasks[0].answer.done():
                        self._take_in(seat, backlog, blame, on_receipt)
                self._replace_hung(backlog, blame)
        finally:
            # Only after a failure or an interrupt is anything left; what an actor would still commit is wanted by the
            # next run anyway, but nobody would wait for it, so the actor goes.
            for seat in self._seats:
                if seat.orders:
                    self._dismiss(seat)

    def close(self) -> None:
        """See `Fleet.close`."""
        for seat in self._seats:
            self._dismiss(seat)

    def _wait(self) -> Iterator[Seat]:
        """Seats whose actors have answered, as soon as there is one; those that answer meanwhile come the next time."""
        timeout_s = self._poll_s if self._in_flight or self._seats.called else WAIT_S
        for _ in range(max(1, self._answered.qsize())):
            try:
                yield self._answered.get(timeout=timeout_s)
            except Empty:
                return

    def _hand_out(self, backlog: Backlog, blame: Blame) -> None:
        """Give actors that are up what they want, and call an actor for each order that has to wait.

        An actor that is called may be long in coming, or for ever where a machine has left; so nothing is bound to it.

        Args:
            backlog: where they come from, and those that actors were called for go.
            blame: knows what is not to be executed any more.
        """
        while (seat := self._seats.hungriest) is not None:
            order = backlog.take(idle=not self._in_flight)
            if order is None:
                return
            self._give(seat, order, blame)
        while (seat := self._seats.empty) is not None:
            if len(backlog) <= self._seats.called:
                order = backlog.take_new(idle=not self._in_flight and not backlog)
                if order is None:
                    return
                backlog.append(order)
            seat.actor, seat.busy_since = self._call(), time.monotonic()
            self._ask(seat, None, seat.actor.arrive())

    def _give(self, seat: Seat, order: PlannedJob, blame: Blame) -> None:
        """Submit an order to the seat's actor."""
        if not seat.tasks:
            seat.busy_since = time.monotonic()
        plan = self._plans.put(order.plan.key, order.plan)
        # Of a version that is no longer kept, the worker reads the weights in the store.
        policy = self._policies.get(order.plan.policy_version)
        self._in_flight += 1
        self._ask(seat, order, seat.actor.run(plan, order.job, policy, blame.quarantined(order.job)))

    def _ask(self, seat: Seat, order: PlannedJob | None, answer: "Future[Any]") -> None:
        """Take note of what an actor was asked."""
        seat.tasks.append(Task(order, answer))
        self._seats.file(seat)
        answer.add_done_callback(lambda _: self._answered.put(seat))

    def _take_in(self, seat: Seat, backlog: Backlog, blame: Blame, on_receipt: Callable[[Receipt], None]) -> None:
        """Report the receipt that has come for the seat's oldest task, or see to the failure."""
        task = seat.tasks[0]
        try:
            message = task.answer.result()
        except RayTaskError as error:
            if isinstance(error.cause, AdaAffordError):
                raise error.cause from None
            cause = error.cause or error
            self._fail(seat, backlog, blame, Failure.of_exception(cause, None), in_rollout=not of_environment(cause))
            return
        except RayError:
            words = self._underway.fault_of(seat.process) if seat.process else ""
            self._fail(seat, backlog, blame, Failure(words or LOST, None, fault=bool(words)))
            return
        seat.settle()
        if task.order is None:
            seat.process = message
            logger.info("a worker is up", extra={"worker": seat.process})
        else:
            self._in_flight -= 1
            blame.acquit(task.order.job)
            self._note_done(seat, task.order.plan, message)
            self._retire_if_grown(seat, message)
        if seat.retiring and not seat.tasks:
            self._dismiss(seat)
            self._count_replaced("growth")
        self._seats.file(seat)
        if task.order is not None:
            on_receipt(message)

    def _replace_hung(self, backlog: Backlog, blame: Blame) -> None:
        """Replace actors that hang so thoroughly that not even their own watchdog ended them.

        A rollout is over its limit when the driver has seen its breadcrumb unchanged for so long by its own clock:
        clocks of machines differ.
        """
        now = time.monotonic()
        if now - self._looked < self._poll_s:
            return
        self._looked = now
        if self._seats.called and now - self._looked_at_node > NODE_S:
            self._looked_at_node = now
            _require_own_node()
        for seat in self._seats.in_turn():
            if time.monotonic() - now > LOOK_S:
                return
            busy_s = now - seat.busy_since if seat.tasks else 0.0
            if seat.process:
                if busy_s > self._limits.rollout_s:
                    self._look(seat, backlog, blame)
            elif busy_s > START_LIMIT_S:
                self._call_again(seat, blame)

    def _look(self, seat: Seat, backlog: Backlog, blame: Blame) -> None:
        """Replace a seat's actor if it hangs."""
        crumb, since = seat.look(self._underway)
        limit = START_LIMIT_S if crumb is None else self._limits.rollout_s + GRACE_S
        if time.monotonic() - since > limit:
            # A process that is stopped does not hear Ray.
            end_if_here(seat.process)
            reason = f"took more than {limit:g} s, and had to be killed"
            self._fail(seat, backlog, blame, Failure(reason, None, fault=True))

    def _call_again(self, seat: Seat, blame: Blame) -> None:
        """Give up an actor that has not come; that others work means that a machine is missing, which may come back."""
        self._dismiss(seat)
        if not any(other.process for other in self._seats):
            blame.charge_nobody(f"the start of its process took more than {START_LIMIT_S:g} s")

    def _note_done(self, seat: Seat, plan: Plan, receipt: Receipt) -> None:
        """Tell log and metrics of a shard."""
        self._metrics.add(plan, receipt)
        about = {"plan": plan.key, "policy": plan.policy_version, "shard": receipt.shard_id, "worker": seat.process}
        about |= {"interactions": receipt.interactions, "successes": receipt.successes}
        about |= {"seconds": receipt.seconds.get("total", 0.0)}
        logger.info("shard %s is committed", receipt.shard_id, extra=about)

    def _retire_if_grown(self, seat: Seat, receipt: Receipt) -> None:
        """Hand an actor no further jobs if its memory has grown by half of what it may grow by."""
        if seat.first_mb is None:
            seat.first_mb = receipt.memory_mb
        grown_mb = receipt.memory_mb - seat.first_mb
        if not seat.retiring and grown_mb > self._limits.memory_mb / 2:
            about = {"worker": seat.process, "shard": receipt.shard_id}
            logger.warning("a worker has grown by %.0f MB and is replaced", grown_mb, extra=about)
            seat.retiring = True

    def _fail(self, seat: Seat, backlog: Backlog, blame: Blame, failure: Failure, *, in_rollout: bool = True) -> None:
        """Replace the seat's actor and put its jobs back in front; only what was under way is to blame.

        Args:
            seat: whose actor failed.
            backlog: takes the jobs back.
            blame: decides what comes of them.
            failure: how; which rollout was under way is found here.
            in_rollout: whether that may be to blame.
        """
        orders = seat.orders
        crumb = self._underway.crumb_of(seat.process) if seat.process else None
        about = {"worker": seat.process, "rollout": crumb.rollout if crumb else None, "reason": failure.reason}
        logger.info("a worker is replaced: %s", failure.reason, extra=about)
        self._dismiss(seat)
        self._count_replaced("fault" if failure.fault else "loss")
        if not orders:
            blame.charge_nobody(failure.reason)
            return
        jobs = [order.job for order in orders]
        job = next((job for job in jobs if crumb is not None and crumb.shard_id == job.shard_id), jobs[0])
        known = crumb is not None and crumb.shard_id == job.shard_id and in_rollout
        blame.charge(job, replace(failure, rollout=crumb.rollout if known and crumb is not None else None))
        backlog.put_back(orders)

    def _count_replaced(self, cause: Cause) -> None:
        self.restarts += 1
        self._metrics.replaced(cause)

    def _dismiss(self, seat: Seat) -> None:
        """End the seat's actor and forget what it was given and what it left."""
        if seat.actor is not None:
            seat.actor.end()
        if seat.process:
            self._underway.forget(seat.process)
        self._in_flight -= len(seat.orders)
        seat.vacate()
        self._seats.file(seat)


def _require_own_node() -> None:
    """See that the node lives through which this process reaches Ray: its only one, if the session is our own.

    Ray itself takes a quarter of a minute to notice, and then ends this process without a word.

    Raises:
        WorkerError: it does not.
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
