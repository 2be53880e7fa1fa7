"""Watchdog of a worker process: heartbeat, crash traceback, time and memory limits.

    watchdog = Watchdog(crash_log, limits)
    watchdog.stand()                           # once, before anything that could crash
    with watchdog.job(job) as under_way:
        under_way(17)                          # before each rollout; None before and after them

The engine is native code: it can crash, and it holds the interpreter's lock while it steps, so that no thread of Python
could see that it hangs. `faulthandler` needs no lock: its handlers write the traceback of a crash, and its watchdog is
a thread of C that writes the tracebacks of a hang and then ends the process.
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
"""Called with a rollout's number before it is executed, and with None when none is under way."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a worker's process may take.

    Attributes:
        rollout_s: wall time of one rollout.
        memory_mb: what it may take beyond what it had after its start.
    """

    rollout_s: float = 300.0
    memory_mb: float = 2000.0


class Watchdog:
    """Stands over this process, which does nothing else than execute jobs.

    Args:
        crash_log: where heartbeats and crash log go.
        limits: what a rollout may take.
    """

    def __init__(self, crash_log: CrashLog, limits: Limits) -> None:
        self._crash_log = crash_log
        self._limits = limits

    def stand(self) -> None:
        """Write down crashes from now on."""
        # Kept open, since a handler of signals cannot open files.
        self._log = self._crash_log.open_fault_log()
        faulthandler.enable(self._log, all_threads=False)

    def bound_memory(self) -> None:
        """Make allocations beyond the limit fail, so that a rollout that explodes cannot take the machine with it.

        The bound is on private writable memory: address space alone says nothing, since Ray and PyTorch reserve
        gigabytes that they never touch.
        """
        taken = psutil.Process().memory_info().data
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        bound = taken + round(self._limits.memory_mb * 2**20)
        resource.setrlimit(resource.RLIMIT_DATA, (bound if hard < 0 else min(bound, hard), hard))

    @contextmanager
    def job(self, job: Job) -> Iterator[UnderWay]:
        """Gives what to call before each rollout of a job; the last heartbeat stays, as it is overwritten anyway."""

        def under_way(rollout: int | None) -> None:
            self._crash_log.leave(Heartbeat(shard_id=job.shard_id, rollout=rollout, written=time.time()))
            faulthandler.dump_traceback_later(self._limits.rollout_s, exit=True, file=self._log)

        try:
            yield under_way
        finally:
            faulthandler.cancel_dump_traceback_later()
