"""Prometheus metrics of a worker group, through Ray's own exporter (in its full installation, `ray[default]`).

Labels are few and fixed: task, proposer, outcome, stage, cause. None is ever an object, a rollout, a shard or a worker,
of which there are millions.

    ray_adaafford_rollouts_total, ray_adaafford_quarantined_total           {task, proposer}
    ray_adaafford_interactions_total                                        {task, proposer, outcome}
    ray_adaafford_successes_total                                           {task, proposer}
    ray_adaafford_worker_seconds_total                                      {task, proposer, stage}
    ray_adaafford_restarts_total                                            {cause}: fault, loss, growth
    ray_adaafford_workers, ray_adaafford_policy                             gauges
"""

from typing import TYPE_CHECKING, Literal

from ray.util.metrics import Counter, Gauge

from shared.plan import Plan

if TYPE_CHECKING:
    from collector.job_result import JobResult

Cause = Literal["fault", "loss", "growth"]
"""Why a worker was replaced: of a rollout's making, killed from outside, or grown too large."""


class WorkerMetrics:
    """Counters of one driver, which start at 0 with its process, as Prometheus expects."""

    def __init__(self, workers: int) -> None:
        of_plan = ("task", "proposer")
        self._rollouts = Counter("adaafford_rollouts", "Rollouts committed.", of_plan)
        self._quarantined = Counter("adaafford_quarantined", "Rollouts given up.", of_plan)
        self._interactions = Counter("adaafford_interactions", "Interactions by outcome.", (*of_plan, "outcome"))
        self._successes = Counter("adaafford_successes", "Interactions that succeeded.", of_plan)
        self._seconds = Counter("adaafford_worker_seconds", "What workers spend their time on.", (*of_plan, "stage"))
        self._restarts = Counter("adaafford_restarts", "Workers that were replaced.", ("cause",))
        self._policy = Gauge("adaafford_policy", "Version of the policy of the last shard.", of_plan)
        self._workers = Gauge("adaafford_workers", "Workers that the driver keeps busy.")
        self._workers.set(workers)

    def add(self, plan: Plan, job_result: "JobResult") -> None:
        """Count a shard."""
        tags = {"task": plan.setting.task, "proposer": plan.proposer}
        for counter, amount in (
            (self._rollouts, job_result.rollouts),
            (self._quarantined, job_result.quarantined),
            (self._successes, job_result.successes),
        ):
            _increase(counter, amount, tags)
        for outcome, count in job_result.outcomes.items():
            _increase(self._interactions, count, {**tags, "outcome": outcome})
        for stage, seconds in job_result.seconds.items():
            _increase(self._seconds, seconds, {**tags, "stage": stage})
        self._policy.set(plan.policy_version, tags)

    def replaced(self, cause: Cause) -> None:
        """Count a worker that was replaced."""
        self._restarts.inc(1, {"cause": cause})


def _increase(counter: Counter, amount: float, tags: dict[str, str]) -> None:
    # Ray refuses to increase a counter by nothing.
    if amount > 0:
        counter.inc(amount, tags)
