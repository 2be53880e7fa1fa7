"""What a worker is asked to do with a job, and what it tells of it; neither an engine nor Ray is imported for it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from collector.watchdog import UnderWay
from shared.plan import Job, Plan


@dataclass(frozen=True, slots=True)
class JobResult:
    """What came of a job: counts and times, never data.

    Attributes:
        shard_id: the committed shard.
        rollouts: how many it holds.
        interactions: likewise.
        successes: likewise.
        outcomes: interactions by outcome kind.
        seconds: wall time by stage, and "total".
        quarantined: rollouts that were not executed, since they had failed again and again.
        memory_mb: what the worker's process held in the end.
        empty: by status and by object, rollouts that were executed and gave no interaction.
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
        """Execute and commit `job`; do nothing if that was done before. See `collector.worker.Worker.run`."""
        ...


WorkerFactory = Callable[[], JobWorker]
"""Makes a worker in the process that will use it; must be picklable for a worker group of processes."""
