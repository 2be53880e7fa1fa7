"""Rollouts that crash, hang or fail again and again: they cost themselves alone, and never become a label."""

import json
import logging
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from cluster.cli.main import run as adaafford
from cluster.collection.driver import Collected, collect
from cluster.workers.retries import MAX_FAULTS, MAX_LOSSES, Failure, JobError, RetryPolicy
from cluster.workers.session import worker_groups
from cluster.workers.worker_group import SerialWorkerGroup
from collector.job_result import JobResult
from collector.watchdog import Limits
from learner.data.dataset import load_dataset
from shared.errors import StoreError, WorkerError
from shared.io.files import process_name
from shared.plan import Job, Plan, RolloutStatus
from shared.store import Quarantined, Store, compact, verify
from shared.store.crash_log import CrashLog, Heartbeat, summary_of
from shared.store.maintenance import compaction
from tests.support.fabricate import fabricate_rollout, fabricate_setting
from tests.support.misbehaving_worker import MisbehavingWorker
from tests.support.small_networks import TINY

OBJECTS = Path("objects")
ROLLOUTS, PER_SHARD = 12, 4
JOB = Job("random-v0", 4, 8)
FAULT = Failure("Segmentation fault", 5, fault=True)
LOSS = Failure("lost", 5, fault=False)


def new_store(path: Path) -> Store:
    return Store.create(path, fabricate_setting())


def fill(
    store: Store, mishaps: Mapping[int, str], per_shard: int = PER_SHARD, *, retry_quarantined: bool = False
) -> Collected:
    worker_group = SerialWorkerGroup(partial(MisbehavingWorker, store.path, mishaps))
    plan = Plan(setting=store.setting)
    return collect(store, plan, ROLLOUTS, per_shard, lambda: worker_group, OBJECTS, retry_quarantined=retry_quarantined)


def rollout_digests(store: Store) -> dict[int, str]:
    return {index: digest for shard in store.committed() for index, digest in enumerate(shard.digests, shard.start)}


def assert_only_these_are_missing(disturbed: Store, undisturbed: Store, culprits: set[int]) -> None:
    """Everything else is as it would have been; of the culprits there is a row that says so, and nothing to learn."""
    ours, theirs = rollout_digests(disturbed), rollout_digests(undisturbed)
    assert ours.keys() == theirs.keys()
    assert {index for index in ours if ours[index] != theirs[index]} == culprits
    status = dict(zip(*(disturbed.rollouts().column(n).to_pylist() for n in ("rollout", "status")), strict=True))
    assert {index for index, word in status.items() if word == "quarantined"} == culprits
    assert not culprits & set(disturbed.interactions(["rollout"]).column("rollout").to_pylist())
    assert {each.rollout for shard in disturbed.committed() for each in shard.quarantined} == culprits
    assert verify(disturbed) == []
    assert list(disturbed.crash_log.folder.glob("*")) == []


def test_a_rollout_that_always_raises_is_given_up_and_nothing_else(tmp_path: Path) -> None:
    disturbed, undisturbed = new_store(tmp_path / "disturbed"), new_store(tmp_path / "undisturbed")
    collected = fill(disturbed, {5: "raise", 6: "raise"})
    fill(undisturbed, {})
    assert collected.tally.quarantined == 2
    assert len(load_dataset(disturbed, TINY).rollouts) == ROLLOUTS - 2
    assert collected.tally.rollouts == ROLLOUTS
    assert_only_these_are_missing(disturbed, undisturbed, {5, 6})


@pytest.mark.parametrize(
    ("mishap", "per_shard"),
    [("raise", 1), ("raise", 4), ("raise", 12), ("library", 1), ("library", 12), ("disk", 4)],
)
def test_an_environment_in_which_nothing_succeeds_ends_the_collection_and_leaves_nothing(
    tmp_path: Path, mishap: str, per_shard: int
) -> None:
    store = new_store(tmp_path)
    with pytest.raises(WorkerError) as failure:
        fill(store, dict.fromkeys(range(ROLLOUTS), mishap), per_shard)
    said = "3 different rollouts failed in the same way" if mishap == "raise" else "failed 3 times; last: "
    assert said in str(failure.value)
    assert "reproduce it with: adaafford store replay" in str(failure.value)
    assert store.jobs() == []
    assert fill(store, {}, per_shard).tally.rollouts == ROLLOUTS


