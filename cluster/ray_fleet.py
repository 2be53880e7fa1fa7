"""The fleet of Ray actors: bounded work in flight, dead and hung actors replaced, only receipts coming back."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import ray
from ray.exceptions import RayActorError, RayTaskError

from cluster.fleet import MAX_ATTEMPTS, JobError, WorkerFactory, describe
from collector.actor import WorkerActor
from shared.errors import AdaAffordError
from shared.plan import Job, Plan

if TYPE_CHECKING:
    from collector.worker import Receipt

IN_FLIGHT = 2
"""Jobs an actor holds: one under way, one that waits so that the actor never idles for the driver's sake."""
START_LIMIT_S = 120.0
"""An actor's process imports an engine and PyTorch, which a busy machine or a cold disk may slow; no job's fault."""
POLL_S = 1.0
"""How often the driver looks for hung actors when no receipt comes."""

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Seat:
    """A place for one actor, and what it was given to do, oldest first."""

    actor: Any = None
    arrival: Any = None
    """What becomes ready when the actor's process is up; None from then on."""
    pending: deque[tuple[Any, Job]] = field(default_factory=deque)
    busy_since: float = 0.0
    """When the actor was started, or the oldest pending job came to the head; `time.monotonic`."""


class RayFleet:
    """Actors of `collector.actor`, one CPU each, alive over all rounds. Needs a session (`cluster.session`)."""

    def __init__(self, make_worker: WorkerFactory, workers: int, job_limit_s: float) -> None:
        """Start nothing yet: actors come up with the first jobs.

        Args:
            make_worker: makes the worker within an actor.
            workers: how many actors.
            job_limit_s: an actor whose job takes longer is taken for hung. The engine holds the interpreter's lock
                while it steps, so no watchdog within the actor could notice.
        """
        self.workers = workers
        self._make_worker = make_worker
        self._job_limit_s = job_limit_s
        self._seats = [_Seat() for _ in range(workers)]
        self._policies: dict[int, Any] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """See `Fleet.load_policy`: one `ray.put`; actors pull it when a plan first needs it."""
        if version not in self._policies:
            self._policies[version] = ray.put(dict(files))

    def run(self, plan: Plan, jobs: Sequence[Job], on_receipt: Callable[["Receipt"], None]) -> None:
        """See `Fleet.run`."""
        waiting = deque(jobs)
        attempts: Counter[Job] = Counter()
        try:
            while waiting or any(seat.pending for seat in self._seats):
                self._hand_out(plan, waiting)
                # A seat whose actor is still on its way has nothing else that could be ready.
                refs = [seat.arrival or seat.pending[0][0] for seat in self._seats if seat.pending]
                ready, _ = ray.wait(refs, num_returns=1, timeout=min(POLL_S, self._job_limit_s / 4))
                if ready:
                    self._take_in(ready[0], waiting, attempts, on_receipt)
                self._replace_hung(waiting, attempts)
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

    def _hand_out(self, plan: Plan, waiting: deque[Job]) -> None:
        """Give each actor up to `IN_FLIGHT` jobs; no actor gets a second one while another has none."""
        policy = self._policies.get(plan.policy_version)
        box = [] if policy is None else [policy]
        for depth in range(IN_FLIGHT):
            for seat in self._seats:
                if not waiting:
                    return
                if len(seat.pending) == depth:
                    if seat.actor is None:
                        self._start(seat)
                    if not seat.pending:
                        seat.busy_since = time.monotonic()
                    job = waiting.popleft()
                    seat.pending.append((seat.actor.run.remote(plan, job, box), job))

    def _take_in(
        self, ref: Any, waiting: deque[Job], attempts: Counter[Job], on_receipt: Callable[["Receipt"], None]
    ) -> None:
        """Report the receipt behind `ref`, or see to the failure that it stands for."""
        seat = next(seat for seat in self._seats if seat.pending and ref in (seat.arrival, seat.pending[0][0]))
        job = seat.pending[0][1]
        try:
            receipt = ray.get(ref)
        except RayActorError as error:
            self._retry(seat, waiting, attempts, f"its process died ({describe(error)})")
            return
        except RayTaskError as error:
            if isinstance(error.cause, AdaAffordError):
                raise error.cause from None
            self._settle(seat)
            self._count(job, attempts, describe(error.cause or error))
            waiting.appendleft(job)
            return
        if seat.arrival is not None:
            seat.arrival, seat.busy_since = None, time.monotonic()
            return
        self._settle(seat)
        on_receipt(receipt)

    def _replace_hung(self, waiting: deque[Job], attempts: Counter[Job]) -> None:
        """Replace actors whose oldest job is over the limit."""
        for seat in self._seats:
            limit = self._job_limit_s if seat.arrival is None else START_LIMIT_S
            if seat.pending and time.monotonic() - seat.busy_since > limit:
                doing = "it" if seat.arrival is None else "the start of its process"
                self._retry(seat, waiting, attempts, f"{doing} took more than {limit:g} s")

    def _retry(self, seat: _Seat, waiting: deque[Job], attempts: Counter[Job], reason: str) -> None:
        """Replace the seat's actor and put its jobs back in front; only the oldest one is to blame."""
        jobs = [job for _, job in seat.pending]
        self._dismiss(seat)
        waiting.extendleft(reversed(jobs))
        self._count(jobs[0], attempts, reason)

    def _count(self, job: Job, attempts: Counter[Job], reason: str) -> None:
        """Count a failure of `job` and give up after `MAX_ATTEMPTS`."""
        attempts[job] += 1
        if attempts[job] >= MAX_ATTEMPTS:
            raise JobError(job, reason)
        logger.warning("job %s failed (%s); trying again", job.shard_id, reason)

    def _start(self, seat: _Seat) -> None:
        """Seat a new actor. No restarts by Ray: those would run only `__init__` again, and lose what was in flight."""
        seat.actor = ray.remote(num_cpus=1, max_restarts=0)(WorkerActor).remote(self._make_worker)
        seat.arrival = seat.actor.arrive.remote()

    @staticmethod
    def _settle(seat: _Seat) -> None:
        """Strike out the oldest pending job; the next one comes to the head."""
        seat.pending.popleft()
        seat.busy_since = time.monotonic()

    @staticmethod
    def _dismiss(seat: _Seat) -> None:
        """End the seat's actor and forget what it was given."""
        if seat.actor is not None:
            ray.kill(seat.actor)
        seat.actor = seat.arrival = None
        seat.pending.clear()
