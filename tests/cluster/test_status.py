"""`adaafford status` and the log: they tell what is on the disk, ask nobody, and believe no file."""

import io
import json
import logging
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.commands.status import as_json, table
from cluster.cli.main import run
from cluster.collection.status_writer import (
    RECENT_S,
    SILENT_S,
    CollectionProgress,
    DriverStatus,
    State,
    read_status,
    status_kept,
)
from cluster.runs.run_log import RunLog
from cluster.runs.status_snapshot import snapshot_of
from cluster.runs.streams import JsonLines, Lines, configure
from collector.job_result import JobResult
from shared.errors import UsageError
from shared.io.files import host_name, process_name
from shared.plan import Job, Plan
from shared.store import Store, verify
from shared.store.crash_log import Heartbeat
from shared.store.provenance import note_machine
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.waiting import wait_until

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)


def status_of(state: str = "collecting", written: float = 1000.0, process: str = "elsewhere") -> DriverStatus:
    return DriverStatus(
        process=process,
        written=written,
        state=state,  # type: ignore[arg-type]
        title="aip-latest",
        policy=3,
        done=30,
        total=50,
        elapsed_s=10.0,
        rollouts=20,
        interactions=400,
        successes=100,
        outcomes={"ok": 300, "no_contact": 100},
        quarantined=1,
        recent_per_s=35.0,
        workers=2,
        restarts=4,
    )


def fill(where: str) -> Store:
    store = Store.create(where, SETTING)
    for job in (Job(PLAN.key, 0, 2), Job(PLAN.key, 4, 6)):
        store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
    store.publish_policy(3, {"weights.safetensors": b"weights"})
    return store


def written(store: Store, status: DriverStatus) -> None:
    store.backend.replace("status/driver.json", status.model_dump_json().encode())


