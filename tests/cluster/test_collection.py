"""Collection and the campaign around it: resumed, never repeated, one driver at a time."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from cluster.campaign.campaign import steps_of
from cluster.collection.driver import collect
from cluster.collection.status_writer import CollectionProgress
from cluster.config.campaign_config import CampaignConfig
from cluster.workers.session import CurrentWorkerGroup
from cluster.workers.worker_group import SerialWorkerGroup, WorkerGroup
from collector.job_result import JobResult, WorkerFactory
from collector.watchdog import UnderWay
from shared.errors import StoreError, UsageError, WorkerError
from shared.io.files import DRIVER_LOCK, exclusive_lock
from shared.plan import Job, Plan
from shared.progress import LINE_EVERY_S
from shared.store import Store, verify
from shared.store.crash_log import CrashLog
from tests.support.fabricate import fabricate_rollout, fabricate_setting

OBJECTS = Path("objects")


class FabricatingWorker:
    """Commits rollouts out of thin air; fails at one of them if told so."""

    def __init__(self, store: Path, breaks_at: int | None = None) -> None:
        self.store = Store.open(store)
        self.breaks_at = breaks_at

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None: ...

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> JobResult:
        if self.breaks_at is not None and job.start <= self.breaks_at < job.stop:
            raise RuntimeError("no luck")
        records = [fabricate_rollout(plan, index) for index in range(job.start, job.stop)]
        self.store.commit(plan, job, records, {})
        count = sum(len(record.interactions) for record in records)
        return JobResult(job.shard_id, len(records), count, 0, {"ok": count}, {"total": 0.5})


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.create(tmp_path / "store", fabricate_setting())


def fill(store: Store, rollouts: int, per_shard: int = 2, breaks_at: int | None = None, version: int = 0) -> int:
    """How many rollouts this attempt made."""
    plan = Plan(setting=store.setting, proposer="aip" if version else "random", policy_version=version)
    worker_group = SerialWorkerGroup(lambda: FabricatingWorker(store.path, breaks_at))
    return collect(store, plan, rollouts, per_shard, lambda: worker_group, OBJECTS).tally.rollouts


def test_the_same_again_does_nothing_and_more_does_the_rest(store: Store) -> None:
    assert fill(store, 5) == 5
    digest = store.digest()
    assert fill(store, 5) == 0
    assert store.digest() == digest
    assert fill(store, 8, per_shard=3) == 3
    assert verify(store) == []


def test_a_stopped_collection_ends_as_an_unstopped_one(store: Store, tmp_path: Path) -> None:
    with pytest.raises(WorkerError):
        fill(store, 8, breaks_at=5)
    assert fill(store, 8) == 4
    whole = Store.create(tmp_path / "whole", store.setting)
    fill(whole, 8, per_shard=8)
    assert store.digest() == whole.digest()


def test_a_job_that_fails_comes_with_the_command_that_reproduces_it(store: Store) -> None:
    with pytest.raises(WorkerError) as failure:
        fill(store, 8, breaks_at=5)
    assert str(failure.value).endswith(
        f"reproduce it with: adaafford store replay {store.path} random-v0-00000004-00000006 --objects {OBJECTS}"
    )
    assert failure.value.exit_code == 1


def test_a_policy_that_is_not_there_is_refused(store: Store) -> None:
    with pytest.raises(StoreError, match="no policy 3"):
        fill(store, 2, version=3)


def test_a_second_driver_is_refused_while_the_first_lives(tmp_path: Path) -> None:
    script = (
        "import sys, pathlib; from shared.io.files import DRIVER_LOCK, exclusive_lock\n"
        "with exclusive_lock(pathlib.Path(sys.argv[1]) / DRIVER_LOCK): print('held', flush=True); sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert first.stdin is not None and first.stdout is not None
    assert first.stdout.readline() == "held\n"
    with pytest.raises(UsageError, match=f"in use by process {first.pid}"), exclusive_lock(tmp_path / DRIVER_LOCK):
        pass
    first.kill()
    first.wait()
    first.stdin.close()
    first.stdout.close()
    with exclusive_lock(tmp_path / DRIVER_LOCK):
        pass


def test_progress_says_what_is_done_and_left_in_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    now = 0.0
    with CollectionProgress("collecting", 4, 10, "STORE", lambda: now) as progress:
        for _ in range(3):
            now += LINE_EVERY_S
            progress(JobResult("s", 2, 20, 5, {"ok": 20}, {}))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "collecting: 4 of 10 rollouts are there, 6 left; into STORE"
    assert lines[1] == "collecting: 6/10 rollouts, 4 interactions/s, 25.0% successful, 0:10 min left"
    assert lines[-1] == "collecting: 10/10 rollouts, 4 interactions/s, 25.0% successful"
    assert len(lines) == 4


class FakeWorkerGroup:
    workers = 1

    def __init__(self) -> None:
        self.closed = False

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None: ...

    def run(self, plan: Plan, jobs: Sequence[Job], on_result: Callable[[JobResult], None]) -> None: ...

    def close(self) -> None:
        self.closed = True


def test_the_same_live_worker_group_serves_all_rounds_of_a_store(tmp_path: Path) -> None:
    one, other = (Store.create(tmp_path / name, fabricate_setting()) for name in "ab")
    made: list[FakeWorkerGroup] = []

    def make(factory: WorkerFactory, crash_log: CrashLog) -> WorkerGroup:
        made.append(FakeWorkerGroup())
        return made[-1]

    worker_group = CurrentWorkerGroup(make)
    assert worker_group.for_store(one, OBJECTS) is worker_group.for_store(one, OBJECTS)
    worker_group.for_store(other, OBJECTS)
    assert [worker_group.closed for worker_group in made] == [True, False]


@pytest.mark.parametrize("alternations", [0, 1, 2])
def test_every_policy_is_published_before_it_is_used(alternations: int) -> None:
    names = [step.name for step in steps_of(CampaignConfig(alternations=alternations))]
    assert names[:3] == ["objects", "collect-random", "train-prior"]
    assert names[-2:] == ["evaluate", "report"]
    assert sum(name.startswith("publish-") for name in names) == alternations + 1
    for version in range(1, alternations + 1):
        order = [f"train-aip-{version}", f"publish-{version}", f"collect-aip-{version}", f"train-aap-{version + 1}"]
        assert [names.index(name) for name in order] == sorted(names.index(name) for name in order)


QUICK = {"steps": 3, "affordance": {"steps": 3, "questions": 64, "points": 16}}
SMALL = {
    "rollouts": {"random": 10, "aip": 2, "evaluation": 2},
    "procedural": {"per_category": 6},
    "learner": {"prior": QUICK, "aap": {**QUICK, "oracle_steps": 3}, "aip": QUICK},
}


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_killed_campaign_ends_as_an_unkilled_one(tmp_path: Path) -> None:
    """SIGKILL in the middle of a collection and of a training stage, other numbers of workers; same digests."""
    whole = tmp_path / "whole"
    assert adaafford(tmp_path, "run", whole, "0").wait() == 0
    killed = tmp_path / "killed"
    for moment in ("collect-random", "train-aap-1"):
        attempt = adaafford(tmp_path, "run", killed, "2")
        wait_for_stage(killed, moment)
        os.kill(attempt.pid, 9)
        attempt.wait()
    assert adaafford(tmp_path, "resume", killed, "1").wait() == 0
    for name in ("store", "evaluation"):
        assert Store.open(killed / name).digest() == Store.open(whole / name).digest()
        assert verify(Store.open(killed / name)) == []
    assert (killed / "summary.json").is_file()


def adaafford(folder: Path, command: str, run: Path, workers: str) -> "subprocess.Popen[bytes]":
    from tests.support.as_toml import as_toml

    (folder / "small.toml").write_text(as_toml(SMALL))
    where = [str(run)] if command == "resume" else ["--out", str(run), "--config", str(folder / "small.toml")]
    program = "import sys; from cluster.cli.main import main; main()"
    with (folder / f"{run.name}.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, "-c", program, command, *where, "--workers", workers], stdout=log, stderr=log
        )


def wait_for_stage(run: Path, name: str) -> None:
    import time

    from cluster.runs.run_log import RunLog

    deadline = time.monotonic() + 200
    while name not in RunLog(run / "log.jsonl").seconds:
        assert time.monotonic() < deadline
        time.sleep(0.2)
