"""Watchdog of a worker process: heartbeat, crash traceback, time and memory limits.

    watchdog = Watchdog(crash_log, limits)
    watchdog.install()                         # once, before anything that could crash
    with watchdog.job(job) as under_way:
        under_way(17)                          # before each rollout; None before and after them

The engine is native code. It can crash, and it holds the interpreter lock during a step, so a Python thread cannot
detect a hang. `faulthandler` does not need the lock: its signal handlers write the traceback of a crash, and its
watchdog is a C thread that writes the traceback of a hang and then ends the process.
"""

import faulthandler
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psutil

from shared.plan import Job
from shared.store.crash_log import CrashLog, Heartbeat

UnderWay = Callable[[int | None], None]
"""Called with a rollout's number before it is executed, and with None when no rollout is running."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a worker's process.

    Attributes:
        rollout_s: wall time of one rollout, s.
        memory_mb: growth of its memory since its start, MB.
    """

    rollout_s: float = 300.0
    memory_mb: float = 2000.0


class Watchdog:
    """Watches this process, which only executes jobs."""

    def __init__(self, crash_log: CrashLog, limits: Limits) -> None:
        self._crash_log = crash_log
        self._limits = limits

    def install(self) -> None:
        """Write the traceback of every crash from now on."""
        # The file stays open, because a signal handler cannot open files.
        self._log = self._crash_log.open_fault_log()
        faulthandler.enable(self._log, all_threads=False)

    def bound_memory(self) -> None:
        """Make allocations beyond the limit fail, so that one rollout cannot exhaust the memory of the machine.

        The limit is on private writable memory and not on address space, because Ray and PyTorch reserve gigabytes of
        address space that they never use.
        """
        taken = psutil.Process().memory_info().data
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        bound = taken + round(self._limits.memory_mb * 2**20)
        resource.setrlimit(resource.RLIMIT_DATA, (bound if hard < 0 else min(bound, hard), hard))

    @contextmanager
    def job(self, job: Job) -> Iterator[UnderWay]:
        """Give the function to call before each rollout of a job; the last heartbeat is not removed."""

        def under_way(rollout: int | None) -> None:
            self._crash_log.leave(Heartbeat(shard_id=job.shard_id, rollout=rollout, written=time.time()))
            faulthandler.dump_traceback_later(self._limits.rollout_s, exit=True, file=self._log)

        try:
            yield under_way
        finally:
            faulthandler.cancel_dump_traceback_later()
