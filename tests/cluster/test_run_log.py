"""The run log and the stages: done once, timed over all attempts, whatever a kill leaves."""

import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.campaign.campaign import Campaign
from cluster.runs.run_folder import find
from cluster.runs.run_log import BEAT_SHARE, RunLog, pause_s
from tests.support.finished_run import make_finished_run
from tests.support.synced import Synced
from tests.support.waiting import wait_until


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


Stages = dict[str, Callable[[], Mapping[str, Any]]]


def stage(name: str, log: list[str], clock: FakeClock, fails: bool = False) -> Stages:
    def run() -> Mapping[str, Any]:
        clock.now += 10
        log.append(name)
        if fails:
            raise RuntimeError("killed")
        return {"made": name}

    return {name: run}


def abc(log: list[str], clock: FakeClock) -> Stages:
    return stage("a", log, clock) | stage("b", log, clock) | stage("c", log, clock)


def test_each_stage_runs_once_however_often_the_run_stops(tmp_path: Path) -> None:
    log: list[str] = []
    clock, said = FakeClock(), list[str]()
    stages = stage("a", log, clock) | stage("b", log, clock, fails=True) | stage("c", log, clock)
    for _ in range(2):
        with pytest.raises(RuntimeError):
            RunLog(tmp_path / "log.jsonl", clock).run(stages, said.append)
    stages |= stage("b", log, clock)
    RunLog(tmp_path / "log.jsonl", clock).run(stages, said.append)
    RunLog(tmp_path / "log.jsonl", clock).run(stages, said.append)
    assert log == ["a", "b", "b", "b", "c"]
    assert said[-1] == "done before: a, b, c"


def test_wall_time_is_added_up_over_attempts(tmp_path: Path) -> None:
    clock, log = FakeClock(), list[str]()
    with pytest.raises(RuntimeError):
        RunLog(tmp_path / "log.jsonl", clock).run(stage("b", log, clock, fails=True), log.append)
    run_log = RunLog(tmp_path / "log.jsonl", clock)
    run_log.run(stage("b", log, clock), log.append)
    assert run_log.seconds == {"b": 20.0} == RunLog(tmp_path / "log.jsonl").seconds
    assert run_log.result("b") == {"made": "b"} == RunLog(tmp_path / "log.jsonl").result("b")


@given(cut=st.integers(min_value=0, max_value=2000))
def test_a_torn_log_loses_at_most_its_last_line(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    path = tmp_path_factory.mktemp("ledger") / "log.jsonl"
    clock = FakeClock()
    RunLog(path, clock).run(abc([], clock), lambda line: None)
    whole = path.read_bytes()
    path.write_bytes(whole[: min(cut, len(whole))])
    before = RunLog(path, clock).finished
    assert before == tuple("abc")[: len(before)]
    assert len(before) >= path.read_bytes().count(b'"done"') - 1
    log: list[str] = []
    RunLog(path, clock).run(abc(log, clock), lambda line: None)
    assert (*before, *log) == ("a", "b", "c") == RunLog(path).finished


def test_a_stage_under_way_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster.runs.run_log.BEAT_S", 0.01)
    path, clock = tmp_path / "log.jsonl", FakeClock()
    seen: list[float] = []

    def run() -> Mapping[str, Any]:
        clock.now = 7.0
        wait_until(lambda: RunLog(path).seconds.get("a") == 7.0)
        seen.append(RunLog(path).seconds["a"])
        return {}

    RunLog(path, clock).run({"a": run}, lambda line: None)
    assert seen == [7.0]


def test_a_log_of_months_by_older_software_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    beat = b'{"time": 1700000000.123, "event": "beat", "stage": "collect-random", "seconds": %d.0}\n'
    with path.open("wb") as file:
        file.write(b'{"time": 1.0, "event": "attempt", "workers": 2, "software": {"numpy": "1"}}\n')
        file.write(b'{"time": 1.0, "event": "done", "stage": "objects", "seconds": 2.5, "result": {"train": 3}}\n')
        file.writelines(beat % second for second in range(100_000))
        file.write(b'{"time": 2.0, "event": "attempt", "workers": 2, "software": {"numpy": "2"}}\n')
        file.write(beat % 1_000_000)
        file.write(b'{"time": 2.0, "event": "be')
    tracemalloc.start()
    run_log = RunLog(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert run_log.seconds == {"objects": 2.5, "collect-random": 1_000_000.0}
    assert run_log.finished == ("objects",) and run_log.result("objects") == {"train": 3}
    assert run_log.software == ({"numpy": "1"}, {"numpy": "2"})
    assert most < path.stat().st_size / 16


def test_a_stage_of_a_year_is_noted_less_than_two_thousand_times() -> None:
    spent, notes = 0.0, 0
    while spent < 365 * 86400:
        pause = pause_s(spent)
        assert pause <= max(5.0, BEAT_SHARE * spent)
        spent, notes = spent + pause, notes + 1
    assert notes < 2000


def test_a_log_that_cannot_be_written_for_a_while_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cluster.runs.run_log.BEAT_S", 0.01)
    run_log, failed = RunLog(tmp_path / "log.jsonl"), list[str]()
    note = run_log.note

    def full(event: str, **details: Any) -> None:
        if event == "beat" and not failed:
            failed.append(event)
            raise OSError(28, "No space left on device")
        note(event, **details)

    monkeypatch.setattr(run_log, "note", full)

    def run() -> Mapping[str, Any]:
        wait_until(lambda: bool(failed))
        return {}

    run_log.run({"a": run}, lambda line: None)
    assert run_log.finished == ("a",)
    assert "Traceback" not in capfd.readouterr().err


def test_a_new_log_survives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced = Synced(monkeypatch)
    RunLog(tmp_path / "log.jsonl").note("attempt")
    assert synced.lacks(tmp_path) == [str(tmp_path.parent)]


def test_a_run_that_goes_on_removes_what_killed_workers_left_in_a_store_that_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_finished_run(tmp_path / "run", objects=2)
    code = (
        "import sys; from shared.store import Store; from shared.store.crash_log import Heartbeat\n"
        "log = Store.open(sys.argv[1]).crash_log; log.open_fault_log().close()\n"
        "log.leave(Heartbeat(shard_id='a', rollout=1))"
    )
    subprocess.run([sys.executable, "-c", code, str(run.store)], check=True)
    assert len(list((run.store / "underway").iterdir())) == 2
    monkeypatch.setattr(RunLog, "run", lambda *_: None)
    monkeypatch.setattr("cluster.reporting.printed.print_report", lambda _: None)
    Campaign(*find(run.path)).execute()
    assert list((run.store / "underway").iterdir()) == []
