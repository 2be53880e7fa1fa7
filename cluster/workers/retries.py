"""Retries: jobs that failed are executed again, and rollouts that fail too often are quarantined.

A *fault* is caused by the rollout: its process crashed or hung, or it raised an unexpected exception. A *loss* is a
process that ended without a traceback: it was killed from outside, its machine was lost, or the kernel was out of
memory. Faults are deterministic, so a few suffice for quarantine. Losses can hit any running rollout, so one is only
quarantined after many of them, and random kills of workers do not change the data.

Quarantine is for rollouts, and not for an environment in which none can succeed (a missing library, a full disk, a
limit that is too low). So a rollout is quarantined only after another rollout has succeeded. Until then its job is held
back (`RetryQueue`). If several rollouts fail in the same way before that, the collection ends and stores none of them.
"""

import logging
import re
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from cluster.workers.job_queue import JobQueue, PlannedJob
from shared.errors import WorkerError
from shared.io.text import plain, without_secrets
from shared.plan import Job

MAX_FAULTS = 3
"""Faults of one rollout until it is quarantined; the retries exclude accidents of a machine."""
MAX_LOSSES = 10
"""Losses in one rollout until it is quarantined."""
MAX_ALIKE = 3
"""Different rollouts with the same failure until the environment is taken for the cause: without a success in between,
or with no more successes than such failures in total."""

logger = logging.getLogger(__name__)


class JobError(WorkerError):
    """A job failed too often, and none of its rollouts is the cause."""

    def __init__(self, job: Job, message: str) -> None:
        super().__init__(message)
        self.job = job


@dataclass(frozen=True, slots=True)
class Failure:
    """A failed attempt at a job.

    Attributes:
        reason: one line.
        rollout: the one that was running; None if none was.
        fault: whether the job caused it; otherwise it is a loss.
    """

    reason: str
    rollout: int | None
    fault: bool

    @property
    def kind(self) -> str:
        """The reason without what differs between rollouts: numbers, and where in the code it happened."""
        return re.sub(r"\d+", "#", self.reason.partition(", in ")[0])

    @classmethod
    def of_exception(cls, error: BaseException, rollout: int | None) -> "Failure":
        """What a worker raised while a rollout was under way."""
        return cls(describe(error), None if of_environment(error) else rollout, fault=True)


