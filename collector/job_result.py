"""The interface of a worker, and the result of a job; this module imports neither an engine nor Ray."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from collector.watchdog import UnderWay
from shared.plan import Job, Plan


@dataclass(frozen=True, slots=True)
class JobResult:
    """The result of a job: counts and times, never data.

    Attributes:
        shard_id: the committed shard.
        rollouts: how many it has.
        interactions: how many it has.
        successes: how many of them succeeded.
        outcomes: interactions by outcome kind.
        seconds: wall time by stage, and "total".
        quarantined: rollouts that were not executed, because they had failed repeatedly.
        memory_mb: memory of the worker's process at the end, MB.
        empty: number of rollouts that were executed without an interaction, by status and object.
    """

    shard_id: str
    rollouts: int
    interactions: int
    successes: int
    outcomes: dict[str, int]
    seconds: dict[str, float]
    quarantined: int = 0
    memory_mb: float = 0.0
    empty: dict[str, dict[str, int]] = field(default_factory=dict)


class JobWorker(Protocol):
    """Executes jobs: `collector.worker.Worker`, or a fake in tests."""

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Make the policy `version` ready for plans that use it."""
        ...

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> JobResult:
        """Execute and commit `job`; do nothing if it is already committed. See `collector.worker.Worker.run`."""
        ...


WorkerFactory = Callable[[], JobWorker]
"""Makes a worker in the process that will use it; must be picklable for a worker group of processes."""
