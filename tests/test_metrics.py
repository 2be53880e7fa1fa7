"""Metrics count what receipts say, under labels that are few whatever is collected."""

from collections import Counter as Tally
from typing import Any, ClassVar

import pytest

from cluster import metrics
from cluster.metrics import FleetMetrics
from collector.receipt import Receipt
from shared.plan import Plan
from tests.fabricate import fabricate_setting

LABELS = {"task", "proposer", "outcome", "stage", "cause"}
PLAN = Plan(setting=fabricate_setting(), proposer="aip", policy_version=3)


class Recorded:
    """What was counted, of all metrics."""

    values: ClassVar[Tally[tuple[str, ...]]] = Tally()

    def __init__(self, name: str, description: str, tag_keys: tuple[str, ...] = ()) -> None:
        assert name.startswith("adaafford_") and description.endswith(".")
        assert set(tag_keys) <= LABELS
        self.name, self.tag_keys = name, tag_keys

    def inc(self, value: float, tags: dict[str, str]) -> None:
        assert value > 0, "Ray refuses to increase a counter by nothing"
        self.values[self._key(tags)] += value

    def set(self, value: float, tags: dict[str, str] | None = None) -> None:
        self.values[self._key(tags or {})] = value

    def _key(self, tags: dict[str, str]) -> tuple[str, ...]:
        assert tuple(tags) == self.tag_keys
        return (self.name, *tags.values())


@pytest.fixture
def values(monkeypatch: pytest.MonkeyPatch) -> Tally[tuple[str, ...]]:
    monkeypatch.setattr(Recorded, "values", Tally())
    for kind in ("Counter", "Gauge"):
        monkeypatch.setattr(metrics, kind, Recorded)
    return Recorded.values


def receipt(**over: Any) -> Receipt:
    given: dict[str, Any] = {
        "shard_id": "aip-v3-00000000-00000004",
        "rollouts": 4,
        "interactions": 32,
        "successes": 8,
        "outcomes": {"ok": 30, "no_contact": 2},
        "seconds": {"physics": 1.5, "total": 2.0, "write": 0.0},
    }
    return Receipt(**given | over)


def test_receipts_add_up(values: Tally[tuple[str, ...]]) -> None:
    fleet = FleetMetrics(workers=7)
    for _ in range(3):
        fleet.add(PLAN, receipt())
    fleet.add(PLAN, receipt(successes=0, quarantined=1, outcomes={"ok": 0}))
    fleet.replaced("loss")
    assert values == {
        ("adaafford_workers",): 7,
        ("adaafford_policy", "push", "aip"): 3,
        ("adaafford_rollouts", "push", "aip"): 16,
        ("adaafford_quarantined", "push", "aip"): 1,
        ("adaafford_successes", "push", "aip"): 24,
        ("adaafford_interactions", "push", "aip", "ok"): 90,
        ("adaafford_interactions", "push", "aip", "no_contact"): 6,
        ("adaafford_worker_seconds", "push", "aip", "physics"): 6.0,
        ("adaafford_worker_seconds", "push", "aip", "total"): 8.0,
        ("adaafford_restarts", "loss"): 1,
    }


def test_what_is_told_does_not_grow_with_what_is_collected(values: Tally[tuple[str, ...]]) -> None:
    fleet = FleetMetrics(workers=2)
    fleet.add(PLAN, receipt())
    series = set(values)
    for number in range(100):
        plan = PLAN.model_copy(update={"policy_version": number})
        fleet.add(plan, receipt(shard_id=f"aip-v{number}-00000000-00000004"))
    assert set(values) == series
