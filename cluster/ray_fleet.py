"""The fleet of Ray actors: bounded work in flight, dead and hung actors replaced, only receipts coming back."""

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import ray
from ray.exceptions import RayError, RayTaskError

from cluster.blame import Blame, Failure, describe
from cluster.fleet import WAIT_S, WorkerFactory
from cluster.metrics import Cause, FleetMetrics
from cluster.orders import Order, Orders
from collector.actor import WorkerActor
from collector.guard import Limits
from shared.errors import AdaAffordError
from shared.files import end_if_here
from shared.plan import Plan
from shared.underway import Crumb, Underway

if TYPE_CHECKING:
    from collector.worker import Receipt

IN_FLIGHT = 2
"""Jobs an actor holds: one under way, one that waits so that the actor never idles for the driver's sake."""
START_LIMIT_S = 120.0
"""An actor's process imports an engine and PyTorch, which a busy machine or a cold disk may slow; no job's fault."""
GRACE_S = 5.0
"""What an actor's own watchdog, which leaves a traceback, has in advance of the driver, which cannot."""
LOST = "its process was lost without a word: killed from outside, or for want of memory"
KEPT_POLICIES = 3
"""Versions that the object store holds; older ones were replaced, and only jobs that failed may want them again."""
POLL_S = 1.0
"""How often the driver looks for hung actors, however many receipts come."""

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Seat:
    """A place for one actor, and what it was given to do, oldest first."""

    actor: Any = None
    arrival: Any = None
    """What becomes ready when the actor's process is up; None from then on."""
    process: str = ""
    """By which name its breadcrumbs go; "" until it is up."""
    pending: deque[tuple[Any, Order]] = field(default_factory=deque)
    busy_since: float = 0.0
    """When the actor was started, or the oldest pending job came to the head; `time.monotonic`."""
    seen: tuple[Crumb | None, float] | None = None
    """The last breadcrumb that was looked at, and since when it has been the same."""
    first_mb: float | None = None
    """What the process held after its first job."""
    retiring: bool = False
    """Whether it is only to finish what it has."""

    def settle(self) -> Order:
        """Strike out the oldest pending job, and return it; the next one comes to the head."""
        _, order = self.pending.popleft()
        self.busy_since, self.seen = time.monotonic(), None
        return order

    def look(self, underway: Underway) -> tuple[Crumb | None, float]:
        """The breadcrumb of the rollout under way, and since when it has been seen unchanged."""
        crumb = underway.crumb_of(self.process)
        if self.seen is None or self.seen[0] != crumb:
            self.seen = crumb, time.monotonic()
        return self.seen

    def vacate(self) -> None:
        """Forget the actor and all that was about it."""
        self.actor = self.arrival = self.seen = self.first_mb = None
        self.process, self.retiring = "", False
        self.pending.clear()


