"""Metrics count what job results say, under labels that are few whatever is collected."""

from collections import Counter as Tally
from typing import Any

import pytest
from ray.util.metrics import Gauge, Metric

from cluster.workers import ray_group
from cluster.workers.ray_group import WorkerMetrics
from collector.job_result import JobResult
from shared.plan import Plan
from shared.types import OutcomeKind
from tests.support.fabricate import fabricate_setting

LABELS = {"task", "proposer", "outcome", "stage", "cause"}
PLAN = Plan(setting=fabricate_setting(), proposer="aip", policy_version=3)


@pytest.fixture
def values(monkeypatch: pytest.MonkeyPatch) -> Tally[tuple[str, ...]]:
    """What Ray's own metrics were given, by the metric's name and its labels, after Ray had checked both."""
    found: Tally[tuple[str, ...]] = Tally()
    record = Metric._record

    def note(metric: Metric, value: float, tags: dict[str, str] | None = None) -> None:
        record(metric, value, tags)
        name, labels = metric.info["name"], tuple((tags or {}).values())
        assert f"ray_{name}" in str(ray_group.__doc__)
        assert tuple(tags or {}) == metric.info["tag_keys"] and set(tags or {}) <= LABELS
        found[name, *labels] = value + (0 if isinstance(metric, Gauge) else found[name, *labels])

    monkeypatch.setattr(Metric, "_record", note)
    return found


def job_result(**over: Any) -> JobResult:
    given: dict[str, Any] = {
        "shard_id": "aip-v3-00000000-00000004",
        "rollouts": 4,
        "interactions": 32,
        "successes": 8,
        "outcomes": {OutcomeKind.OK.value: 30, OutcomeKind.NO_CONTACT.value: 2},
        "seconds": {"simulate": 1.5, "total": 2.0, "write": 0.0},
    }
    return JobResult(**given | over)


def test_job_results_add_up(values: Tally[tuple[str, ...]]) -> None:
    worker_group = WorkerMetrics(workers=7)
    for _ in range(3):
        worker_group.add(PLAN, job_result())
    worker_group.add(PLAN, job_result(successes=0, quarantined=1, outcomes={"ok": 0}))
    worker_group.replaced("loss")
    assert values == {
        ("adaafford_workers",): 7,
        ("adaafford_policy", "push", "aip"): 3,
        ("adaafford_rollouts", "push", "aip"): 16,
        ("adaafford_quarantined", "push", "aip"): 1,
        ("adaafford_successes", "push", "aip"): 24,
        ("adaafford_interactions", "push", "aip", "ok"): 90,
        ("adaafford_interactions", "push", "aip", "no-contact"): 6,
        ("adaafford_worker_seconds", "push", "aip", "simulate"): 6.0,
        ("adaafford_worker_seconds", "push", "aip", "total"): 8.0,
        ("adaafford_restarts", "loss"): 1,
    }


def test_what_is_told_does_not_grow_with_what_is_collected(values: Tally[tuple[str, ...]]) -> None:
    worker_group = WorkerMetrics(workers=2)
    worker_group.add(PLAN, job_result())
    series = set(values)
    for number in range(100):
        plan = PLAN.model_copy(update={"policy_version": number})
        worker_group.add(plan, job_result(shard_id=f"aip-v{number}-00000000-00000004"))
    assert set(values) == series
