"""Worker groups: whoever executes the jobs of a plan. The serial one here, the Ray one in `cluster.workers.ray_group`.

    fleet.load_policy(1, files)                    # once a version
    worker_group.run(queue, on_result=print)           # any number of times, on the same live workers
    fleet.close()

Jobs are idempotent by their shard: a worker that finds its shard committed does nothing. So a job may be submitted
again after any failure, and at-least-once delivery is enough.
"""

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from cluster.workers.job_queue import JobQueue, PlannedJob
from cluster.workers.retries import Backlog, Failure, RetryPolicy
from collector.job_result import JobResult, JobWorker, WorkerFactory
from shared.errors import AdaAffordError

WAIT_S = 0.5
"""How often a worker group that has nothing to do asks for orders."""

logger = logging.getLogger(__name__)


def make_worker(store: str | Path, objects: Path) -> JobWorker:
    """Make a `collector.worker.Worker` in the process that calls; `partial` of this is a `WorkerFactory`.

    The engine is imported here and not by the driver, which needs none where Ray's actors do the work.
    """
    from collector.worker import Worker

    return Worker(store, objects)


class WorkerGroup(Protocol):
    """Executes jobs on some number of workers."""

    workers: int
    """How many work at the same time."""
    restarts: int
    """How many workers were replaced so far."""

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Hand the weights of policy `version` to every worker, present and future."""
        ...

    def run(self, orders: JobQueue, on_result: Callable[[JobResult], None]) -> None:
        """Execute `orders` until they have ended, in any order, and report each once.

        They are taken no earlier than somebody is free for them, and asked for again where there is none yet. A rollout
        that fails again and again is given up and recorded as quarantined; see `cluster.workers.retries`.

        Raises:
            JobError: a job failed again and again, and no rollout of it was to blame.
            AdaAffordError: a worker met a problem that the user must solve; it is not tried again.
        """
        ...

    def close(self) -> None:
        """End the workers; whatever was not committed is lost, and nothing else is."""
        ...


class SerialWorkerGroup:
    """One worker in this very process, without Ray: the same code for debugging, tests and tiny machines.

    Rollouts that raise are quarantined as everywhere. One that crashes ends this process, and one that hangs is waited
    for, as in any program that is debugged; a worker group of processes survives both.
    """

    workers = 1

    def __init__(self, make_worker: WorkerFactory) -> None:
        self.restarts = 0
        self._make_worker = make_worker
        self._worker: JobWorker | None = None
        self._policies: dict[int, Mapping[str, bytes]] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """See `WorkerGroup.load_policy`."""
        self._policies[version] = files
        if self._worker is not None:
            self._worker.load_policy(version, files)

    def run(self, orders: JobQueue, on_result: Callable[[JobResult], None]) -> None:
        """See `WorkerGroup.run`."""
        retries = RetryPolicy()
        backlog = Backlog(orders, retries)
        while not backlog.ended:
            order = backlog.take(idle=True)
            if order is None:
                time.sleep(WAIT_S)
            elif (job_result := self._run(order, retries)) is None:
                backlog.put_back([order])
            else:
                on_result(job_result)

    def close(self) -> None:
        """See `WorkerGroup.close`."""
        self._worker = None

    def _run(self, order: PlannedJob, retries: RetryPolicy) -> JobResult | None:
        """Try a job; None if it failed, which takes a fresh worker the next time."""
        job = order.job
        rollouts: list[int | None] = [None]
        try:
            job_result = self._live_worker().run(order.plan, job, retries.quarantined(job), rollouts.append)
        except AdaAffordError:
            raise
        except Exception as error:
            logger.info("job %s failed", job.shard_id, exc_info=True)
            self._worker = None
            self.restarts += 1
            retries.record_failure(job, Failure.of_exception(error, rollouts[-1]))
            return None
        retries.reset(job)
        return job_result

    def _live_worker(self) -> JobWorker:
        """The worker, made and given all policies if there is none yet."""
        if self._worker is None:
            self._worker = self._make_worker()
            for version, files in self._policies.items():
                self._worker.load_policy(version, files)
        return self._worker