class RayFleet:
    """Actors of `collector.actor`, one CPU each, alive over all rounds. Needs a session (`cluster.session`)."""

    def __init__(self, make_worker: WorkerFactory, underway: Underway, workers: int, limits: Limits) -> None:
        """Start nothing yet: actors come up with the first jobs.

        Args:
            make_worker: makes the worker within an actor.
            underway: where actors leave their breadcrumbs.
            workers: how many actors.
            limits: what a rollout may take; an actor that goes beyond is ended.
        """
        self.workers = workers
        self.restarts = 0
        self._make_worker = make_worker
        self._underway = underway
        self._limits = limits
        self._poll_s = min(POLL_S, limits.rollout_s / 4)
        self._looked = time.monotonic()
        self._seats = [_Seat() for _ in range(workers)]
        self._policies: dict[int, Any] = {}
        self._metrics = FleetMetrics(workers)

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """See `Fleet.load_policy`: one `ray.put`; actors pull it when a plan first needs it."""
        if version not in self._policies:
            while len(self._policies) >= KEPT_POLICIES:
                self._policies.pop(next(iter(self._policies)))
            self._policies[version] = ray.put(dict(files))

    def run(self, orders: Orders, on_receipt: Callable[["Receipt"], None]) -> None:
        """See `Fleet.run`."""
        waiting: deque[Order] = deque()
        blame = Blame(self.workers)
        try:
            while waiting or not orders.ended or any(seat.pending for seat in self._seats):
                self._hand_out(orders, waiting, blame)
                # A seat whose actor is still on its way has nothing else that could be ready.
                refs = [seat.arrival or seat.pending[0][0] for seat in self._seats if seat.pending]
                if not refs:
                    time.sleep(WAIT_S)
                    continue
                ready, _ = ray.wait(refs, num_returns=1, timeout=self._poll_s)
                if ready:
                    self._take_in(ready[0], waiting, blame, on_receipt)
                self._replace_hung(waiting, blame)
        finally:
            # Only after a failure or an interrupt is anything left; what an actor would still commit is wanted by the
            # next run anyway, but nobody would wait for it, so the actor goes.
            for seat in self._seats:
                if seat.pending:
                    self._dismiss(seat)

    def close(self) -> None:
        """See `Fleet.close`."""
        for seat in self._seats:
            self._dismiss(seat)

    def _hand_out(self, orders: Orders, waiting: deque[Order], blame: Blame) -> None:
        """Give each actor up to `IN_FLIGHT` jobs; no actor gets a second one while another has none.

        Args:
            orders: where new ones come from.
            waiting: those that failed, which go first.
            blame: knows what is not to be executed any more.
        """
        for seat in self._seats:
            if seat.retiring and not seat.pending:
                self._dismiss(seat)
                self._count_replaced("growth")
        for depth in range(IN_FLIGHT):
            for seat in self._seats:
                if len(seat.pending) == depth and not seat.retiring:
                    order = waiting.popleft() if waiting else orders.take()
                    if order is None:
                        return
                    self._give(seat, order, blame)

    def _give(self, seat: _Seat, order: Order, blame: Blame) -> None:
        """Submit an order to the seat's actor, which is started if there is none."""
        if seat.actor is None:
            self._start(seat)
        if not seat.pending:
            seat.busy_since = time.monotonic()
        # Of a version that is no longer kept, the worker reads the weights in the store.
        policy = self._policies.get(order.plan.policy_version)
        box = [] if policy is None else [policy]
        ref = seat.actor.run.remote(order.plan, order.job, box, blame.quarantined(order.job))
        seat.pending.append((ref, order))

    def _take_in(self, ref: Any, waiting: deque[Order], blame: Blame, on_receipt: Callable[["Receipt"], None]) -> None:
        """Report the receipt behind `ref`, or see to the failure that it stands for."""
        seat = next(seat for seat in self._seats if seat.pending and ref in (seat.arrival, seat.pending[0][0]))
        try:
            message = ray.get(ref)
        except RayTaskError as error:
            if isinstance(error.cause, AdaAffordError):
                raise error.cause from None
            self._fail(seat, waiting, blame, describe(error.cause or error), fault=True)
            return
        except RayError:
            words = self._underway.fault_of(seat.process)
            self._fail(seat, waiting, blame, words or LOST, fault=bool(words))
            return
        if seat.arrival is not None:
            seat.arrival, seat.process, seat.busy_since = None, message, time.monotonic()
            logger.info("a worker is up", extra={"worker": seat.process})
            return
        order = seat.settle()
        blame.acquit()
        self._note_done(seat, order.plan, message)
        self._retire_if_grown(seat, message)
        on_receipt(message)

    def _replace_hung(self, waiting: deque[Order], blame: Blame) -> None:
        """Replace actors that hang so thoroughly that not even their own watchdog ended them.

        A rollout is over its limit when the driver has seen its breadcrumb unchanged for so long by its own clock:
        clocks of machines differ.
        """
        if time.monotonic() - self._looked < self._poll_s:
            return
        self._looked = time.monotonic()
        for seat in self._seats:
            if not seat.pending:
                continue
            if seat.arrival is not None:
                if time.monotonic() - seat.busy_since > START_LIMIT_S:
                    reason = f"the start of its process took more than {START_LIMIT_S:g} s"
                    self._fail(seat, waiting, blame, reason, fault=False)
            elif time.monotonic() - seat.busy_since > self._limits.rollout_s:
                crumb, since = seat.look(self._underway)
                limit = START_LIMIT_S if crumb is None else self._limits.rollout_s + GRACE_S
                if time.monotonic() - since > limit:
                    # A process that is stopped does not hear Ray.
                    end_if_here(seat.process)
                    self._fail(seat, waiting, blame, f"took more than {limit:g} s, and had to be killed", fault=True)

    def _note_done(self, seat: _Seat, plan: Plan, receipt: "Receipt") -> None:
        """Tell log and metrics of a shard."""
        self._metrics.add(plan, receipt)
        about = {"plan": plan.key, "policy": plan.policy_version, "shard": receipt.shard_id, "worker": seat.process}
        about |= {"interactions": receipt.interactions, "successes": receipt.successes}
        about |= {"seconds": receipt.seconds.get("total", 0.0)}
        logger.info("shard %s is committed", receipt.shard_id, extra=about)

    def _retire_if_grown(self, seat: _Seat, receipt: "Receipt") -> None:
        """Hand an actor no further jobs if its memory has grown by half of what it may grow by."""
        if seat.first_mb is None:
            seat.first_mb = receipt.memory_mb
        grown_mb = receipt.memory_mb - seat.first_mb
        if not seat.retiring and grown_mb > self._limits.memory_mb / 2:
            about = {"worker": seat.process, "shard": receipt.shard_id}
            logger.warning("a worker has grown by %.0f MB and is replaced", grown_mb, extra=about)
            seat.retiring = True

    def _fail(self, seat: _Seat, waiting: deque[Order], blame: Blame, reason: str, *, fault: bool) -> None:
        """Replace the seat's actor and put its jobs back in front; only what was under way is to blame."""
        orders = [order for _, order in seat.pending]
        jobs = [order.job for order in orders]
        crumb = self._underway.crumb_of(seat.process)
        about = {"worker": seat.process, "rollout": crumb.rollout if crumb else None, "reason": reason}
        logger.info("a worker is replaced: %s", reason, extra=about)
        self._dismiss(seat)
        self._count_replaced("fault" if fault else "loss")
        waiting.extendleft(reversed(orders))
        job = next((job for job in jobs if crumb is not None and crumb.shard_id == job.shard_id), jobs[0])
        known = crumb is not None and crumb.shard_id == job.shard_id
        blame.charge(job, Failure(reason, crumb.rollout if known and crumb is not None else None, fault))

    def _count_replaced(self, cause: Cause) -> None:
        self.restarts += 1
        self._metrics.replaced(cause)

    def _start(self, seat: _Seat) -> None:
        """Seat a new actor. No restarts by Ray: those would run only `__init__` again, and lose what was in flight."""
        actor = ray.remote(num_cpus=1, max_restarts=0)(WorkerActor)
        seat.actor = actor.remote(self._make_worker, self._underway, self._limits)
        seat.arrival = seat.actor.arrive.remote()

    def _dismiss(self, seat: _Seat) -> None:
        """End the seat's actor and forget what it was given and what it left."""
        if seat.actor is not None:
            ray.kill(seat.actor)
        if seat.process:
            self._underway.forget(seat.process)
        seat.vacate()