@pytest.mark.parametrize("per_shard", [1, 2, 3])
def test_an_environment_that_breaks_after_a_while_ends_the_collection(tmp_path: Path, per_shard: int) -> None:
    store = new_store(tmp_path)
    with pytest.raises(WorkerError, match="3 different rollouts failed in the same way"):
        fill(store, dict.fromkeys(range(6, ROLLOUTS), "raise"), per_shard)
    assert [(shard.stop, shard.quarantined) for shard in store.committed()][-1] == (6, ())
    assert fill(store, {}, per_shard).tally.rollouts == ROLLOUTS - 6


@pytest.mark.parametrize("per_shard", [1, 4])
def test_a_single_rollout_that_fails_in_a_new_store_is_not_quarantined(tmp_path: Path, per_shard: int) -> None:
    store = new_store(tmp_path)
    worker_group = SerialWorkerGroup(partial(MisbehavingWorker, store.path, {0: "raise"}))
    with pytest.raises(WorkerError, match="no rollout succeeded, and rollout 0 failed again and again: RuntimeError"):
        collect(store, Plan(setting=store.setting), 1, per_shard, lambda: worker_group, OBJECTS)
    assert store.jobs() == []


@pytest.mark.parametrize("per_shard", [1, 4, 12])
def test_the_first_rollout_is_quarantined_once_others_succeed(tmp_path: Path, per_shard: int) -> None:
    disturbed, undisturbed = new_store(tmp_path / "disturbed"), new_store(tmp_path / "undisturbed")
    assert fill(disturbed, {0: "raise", 1: "raise"}, per_shard).tally.quarantined == 2
    fill(undisturbed, {})
    assert_only_these_are_missing(disturbed, undisturbed, {0, 1})