class RetryPolicy:
    """Counts the failures of jobs.

    Args:
        workers: how many may be lost at the same time through no fault of a job.
    """

    def __init__(self, workers: int = 1) -> None:
        self._counts: Counter[tuple[Job, int | None, bool]] = Counter()
        self._idle_losses = 0
        self._most_idle_losses = MAX_LOSSES * workers
        self._quarantined: dict[tuple[str, int], str] = {}
        """By plan and rollout."""
        self._alike: Counter[str] = Counter()
        """Rollouts to quarantine, by kind of failure."""
        self._since_success: dict[tuple[str, int], str] = {}
        """Those of them that no success has followed, and their kinds of failure."""
        self._succeeded = 0
        """Rollouts that were executed, at least."""

    def quarantined(self, job: Job) -> dict[int, str]:
        """Rollouts of the job that are not to be executed any more, and why."""
        if not self._quarantined:
            return {}
        keys = ((job.plan_key, rollout) for rollout in range(job.start, job.stop))
        return {key[1]: self._quarantined[key] for key in keys if key in self._quarantined}

    def reset(self, job: Job) -> None:
        """Record a finished job: workers can start and rollouts can succeed."""
        self._idle_losses = 0
        self._note_success(job.stop - job.start - len(self.quarantined(job)))

    def _note_success(self, rollouts: int) -> None:
        if rollouts:
            self._succeeded += rollouts
            self._since_success.clear()

    def is_suspended(self, job: Job) -> bool:
        """Whether a rollout of the job is to be quarantined, and no rollout has succeeded since its failure."""
        return any((job.plan_key, rollout) in self._since_success for rollout in self.quarantined(job))

    def record_harmless(self, reason: str) -> None:
        """Count a process that was lost before it got a job.

        Raises:
            WorkerError: too many were lost without a finished job in between.
        """
        self._idle_losses += 1
        logger.warning("a worker was lost before it had a job (%s); trying again", reason, extra={"reason": reason})
        if self._idle_losses >= self._most_idle_losses:
            raise WorkerError(f"{self._idle_losses} workers were lost before they had a job; last: {reason}")

    def record_failure(self, job: Job, failure: Failure) -> None:
        """Count a failure of `job`, which is then executed again, without a rollout that failed too often.

        Raises:
            JobError: it failed too often outside of its rollouts; or different rollouts fail in the same way.
        """
        self._counts[job, failure.rollout, failure.fault] += 1
        if failure.rollout is not None:
            # The rollouts of a job are executed in order, so one before the one that failed succeeded.
            given_up = sum(rollout < failure.rollout for rollout in self.quarantined(job))
            self._note_success(min(failure.rollout - job.start - given_up, 1))
        count = self._counts[job, failure.rollout, failure.fault]
        if failure.rollout is None:
            self._charge_no_rollout(job, failure, count)
        elif count >= (MAX_FAULTS if failure.fault else MAX_LOSSES):
            self._quarantined[job.plan_key, failure.rollout] = f"{failure.reason} ({count} times)"
            self._alike[failure.kind] += 1
            self._since_success[job.plan_key, failure.rollout] = failure.kind
            self._require_environment(job, failure)
            about = {"shard": job.shard_id, "rollout": failure.rollout, "reason": failure.reason}
            logger.warning(
                "rollout %d is to be quarantined: %s, %d times", failure.rollout, failure.reason, count, extra=about
            )
            return
        what = "before its rollouts or after them" if failure.rollout is None else f"in rollout {failure.rollout}"
        about = {"shard": job.shard_id, "rollout": failure.rollout, "reason": failure.reason}
        logger.warning("job %s failed %s (%s); trying again", job.shard_id, what, failure.reason, extra=about)

    def _require_environment(self, job: Job, failure: Failure) -> None:
        in_a_row = list(self._since_success.values()).count(failure.kind)
        alike = self._alike[failure.kind]
        if in_a_row >= MAX_ALIKE or alike >= max(MAX_ALIKE, self._succeeded):
            raise JobError(
                job,
                f"{max(in_a_row, MAX_ALIKE)} different rollouts failed in the same way ({failure.reason}), so "
                "this machine, a setting or an object is the cause; none of them is stored: correct it and give the "
                "same command again, with --retry-quarantined if `adaafford store info` lists others",
            )

    def require_any_success(self, job: Job, *, ever: bool) -> None:
        """Check that a rollout has succeeded before the last job is committed with quarantined rollouts only.

        Args:
            job: the job, which has rollouts to quarantine.
            ever: whether rollouts succeeded before this attempt.

        Raises:
            JobError: no rollout ever succeeded.
        """
        given_up = self.quarantined(job)
        if not ever and not self._succeeded and len(given_up) == job.stop - job.start:
            rollout, reason = next(iter(given_up.items()))
            raise JobError(
                job,
                f"no rollout succeeded, and rollout {rollout} failed again and again: {reason}; nothing was stored: "
                "correct the cause and give the same command again",
            )

    def _charge_no_rollout(self, job: Job, failure: Failure, count: int) -> None:
        if failure.fault and count >= MAX_FAULTS:
            raise JobError(job, f"job {job.shard_id} failed {count} times; last: {failure.reason}")
        # Random kills often hit a worker that is just starting; this says nothing about its job.
        self._idle_losses += not failure.fault
        if self._idle_losses >= self._most_idle_losses:
            raise JobError(job, f"job {job.shard_id} failed {self._idle_losses} times; last: {failure.reason}")


def of_environment(error: BaseException) -> bool:
    """Whether a library or a file is missing, which no rollout causes."""
    return isinstance(error, OSError | ImportError)


class RetryQueue:
    """Jobs to hand out: first failed ones, then new ones, and last those with a rollout to quarantine.

    Args:
        queue: gives the new ones.
        retries: knows which rollouts are to be quarantined.
    """

    def __init__(self, queue: JobQueue, retries: RetryPolicy) -> None:
        self._queue = queue
        self._retries = retries
        self._again: deque[PlannedJob] = deque()
        self._suspended: deque[PlannedJob] = deque()

    def __len__(self) -> int:
        """How many failed or waiting jobs are to be handed out next."""
        return len(self._again)

    @property
    def ended(self) -> bool:
        """Whether no more jobs follow, unless one that is in flight fails."""
        return not self._again and not self._suspended and self._queue.ended

    def append(self, planned: PlannedJob) -> None:
        """Add a job to those that are handed out next."""
        self._again.append(planned)

    def put_back(self, planned_jobs: Sequence[PlannedJob]) -> None:
        """Take back failed jobs, in front of the others."""
        for planned in reversed(planned_jobs):
            (self._suspended if self._retries.is_suspended(planned.job) else self._again).appendleft(planned)

    def take(self, *, idle: bool) -> PlannedJob | None:
        """The next job; None if there is none, or none yet.

        Args:
            idle: whether no job is in flight that could still succeed.

        Raises:
            JobError: all remaining rollouts would be quarantined, and none ever succeeded.
        """
        return self._again.popleft() if self._again else self.take_new(idle=idle)

    def take_new(self, *, idle: bool) -> PlannedJob | None:
        """The next job after those that failed or wait; see `take`."""
        if self._suspended and not self._retries.is_suspended(self._suspended[0].job):
            return self._suspended.popleft()
        planned = self._queue.take()
        if planned is None and self._suspended and idle:
            self._retries.require_any_success(self._suspended[0].job, ever=self._queue.any_done)
            return self._suspended.popleft()
        return planned


def describe(error: BaseException) -> str:
    """An exception in one line of bounded length."""
    text = plain(without_secrets(" ".join(str(error).split())), 300)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
