"""A worker without a simulator: touches a file a shard, and misbehaves where a file in the folder says so."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.errors import StoreError
from shared.plan import Job, Plan


@dataclass(frozen=True, slots=True)
class FakeReceipt:
    """The fields of `collector.worker.Receipt`, whose module takes seconds to import in each actor."""

    shard_id: str
    rollouts: int
    interactions: int
    successes: int
    outcomes: dict[str, int]
    seconds: dict[str, float]


@dataclass
class FakeWorker:
    """Behaviour by rollout number: files `die-N`, `raise-N`, `hang-N`, `refuse-N` hold how many more times."""

    folder: Path

    def __post_init__(self) -> None:
        self._versions: dict[int, bytes] = {}

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        self._versions[version] = files["weights.safetensors"]
        with (self.folder / f"pulled-{version}").open("a") as log:
            log.write(f"{os.getpid()}\n")

    def run(self, plan: Plan, job: Job) -> FakeReceipt:
        with (self.folder / "begun").open("a") as log:
            log.write(f"{job.shard_id} {os.getpid()}\n")
        if plan.policy_version:
            assert self._versions[plan.policy_version] == b"weights %d" % plan.policy_version
        if self._take(f"die-{job.start}"):
            os._exit(1)
        if self._take(f"raise-{job.start}"):
            raise RuntimeError("the engine\nexploded")
        if self._take(f"hang-{job.start}"):
            time.sleep(60)
        if self._take(f"refuse-{job.start}"):
            raise StoreError("the store is damaged")
        (self.folder / f"shard-{job.shard_id}").touch()
        rollouts = job.stop - job.start
        return FakeReceipt(job.shard_id, rollouts, 4 * rollouts, rollouts, {"ok": 4 * rollouts}, {"total": 0.01})

    def _take(self, name: str) -> bool:
        """Whether to misbehave now."""
        path = self.folder / name
        left = int(path.read_text()) if path.exists() else 0
        if left:
            path.write_text(str(left - 1))
        return left > 0