def test_the_last_rollout_of_a_store_is_quarantined_although_it_is_alone(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    fill(store, {})
    worker_group = SerialWorkerGroup(partial(MisbehavingWorker, store.path, {ROLLOUTS: "raise"}))
    plan = Plan(setting=store.setting)
    assert collect(store, plan, ROLLOUTS + 1, PER_SHARD, lambda: worker_group, OBJECTS).tally.quarantined == 1


@pytest.mark.parametrize("compacted", [False, True])
def test_quarantined_rollouts_that_are_executed_again_take_their_place(tmp_path: Path, compacted: bool) -> None:
    disturbed, undisturbed = new_store(tmp_path / "disturbed"), new_store(tmp_path / "undisturbed")
    fill(disturbed, {0: "raise", 5: "raise", 11: "raise"})
    fill(undisturbed, {})
    if compacted:
        compact(disturbed, ROLLOUTS)
    collected = fill(disturbed, {5: "raise"}, retry_quarantined=True)
    assert (collected.tally.rollouts, collected.tally.quarantined) == (3, 1)
    assert_only_these_are_missing(disturbed, undisturbed, {5})
    assert fill(disturbed, {}, retry_quarantined=True).tally.rollouts == 1
    assert disturbed.digest() == undisturbed.digest()
    assert verify(disturbed) == []
    assert fill(disturbed, {}, retry_quarantined=True).tally.rollouts == 0


def test_a_kill_while_shards_are_reopened_loses_and_doubles_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disturbed, undisturbed = new_store(tmp_path / "disturbed"), new_store(tmp_path / "undisturbed")
    fill(disturbed, {5: "raise"})
    fill(undisturbed, {})
    before = disturbed.digest()
    for step in ("commit_part", "set_aside"):
        with monkeypatch.context() as patch:
            patch.setattr(compaction, step, lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                fill(disturbed, {}, retry_quarantined=True)
        assert disturbed.digest() == before
        assert verify(disturbed) == []
    fill(disturbed, {}, retry_quarantined=True)
    assert disturbed.digest() == undisturbed.digest()
    assert verify(disturbed) == []


def test_a_store_says_what_was_given_up_and_how_to_see_it_happen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    store = new_store(tmp_path / "a store")
    with caplog.at_level(logging.WARNING):
        fill(store, {5: "raise"})
    command = f"adaafford store replay '{store.path}' {JOB.shard_id} --objects objects --rollout 5"
    assert caplog.messages[-2] == "1 rollouts of random-v0 are quarantined; `adaafford store info` lists them"
    assert caplog.messages[-1] == f"rollout 5: RuntimeError: the engine exploded (3 times); alone: {command}"
    adaafford(["store", "info", str(store.path)])
    printed = capsys.readouterr().out
    # A store does not know where its objects are: both may have moved since.
    command = command.replace("--objects objects", "--objects OBJECTS")
    assert "quarantined   1\n" in printed and command in printed
    adaafford(["store", "info", str(store.path), "--json"])
    listed = json.loads(capsys.readouterr().out)["quarantined"]
    assert listed == [{"rollout": 5, "reason": "RuntimeError: the engine exploded (3 times)", "command": command}]


def test_a_replayed_rollout_must_be_of_its_shard(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = new_store(tmp_path)
    fill(store, {})
    assert adaafford(["store", "replay", str(tmp_path), JOB.shard_id, "--objects", "objects", "--rollout", "8"]) == 2
    assert "rollout 8 is not of this shard; allowed: 4 to 7" in capsys.readouterr().err


def test_a_replayed_job_is_summarised_in_a_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = new_store(tmp_path)
    fill(store, {})
    capfd.readouterr()
    made = JobResult(JOB.shard_id, 4, 12, 1, {"ok": 11, "no-contact": 1}, {"total": 0.5})
    monkeypatch.setattr("collector.worker.Worker.run", lambda self, plan, job, under_way: made)
    assert adaafford(["store", "replay", str(tmp_path), JOB.shard_id, "--objects", "objects"]) == 0
    summary = f"{JOB.shard_id}: 4 rollouts, 12 interactions, 1 successful; no-contact 1, ok 11"
    assert capfd.readouterr().out == f"{summary}\n"


def test_a_committed_job_is_not_done_again(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    plan = Plan(setting=store.setting)
    first = MisbehavingWorker(store.path, {}).run(plan, JOB)
    again = MisbehavingWorker(store.path, dict.fromkeys(range(4, 8), "raise")).run(plan, JOB)
    assert [getattr(first, name) for name in ("shard_id", "rollouts", "interactions", "successes", "outcomes")] == [
        getattr(again, name) for name in ("shard_id", "rollouts", "interactions", "successes", "outcomes")
    ]


def test_a_quarantined_rollout_can_hold_no_label(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    plan = Plan(setting=store.setting)
    record = replace(fabricate_rollout(plan, 0), status=RolloutStatus.QUARANTINED)
    with pytest.raises(StoreError, match="is 'quarantined', so it cannot hold"):
        store.commit(plan, Job(plan.key, 0, 1), [record], {})


def test_no_reason_is_given_for_what_was_executed(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    plan = Plan(setting=store.setting)
    given_up = Quarantined(rollout=0, reason="a crash", command="adaafford store replay")
    with pytest.raises(StoreError, match="rollout 0 was executed"):
        store.commit(plan, Job(plan.key, 0, 1), [fabricate_rollout(plan, 0)], {}, [given_up])


def test_three_faults_or_ten_losses_quarantine_a_rollout() -> None:
    for failure, most in ((FAULT, MAX_FAULTS), (LOSS, MAX_LOSSES)):
        retries = RetryPolicy()
        for _ in range(most):
            assert retries.quarantined(JOB) == {}
            retries.record_failure(JOB, failure)
        assert retries.quarantined(JOB) == {5: f"{failure.reason} ({most} times)"}
        assert retries.quarantined(Job("random-v0", 8, 12)) == {}


def test_faults_of_different_rollouts_do_not_add_up() -> None:
    retries = RetryPolicy()
    for rollout in range(4, 8):
        for _ in range(MAX_FAULTS - 1):
            retries.record_failure(JOB, Failure("crash", rollout, fault=True))
    assert retries.quarantined(JOB) == {}


def test_a_job_that_fails_without_a_rollout_ends_the_run() -> None:
    retries = RetryPolicy()
    for _ in range(MAX_FAULTS - 1):
        retries.record_failure(JOB, Failure("OSError: no space left", None, fault=True))
    with pytest.raises(JobError, match=r"^job random-v0-00000004-00000008 failed 3 times; last: OSError"):
        retries.record_failure(JOB, Failure("OSError: no space left", None, fault=True))


def test_workers_that_are_lost_as_they_start_end_the_run_only_if_none_ever_lives() -> None:
    retries = RetryPolicy(workers=2)
    start = Failure("lost", None, fault=False)
    for _ in range(3):
        for _ in range(2 * MAX_LOSSES - 1):
            retries.record_failure(JOB, start)
        retries.reset(Job("random-v0", 0, 4))
    with pytest.raises(JobError):
        for _ in range(2 * MAX_LOSSES):
            retries.record_failure(JOB, start)


def test_a_heartbeat_says_what_its_process_does(tmp_path: Path) -> None:
    crash_log = CrashLog(tmp_path / "underway")
    assert crash_log.heartbeat_of(process_name()) is None
    crash_log.leave(Heartbeat(shard_id=JOB.shard_id, rollout=5))
    crash_log.leave(Heartbeat(shard_id=JOB.shard_id, rollout=6))
    assert crash_log.heartbeat_of(process_name()) == Heartbeat(shard_id=JOB.shard_id, rollout=6)
    assert crash_log.sweep() == 0, "this process is alive"
    crash_log.leave(Heartbeat(shard_id="aip-v1-00000000-00000001", rollout=None))
    assert crash_log.heartbeat_of(process_name()) == Heartbeat(shard_id="aip-v1-00000000-00000001", rollout=None)
    crash_log.forget(process_name())
    assert crash_log.heartbeat_of(process_name()) is None


@pytest.mark.parametrize("damage", [b"", b'{"shard_id"', b"[]", b'{"shard_id":"x","rollout":-1}', b"\xff" * 100_000])
def test_half_a_heartbeat_blames_nobody(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / "host~1~1.json").write_bytes(damage)
    assert CrashLog(tmp_path).heartbeat_of("host~1~1") is None
    assert CrashLog(tmp_path).heartbeat_of("host~2~2") is None
    assert CrashLog(tmp_path).fault_of("host~1~1") == ""


def test_a_dead_process_leaves_its_last_words_until_they_are_swept(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    script = (
        "import ctypes, pathlib, sys\n"
        "from collector.watchdog import Limits, Watchdog; from shared.io.files import process_name\n"
        "from shared.plan import Job; from shared.store.crash_log import CrashLog\n"
        "guard = Watchdog(CrashLog(pathlib.Path(sys.argv[1])), Limits())\n"
        "guard.install(); print(process_name(), flush=True)\n"
        "with guard.job(Job('random-v0', 4, 8)) as under_way: under_way(5); ctypes.string_at(0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, store.crash_log.folder], capture_output=True, text=True, timeout=60
    )
    process = done.stdout.strip()
    heartbeat = store.crash_log.heartbeat_of(process)
    assert heartbeat is not None
    assert heartbeat == Heartbeat(shard_id=JOB.shard_id, rollout=5, written=heartbeat.written)
    assert store.crash_log.fault_of(process).startswith("Segmentation fault, in string_at (__init__.py:")
    assert verify(store) == []
    assert store.sweep() == 2
    assert list(store.crash_log.folder.iterdir()) == []


def test_last_words_come_to_one_line() -> None:
    assert summary_of("") == ""
    assert summary_of("gibberish\n" * 1000) == "gibberish"
    crash = 'Fatal Python error: Aborted\n\nStack (most recent call first):\n  File "/x/scene.py", line 3 in step\n'
    assert summary_of(crash) == "Aborted, in step (scene.py:3)"
    hang = (
        'Timeout (0:05:00)!\nThread 0x1 (most recent call first):\n  File "/x/other.py", line 1 in wait\n\n'
        'Thread 0x2 (most recent call first):\n  File "/x/scene.py", line 3 in step\n'
        '  File "/x/trial.py", line 9 in run\n'
    )
    assert summary_of(hang) == "took more than 0:05:00, in step (scene.py:3) of run (trial.py:9)"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_crashes_hangs_and_kills_cost_themselves_alone_on_ray(tmp_path: Path) -> None:
    mishaps = {1: "crash", 6: "hang", 7: "raise", 10: "kill"}
    disturbed, undisturbed = new_store(tmp_path / "disturbed"), new_store(tmp_path / "undisturbed")
    plan = Plan(setting=disturbed.setting)
    with worker_groups(2, Limits(rollout_s=6.0)) as make:
        worker_group = make(partial(MisbehavingWorker, disturbed.path, mishaps), disturbed.crash_log)
        collect(disturbed, plan, ROLLOUTS, PER_SHARD, lambda: worker_group, OBJECTS)
    fill(undisturbed, {})
    assert_only_these_are_missing(disturbed, undisturbed, set(mishaps))
    reasons = {each.rollout: each.reason for shard in disturbed.committed() for each in shard.quarantined}
    assert reasons[1].startswith("Segmentation fault, in string_at ")
    assert reasons[6].startswith("took more than 0:00:06, in execute (misbehaving_worker.py:")
    assert reasons[7] == "RuntimeError: the engine exploded (3 times)"
    assert reasons[10].startswith("its process was lost without a traceback")


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("mishap", "said"), [("raise", "3 different rollouts failed"), ("library", "failed 3 times")])
def test_a_broken_environment_ends_the_collection_on_ray(tmp_path: Path, mishap: str, said: str) -> None:
    store = new_store(tmp_path)
    with worker_groups(2, Limits()) as make:
        worker_group = make(
            partial(MisbehavingWorker, store.path, dict.fromkeys(range(ROLLOUTS), mishap)), store.crash_log
        )
        with pytest.raises(WorkerError, match=said):
            collect(store, Plan(setting=store.setting), ROLLOUTS, 1, lambda: worker_group, OBJECTS)
    assert all(not shard.quarantined for shard in store.committed())


@pytest.mark.slow
def test_a_replayed_rollout_crashes_before_ones_eyes(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    fill(store, {5: "raise"})
    script = (
        "import ctypes, sys, collector.worker; from cluster.cli.main import run\n"
        "collector.worker.Worker.execute = lambda self, plan, index, clock: ctypes.string_at(0)\n"
        "sys.exit(run(sys.argv[1:]))"
    )
    arguments = ["store", "replay", str(tmp_path), JOB.shard_id, "--objects", "objects", "--rollout", "5"]
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == -signal.SIGSEGV
    assert "Fatal Python error: Segmentation fault" in done.stderr
    assert "in _replay" in done.stderr


@pytest.mark.parametrize("kind", ["disk", "bucket"])
def test_heartbeats_are_found_by_whoever_reaches_the_store(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    where = str(tmp_path / "store") if kind == "disk" else request.getfixturevalue("s3_url")
    Store.create(where, fabricate_setting()).crash_log.leave(Heartbeat(shard_id=JOB.shard_id, rollout=5))
    elsewhere = Store.open(where).crash_log
    if kind == "bucket":
        elsewhere = replace(elsewhere, folder=tmp_path / "of-another-machine")
    assert elsewhere.heartbeats() == {process_name(): Heartbeat(shard_id=JOB.shard_id, rollout=5)}
    assert elsewhere.heartbeat_of(process_name()) == Heartbeat(shard_id=JOB.shard_id, rollout=5)
    assert elsewhere.sweep() == 0, "this process is alive"
    elsewhere.forget(process_name())
    assert elsewhere.heartbeats() == {}
    assert elsewhere.heartbeat_of(process_name()) is None
