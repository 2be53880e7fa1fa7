"""A worker without a simulator: touches a file a shard, and misbehaves where a file in the folder says so."""

import ctypes
import os
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from collector.job_result import JobResult
from collector.watchdog import UnderWay
from shared.errors import StoreError
from shared.plan import Job, Plan


@dataclass
class FakeWorker:
    """Behaviour by rollout number: files `crash-N`, `die-N`, `raise-N`, `hang-N` and so on hold how many more times."""

    folder: Path

    def __post_init__(self) -> None:
        self._versions: dict[int, bytes] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        self._versions[version] = files["weights.safetensors"]
        with (self.folder / f"pulled-{version}").open("a") as log:
            log.write(f"{os.getpid()}\n")

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> JobResult:
        with (self.folder / "begun").open("a") as log:
            log.write(f"{job.shard_id} {os.getpid()}\n")
        if plan.policy_version:
            assert self._versions[plan.policy_version] == b"weights %d" % plan.policy_version
        executed = [rollout for rollout in range(job.start, job.stop) if rollout not in quarantined]
        for rollout in executed:
            under_way(rollout)
            self._misbehave(rollout)
        under_way(None)
        for rollout, reason in quarantined.items():
            (self.folder / f"quarantined-{rollout}").write_text(reason)
        (self.folder / f"shard-{job.shard_id}").touch()
        return JobResult(
            job.shard_id,
            job.stop - job.start,
            4 * len(executed),
            len(executed),
            {"ok": 4 * len(executed)},
            {"total": 0.01},
            len(quarantined),
            5000.0 if self._take(f"grow-{job.start}", pause_s=0.0) else 100.0,
        )

    def _misbehave(self, rollout: int) -> None:
        if self._take(f"crash-{rollout}"):
            ctypes.string_at(0)
        if self._take(f"die-{rollout}"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self._take(f"raise-{rollout}"):
            raise RuntimeError("the engine\nexploded")
        if self._take(f"explode-{rollout}"):
            bytearray(1 << 40)
        if self._take(f"hang-{rollout}"):
            # Unlike CDLL, PyDLL keeps the interpreter's lock, as the engine does.
            ctypes.PyDLL(None).sleep(60)
        if self._take(f"stop-{rollout}"):
            os.kill(os.getpid(), signal.SIGSTOP)
        if self._take(f"refuse-{rollout}"):
            raise StoreError("the store is damaged")

    def _take(self, name: str, pause_s: float = 0.2) -> bool:
        """Whether to misbehave now, and not before `pause_s`."""
        path = self.folder / name
        left = int(path.read_text()) if path.exists() else 0
        if left:
            path.write_text(str(left - 1))
            # A real worker takes seconds to begin; by then the actor's word that it is up has reached the driver.
            time.sleep(pause_s)
        return left > 0