def test_a_store_says_what_is_done_and_left(where: str, capsys: pytest.CaptureFixture[str]) -> None:
    store = fill(where)
    store.crash_log.leave(Heartbeat(shard_id="aip-v3-00000004-00000008", rollout=5))
    written(store, status_of(written=time.time()))
    assert run(["status", where, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["stores"][0]
    assert told["rollouts"] == {"random-v0": 4}
    assert told["policies"] == [3]
    worker = {"process": process_name(), "host": "", "shard_id": "aip-v3-00000004-00000008", "rollout": 5}
    assert told["workers"] == [worker]
    driver = told["driver"]
    assert (driver["left"], driver["left_s"], driver["success_rate"], driver["per_s"]) == (20, 10.0, 0.25, 40.0)
    assert told["driver_alive"]
    assert run(["status", where, "--once"]) == 0
    shown = capsys.readouterr().out
    assert "30 of 50 rollouts, 20 left, 0:10 to go" in shown
    assert "35.0 interactions/s of late, 40.0 in all" in shown
    assert "2, 4 replaced; 1 rollouts quarantined" in shown
    assert "rollout 5" in shown
    note_machine(store.backend)
    assert snapshot_of(where).stores[0].workers[0].host == host_name()
    written(store, status_of(written=time.time() + 3600))
    assert run(["status", where, "--once"]) == 0
    assert "its driver is gone, written by a clock that is " in capsys.readouterr().out
    store.crash_log.forget(process_name())
    assert verify(store) == [], "how it stands is no data, and no stranger either"


def test_a_status_is_replaced_as_a_whole_and_leaves_the_digest_alone(where: str) -> None:
    store = fill(where)
    digest = store.digest()
    for done in (1, 10_000, 2):
        written(store, status_of().model_copy(update={"done": done}))
        found = read_status(store.backend)
        assert found is not None and found.done == done
    assert store.digest() == digest


@pytest.mark.parametrize("content", [b"", b"{", b"null", b"[]", b'{"process": 1}', b"\xff" * 100, b" " * (1 << 17)])
def test_a_damaged_status_is_none(where: str, content: bytes) -> None:
    store = fill(where)
    store.backend.replace("status/driver.json", content)
    assert read_status(store.backend) is None
    assert snapshot_of(where).stores[0].driver is None


def test_a_driver_is_dead_when_it_says_so_or_nothing_more_or_its_process_is_gone() -> None:
    assert status_of().is_alive(1000.0 + SILENT_S - 1)
    for now in (1000.0 + SILENT_S, 1000.0 - SILENT_S):
        assert not status_of().is_alive(now), "a clock that was so far ahead would make a driver immortal"
    for state in ("done", "stopped"):
        assert not status_of(state).is_alive(1000.0)
    assert status_of("waiting").is_alive(1000.0)
    gone = process_name().rpartition("~")[0] + "~1"
    assert not status_of(process=gone).is_alive(1000.0)
    assert status_of(process=process_name()).is_alive(1000.0)


def test_the_keeper_writes_while_it_works_says_when_it_waits_and_how_it_ended(tmp_path: Path) -> None:
    store = fill(str(tmp_path / "store"))
    said: list[str] = []
    waiting = False
    keeper = status_kept(store.backend, lambda state: status_of(state), lambda: waiting, said.append, beat_s=0.01)

    def wait_for(state: str) -> None:
        wait_until(lambda: (found := read_status(store.backend)) is not None and found.state == state)

    with pytest.raises(KeyboardInterrupt), keeper:
        wait_for("collecting")
        waiting = True
        wait_for("waiting")
        raise KeyboardInterrupt
    wait_for("stopped")
    assert len(said) == 1 and said[0].startswith("waiting for a newer policy in ")


def test_a_status_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    store, states = fill(str(tmp_path / "store")), list[str]()
    (store.path / "status").write_text("a file in the place of the folder")

    def status(state: State) -> DriverStatus:
        states.append(state)
        return status_of(state)

    with status_kept(store.backend, status, lambda: False, lambda line: None, beat_s=0.01):
        wait_until(lambda: len(states) > 1)
    assert {*states[:-1]} == {"collecting"} and states[-1] == "done", "it was tried again, and once more in the end"
    assert read_status(store.backend) is None
    assert (store.path / "status").read_text() == "a file in the place of the folder"


def test_a_run_says_its_stages_and_its_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{}")
    run_log = RunLog(tmp_path / "log.jsonl")
    with run_log.stage("objects") as done:
        done({})
    run_log.note("beat", stage="train-prior", seconds=65.0)
    fill(str(tmp_path / "store"))
    stage = tmp_path / "training" / "prior"
    stage.mkdir(parents=True)
    (stage / "metrics.jsonl").write_text('{"stage": "prior", "step": 50, "score": 0.5}\n{"stage": "prior", "st')
    snapshot = snapshot_of(str(tmp_path))
    assert (snapshot.stages_done, snapshot.stage, snapshot.stage_s) == (("objects",), "train-prior", 65.0)
    assert snapshot.training is not None
    assert (snapshot.training.stage, snapshot.training.step) == ("prior", 50)
    assert run(["status", str(tmp_path)]) == 0
    assert "train-prior, 1:05" in capsys.readouterr().out
    assert json.loads(json.dumps(as_json(snapshot)))["stores"][0]["driver"] is None


def test_what_is_none_of_these_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="no run, store or learner's folder"):
        snapshot_of(str(tmp_path))
    assert run(["status", str(tmp_path / "none")]) == 2
    assert run(["status", str(tmp_path), "--every", "0"]) == 2


def test_text_from_files_is_no_markup(tmp_path: Path) -> None:
    from rich.console import Console

    store = fill(str(tmp_path / "store"))
    written(store, status_of().model_copy(update={"title": "[red]aip[/]\x1b]0;owned\x07"}))
    console = Console(record=True, width=200, file=io.StringIO())
    console.print(table(snapshot_of(store.where), 1000.0))
    text = console.export_text()
    assert "[red]aip[/]" in text
    assert "\x1b" not in text and "\x07" not in text


@given(st.lists(st.tuples(st.floats(0.0, 20.0), st.integers(0, 100)), max_size=20))
def test_the_recent_rate_counts_the_last_half_minute(job_results: list[tuple[float, int]]) -> None:
    now = 0.0
    progress = CollectionProgress("t", 0, 10, "S", lambda: now)
    for pause, count in job_results:
        now += pause
        progress(JobResult("s", 0, count, 0, {}, {}))
    moments = [sum(pause for pause, _ in job_results[: k + 1]) for k in range(len(job_results))]
    counted = sum(count for moment, (_, count) in zip(moments, job_results, strict=True) if now - moment < RECENT_S)
    assert progress.recent_per_s * max(min(now, RECENT_S), 1e-9) == pytest.approx(counted)


def test_a_log_line_is_one_json_object_that_names_rollout_and_worker() -> None:
    record = logging.LogRecord("cluster.workers.retries", logging.WARNING, "f", 1, "job %s\nfailed", ("x",), None)
    record.rollout, record.worker, record.secret = 17, "host~1~2", "not for the log"
    line = JsonLines().format(record)
    assert "\n" not in line
    told = json.loads(line)
    assert (told["rollout"], told["worker"], told["message"], told["level"]) == (
        17,
        "host~1~2",
        "job x\nfailed",
        "warning",
    )
    assert "secret" not in told


def test_logging_is_for_people_unless_machines_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, list[logging.Handler]]] = []
    monkeypatch.setattr(logging, "basicConfig", lambda **options: given.append(options))
    configure({})
    (handler,) = given[0]["handlers"]  # type: ignore[misc]
    assert isinstance(handler.formatter, Lines)
    levels = {name: logging.getLogger(name).level for name in ("cluster", "collector", "learner", "shared")}
    try:
        configure({"ADAAFFORD_LOG": "json"})
        assert logging.getLogger("cluster").level == logging.INFO
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
    (handler,) = given[1]["handlers"]
    assert isinstance(handler.formatter, JsonLines)
