"""The real worker, whose rollouts come out of thin air instead of an engine, and end badly where they are told to."""

import ctypes
import errno
import os
import signal
from collections.abc import Mapping
from pathlib import Path

from collector.sim.simulator import StageClock
from collector.worker import Worker
from shared.plan import Plan, RolloutRecord
from tests.support.fabricate import fabricate_rollout


class MisbehavingWorker(Worker):
    """A worker to whom something happens in some rollouts, whenever they are executed.

    Args:
        store: the store's place.
        mishaps: "crash", "hang", "raise", "library", "disk" or "kill", by rollout.
    """

    def __init__(self, store: Path, mishaps: Mapping[int, str]) -> None:
        super().__init__(store, Path("objects"))
        self._mishaps = mishaps

    def execute(self, plan: Plan, index: int, clock: StageClock) -> RolloutRecord:
        match self._mishaps.get(index):
            case "crash":
                ctypes.string_at(0)
            case "hang":
                # Unlike CDLL, PyDLL keeps the interpreter's lock, as the engine does.
                ctypes.PyDLL(None).sleep(600)
            case "raise":
                raise RuntimeError("the engine\nexploded")
            case "library":
                raise ModuleNotFoundError("No module named 'coacd'")
            case "disk":
                raise OSError(errno.ENOSPC, "No space left on device")
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
        return fabricate_rollout(plan, index, interactions=4)
