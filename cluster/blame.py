"""Who is to blame for attempts that failed: jobs are tried again, and rollouts that fail too often are quarantined.

A *fault* is of the rollout's own making: its process crashed or hung, or it raised what no rollout may raise. A *loss*
is a process that ended without a word: killed from outside, gone with its machine, or taken by the kernel for want of
memory. Faults are deterministic, so few prove the case; losses happen to whoever is at work, so it takes many on one
rollout before it is suspected, and workers that are killed at random change nothing in what is collected.
"""

import logging
from collections import Counter
from dataclasses import dataclass

from shared.errors import WorkerError
from shared.plan import Job
from shared.redaction import without_secrets

MAX_FAULTS = 3
"""Attempts that a rollout may fail by itself: one for its own sake, two against bad luck of a machine."""
MAX_LOSSES = 10
"""Processes that may be lost over one rollout."""

logger = logging.getLogger(__name__)


class JobError(WorkerError):
    """A job failed as often as it may, and no rollout of it is to blame.

    Attributes:
        job: the job.
        reason: how it failed last, one line.
    """

    def __init__(self, job: Job, times: int, reason: str) -> None:
        super().__init__(f"job {job.shard_id} failed {times} times; last: {reason}")
        self.job = job
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Failure:
    """An attempt at a job that failed.

    Attributes:
        reason: one line.
        rollout: the one under way; None if none was.
        fault: whether it is of the job's own making.
    """

    reason: str
    rollout: int | None
    fault: bool


class Blame:
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

    def quarantined(self, job: Job) -> dict[int, str]:
        """Rollouts of the job that are not to be executed any more, and why."""
        if not self._quarantined:
            return {}
        keys = ((job.plan_key, rollout) for rollout in range(job.start, job.stop))
        return {key[1]: self._quarantined[key] for key in keys if key in self._quarantined}

    def acquit(self) -> None:
        """Take note that a job was done, so workers can live."""
        self._idle_losses = 0

    def charge_nobody(self, reason: str) -> None:
        """Count a process that was lost before it was given a job.

        Raises:
            WorkerError: so many were lost without a job being done meanwhile that none will live.
        """
        self._idle_losses += 1
        logger.warning("a worker was lost before it had a job (%s); trying again", reason, extra={"reason": reason})
        if self._idle_losses >= self._most_idle_losses:
            raise WorkerError(f"{self._idle_losses} workers were lost before they had a job; last: {reason}")

    def charge(self, job: Job, failure: Failure) -> None:
        """Count a failure of `job`, which is tried again: without the culprit if that failed often enough.

        Raises:
            JobError: it failed as often as it may, and not by one of its rollouts.
        """
        self._counts[job, failure.rollout, failure.fault] += 1
        count = self._counts[job, failure.rollout, failure.fault]
        if failure.rollout is None:
            self._charge_no_rollout(job, failure, count)
        elif count >= (MAX_FAULTS if failure.fault else MAX_LOSSES):
            self._quarantined[job.plan_key, failure.rollout] = f"{failure.reason} ({count} times)"
            about = {"shard": job.shard_id, "rollout": failure.rollout, "reason": failure.reason}
            logger.warning(
                "rollout %d is quarantined: %s, %d times", failure.rollout, failure.reason, count, extra=about
            )
            return
        what = "before its rollouts or after them" if failure.rollout is None else f"in rollout {failure.rollout}"
        about = {"shard": job.shard_id, "rollout": failure.rollout, "reason": failure.reason}
        logger.warning("job %s failed %s (%s); trying again", job.shard_id, what, failure.reason, extra=about)

    def _charge_no_rollout(self, job: Job, failure: Failure, count: int) -> None:
        if failure.fault and count >= MAX_FAULTS:
            raise JobError(job, count, failure.reason)
        # Whoever kills workers at random often meets one that is just starting, whichever job that is for.
        self._idle_losses += not failure.fault
        if self._idle_losses >= self._most_idle_losses:
            raise JobError(job, self._idle_losses, failure.reason)


def describe(error: BaseException) -> str:
    """An exception in one line of bounded length."""
    said = without_secrets(" ".join(str(error).split()))
    text = "".join(letter for letter in said if letter.isprintable())[:300]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
