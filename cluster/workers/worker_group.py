"""Worker groups, which execute jobs: the serial one here, and the one of Ray actors in `cluster.workers.ray_group`.

    worker_group.load_policy(1, files)          # once for each version
    worker_group.run(queue, on_result=print)    # any number of times, on the same live workers
    worker_group.close()

A job is idempotent: a worker does nothing if the shard of the job is already committed. So a job may be submitted again
after any failure, and at-least-once delivery is enough.
"""

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from cluster.workers.job_queue import JobQueue, PlannedJob
from cluster.workers.retries import Failure, RetryPolicy, RetryQueue
from collector.job_result import JobResult, JobWorker, WorkerFactory
from shared.errors import AdaAffordError

WAIT_S = 0.5
"""How often an idle worker group asks for jobs."""

logger = logging.getLogger(__name__)


def make_worker(store: str | Path, objects: Path) -> JobWorker:
    """Make a `collector.worker.Worker` in the calling process; a `partial` of this is a `WorkerFactory`.

    The engine is imported here, because the driver of Ray actors does not need it.
    """
    from collector.worker import Worker

    return Worker(store, objects)


class WorkerGroup(Protocol):
    """Executes jobs on some number of workers."""

    workers: int
    """How many workers run at the same time."""
    restarts: int
    """How many workers were replaced so far."""

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Give the weights of policy `version` to all present and future workers."""
        ...

    def run(self, queue: JobQueue, on_result: Callable[[JobResult], None]) -> None:
        """Execute the jobs of `queue` until it has ended, in any order, and report each result once.

        A job is taken from the queue only when a worker is free. If the queue has none yet, it is asked again later. A
        rollout that fails repeatedly is quarantined; see `cluster.workers.retries`.

        Raises:
            JobError: a job failed repeatedly, and none of its rollouts was the cause.
            AdaAffordError: a worker met a problem that the user must solve; there is no retry.
        """
        ...

    def close(self) -> None:
        """End the workers; only rollouts that are not committed are lost."""
        ...


class SerialWorkerGroup(WorkerGroup):
    """One worker in this process, without Ray, for debugging, tests and small machines.

    Rollouts that raise are quarantined as usual. One that crashes ends this process, and one that hangs blocks it; a
    worker group of processes survives both.
    """

    workers = 1

    def __init__(self, make_worker: WorkerFactory) -> None:
        self.restarts = 0
        self._make_worker = make_worker
        self._worker: JobWorker | None = None
        self._policies: dict[int, Mapping[str, bytes]] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        self._policies[version] = files
        if self._worker is not None:
            self._worker.load_policy(version, files)

    def run(self, queue: JobQueue, on_result: Callable[[JobResult], None]) -> None:
        retries = RetryPolicy()
        backlog = RetryQueue(queue, retries)
        while not backlog.ended:
            planned = backlog.take(idle=True)
            if planned is None:
                time.sleep(WAIT_S)
            elif (job_result := self._run(planned, retries)) is None:
                backlog.put_back([planned])
            else:
                on_result(job_result)

    def close(self) -> None:
        self._worker = None

    def _run(self, planned: PlannedJob, retries: RetryPolicy) -> JobResult | None:
        """Execute a job; None if it failed. The next job then gets a new worker."""
        job = planned.job
        rollouts: list[int | None] = [None]
        try:
            job_result = self._live_worker().run(planned.plan, job, retries.quarantined(job), rollouts.append)
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
        """The worker; it is created with all policies if there is none yet."""
        if self._worker is None:
            self._worker = self._make_worker()
            for version, files in self._policies.items():
                self._worker.load_policy(version, files)
        return self._worker
