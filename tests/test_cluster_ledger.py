"""The ledger and the stages: done once, timed over all attempts, whatever a kill leaves."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.ledger import Ledger
from cluster.stages import Stage, run_stages


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def stage(name: str, log: list[str], clock: FakeClock, fails: bool = False) -> Stage:
    def run() -> Mapping[str, Any]:
        clock.now += 10
        log.append(name)
        if fails:
            raise RuntimeError("killed")
        return {"made": name}

    return Stage(name, run)


def test_each_stage_runs_once_however_often_the_run_stops(tmp_path: Path) -> None:
    log: list[str] = []
    clock, said = FakeClock(), list[str]()
    stages = [stage("a", log, clock), stage("b", log, clock, fails=True), stage("c", log, clock)]
    for _ in range(2):
        with pytest.raises(RuntimeError):
            run_stages(stages, Ledger(tmp_path / "log.jsonl", clock), said.append)
    stages[1] = stage("b", log, clock)
    run_stages(stages, Ledger(tmp_path / "log.jsonl", clock), said.append)
    run_stages(stages, Ledger(tmp_path / "log.jsonl", clock), said.append)
    assert log == ["a", "b", "b", "b", "c"]
    assert said[-1] == "done before: a, b, c"


def test_wall_time_is_added_up_over_attempts(tmp_path: Path) -> None:
    clock, log = FakeClock(), list[str]()
    with pytest.raises(RuntimeError):
        run_stages([stage("b", log, clock, fails=True)], Ledger(tmp_path / "log.jsonl", clock), log.append)
    ledger = Ledger(tmp_path / "log.jsonl", clock)
    run_stages([stage("b", log, clock)], ledger, log.append)
    assert ledger.seconds == {"b": 20.0} == Ledger(tmp_path / "log.jsonl").seconds
    assert ledger.result("b") == {"made": "b"} == Ledger(tmp_path / "log.jsonl").result("b")


@given(cut=st.integers(min_value=0, max_value=2000))
def test_a_torn_log_loses_at_most_its_last_line(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    path = tmp_path_factory.mktemp("ledger") / "log.jsonl"
    clock = FakeClock()
    run_stages([stage(name, [], clock) for name in "abc"], Ledger(path, clock), lambda line: None)
    whole = path.read_bytes()
    path.write_bytes(whole[: min(cut, len(whole))])
    before = Ledger(path, clock).finished
    assert before == tuple("abc")[: len(before)]
    assert len(before) >= path.read_bytes().count(b'"done"') - 1
    log: list[str] = []
    run_stages([stage(name, log, clock) for name in "abc"], Ledger(path, clock), lambda line: None)
    assert (*before, *log) == ("a", "b", "c") == Ledger(path).finished


def test_a_stage_under_way_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster.ledger.BEAT_S", 0.01)
    path, clock = tmp_path / "log.jsonl", FakeClock()
    seen: list[float] = []

    def run() -> Mapping[str, Any]:
        clock.now = 7.0
        wait_until(lambda: Ledger(path).seconds.get("a") == 7.0)
        seen.append(Ledger(path).seconds["a"])
        return {}

    run_stages([Stage("a", run)], Ledger(path, clock), lambda line: None)
    assert seen == [7.0]


def wait_until(true: Callable[[], bool]) -> None:
    import time

    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.005)
