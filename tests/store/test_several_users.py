"""Several at work on one store: drivers, repairs, workers, learners, machines of one name, users of one group."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cluster.cli.main import run
from cluster.collection.driver import LatestPolicy, collect
from cluster.collection.status_writer import DriverStatus
from learner.rounds import publish
from learner.settings import PUBLISHED_FILE
from shared.errors import UsageError
from shared.io import files
from shared.io.files import is_gone, process_name
from shared.plan import Job, Plan
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE
from shared.store import Store, compact, merge, repair, verify
from shared.store.crash_log import Heartbeat
from shared.store.presence import SILENT_S, Mark
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)
AIP = Plan(setting=SETTING, proposer="aip", policy_version=1)
ELSEWHERE = "elsewhere-1-abc~17~3"
"""A process of another machine, which may be alive."""


def make(where: str, shards: int = 2, plan: Plan = PLAN) -> Store:
    store = Store.create(where, SETTING)
    for start in range(shards):
        job = Job(plan.key, start, start + 1)
        store.commit(plan, job, fabricate_rollouts(plan, job, 1), {})
    return store


def upkeep(store: Store, tmp_path: Path) -> list[Any]:
    """What may not be done while somebody collects."""
    other = make(str(tmp_path / "other"))
    return [
        lambda: repair(store.where),
        lambda: merge([other], store.where),
        lambda: compact(store, 9),
    ]


@pytest.mark.slow
def test_nobody_repairs_compacts_or_merges_beside_a_driver(where: str, tmp_path: Path) -> None:
    store = make(where)
    before = store.backend.leaves("shards")
    for act in upkeep(store, tmp_path):
        with store.only_driver(), pytest.raises(UsageError, match="is in use by process"):
            act()
        assert [key for key in store.backend.leaves("shards") if ".lock-" not in key] == [
            key for key in before if ".lock-" not in key
        ]
    for act in upkeep(store, tmp_path / "again"):
        act()
    assert verify(store) == []


def test_no_driver_begins_beside_a_repair(s3_url: str) -> None:
    place = make(s3_url).backend
    with place.only_one("driver", alone=True):
        for alone in (False, True):
            with pytest.raises(UsageError, match="in use by process"), place.only_one("driver", alone=alone):
                pass
    refused = pytest.raises(UsageError, match="in use by process")
    with place.only_one("driver"), place.only_one("driver"), refused, place.only_one("driver", alone=True):
        pass
    assert place.names("status") == []


@pytest.mark.parametrize(
    "mark",
    [
        Mark(process=ELSEWHERE, alone=True, written=time.time() - 2 * SILENT_S),
        Mark(process=ELSEWHERE, alone=True, written=time.time() + 24 * 3600),
        Mark(process=f"{process_name().rsplit('~', 2)[0]}~4194303~1", alone=True, written=time.time()),
    ],
)
def test_a_holder_that_is_silent_or_dead_or_had_a_wrong_clock_is_forgotten(mark: Mark, s3_url: str) -> None:
    place = make(s3_url).backend
    place.replace("status/driver-dead.json", mark.model_dump_json().encode())
    with place.only_one("driver", alone=True):
        assert "driver-dead.json" not in place.names("status")


@pytest.mark.parametrize("off_s", [-3600, 3600])
def test_a_bucket_is_not_repaired_while_a_worker_writes_a_shard(s3_url: str, off_s: int) -> None:
    store = make(s3_url, 1)
    half = f"shards/{Job(PLAN.key, 1, 2).shard_id}/rollouts.parquet"
    store.backend.create(half, b"some rows")
    store.crash_log.leave(Heartbeat(shard_id="x", rollout=1, written=time.time()))
    with pytest.raises(UsageError, match="worker process"):
        repair(s3_url)
    assert store.backend.exists(half)
    store.crash_log.forget(process_name())
    heartbeat = Heartbeat(shard_id="x", rollout=1, written=time.time() + off_s)
    store.backend.replace(f"underway/{ELSEWHERE}.json", heartbeat.model_dump_json().encode())
    assert repair(s3_url)[1].set_aside == (half.rpartition("/")[0],)


def test_the_commands_refuse_a_store_whose_driver_says_that_it_is_at_work(
    where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = make(where)
    other = make(str(tmp_path / "other"))
    counts: dict[str, Any] = dict.fromkeys(
        ("done", "total", "elapsed_s", "rollouts", "interactions", "successes", "quarantined"), 0
    )
    status = DriverStatus(
        process=ELSEWHERE,
        written=time.time(),
        state="collecting",
        title="random-v0",
        outcomes={},
        recent_per_s=0,
        workers=1,
        restarts=0,
        **counts,
    )
    store.backend.replace("status/driver.json", status.model_dump_json().encode())
    commands = (["repair", where], ["merge", str(other.path), "--out", where], ["compact", where])
    for command in commands:
        assert run(["store", *command]) == 2
        said = capsys.readouterr().err
        assert ELSEWHERE in said
        assert said.count("\n") == 1
    silent = status.model_copy(update={"written": time.time() - 3600})
    store.backend.replace("status/driver.json", silent.model_dump_json().encode())
    assert [run(["store", *command]) for command in commands] == [0, 0, 0]


def test_a_lost_plan_makes_no_rollout_twice(tmp_path: Path) -> None:
    store = make(str(tmp_path / "store"), 2, AIP)
    store.publish_policy(2, {"policy.json": b"{}"})
    (store.path / "plans/aip-v1.json").unlink()
    collected = collect(store, LatestPolicy("aip"), 2, 1, pytest.fail, tmp_path)
    assert collected.workers == 0, "both rollouts are there, so no worker group is opened"


def policy_folder(path: Path, weights: bytes) -> Path:
    path.mkdir()
    (path / WEIGHTS_FILE).write_bytes(weights)
    (path / POLICY_FILE).write_bytes(b"{}")
    return path


def test_a_learner_that_is_started_again_without_its_record_publishes_nothing_twice(tmp_path: Path) -> None:
    store = make(str(tmp_path / "store"))
    rounds = [policy_folder(tmp_path / name, weights) for name, weights in (("a", b"1"), ("b", b"2"), ("c", b"2"))]
    for _ in range(2):
        assert [publish(store, tmp_path, one.name, one) for one in rounds] == [1, 2, 3]
        (tmp_path / PUBLISHED_FILE).unlink()
    (tmp_path / "other").mkdir()
    assert publish(store, tmp_path / "other", "a", rounds[0]) == 1, "the same learner, started in another folder"
    assert store.policy_versions() == (1, 2, 3)


def test_learners_that_publish_at_the_same_moment_take_different_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(str(tmp_path / "store"))
    mine, real = policy_folder(tmp_path / "mine", b"mine"), Store.publish_policy

    def faster(self: Store, version: int, content: dict[str, bytes]) -> None:
        if version == 1:
            real(self, version, {"weights.safetensors": b"of another learner"})
        real(self, version, content)

    monkeypatch.setattr(Store, "publish_policy", faster)
    assert publish(store, tmp_path, "mine", mine) == 2
    assert json.loads((tmp_path / PUBLISHED_FILE).read_text()) == {"mine": 2}
    assert store.read_policy(2)[WEIGHTS_FILE] == b"mine"


def test_a_machine_of_the_same_name_sweeps_nothing_that_may_be_alive(tmp_path: Path) -> None:
    store = make(str(tmp_path / "store"))
    space, _, _ = process_name().split("~")
    twin = f"{space[:-12]}{'0' * 12}~4194303~1"
    assert not is_gone(twin)
    assert is_gone(f"{space}~4194303~1")
    left = store.path / "shards" / f".tmp-a~{twin}~abc"
    heartbeat = store.path / "underway" / f"{twin}.json"
    heartbeat.parent.mkdir()
    for file in (left, heartbeat):
        file.write_bytes(b"x")
    assert store.sweep() == 0
    for file, days in ((left, 2), (heartbeat, 31)):
        os.utime(file, (time.time() - days * files.DAY_S,) * 2)
    assert store.sweep() == 2


AS_USERS = """
import json, os, sys, tempfile, time
from pathlib import Path
import pyarrow, zarr.codecs, zarr.storage
import cluster.cli.commands.upkeep, cluster.cli.commands.status
import cluster.collection.status_writer, cluster.runs.status_snapshot
from cluster.cli.main import run
from shared.store import Store, verify, compact, repair
from shared.plan import Job, Plan
from shared.store.crash_log import Heartbeat
from tests.support.fabricate import fabricate_rollouts, fabricate_setting, fabricate_store

PLAN = Plan(setting=fabricate_setting())

def act(where, scratch, user, group, start):
    warm = fabricate_store(Path(tempfile.mkdtemp(dir=scratch)) / "warm", 2)   # What is imported late is imported now.
    verify(warm); compact(warm, 9); repair(warm.where); run(["status", warm.where])
    os.setgroups([]); os.setgid(group); os.setuid(user); os.umask(0o002)
    store = Store.create(where, PLAN.setting)
    with store.only_driver():
        store.sweep()
        for k in range(start, start + 2):
            store.crash_log.leave(Heartbeat(shard_id="x", rollout=k, written=time.time()))
            job = Job(PLAN.key, k, k + 1)
            store.commit(PLAN, job, fabricate_rollouts(PLAN, job, 1), {})
        store.backend.replace("status/driver.json", b"{}")
    commands = (["store", "compact", where, "--rollouts", "4"], ["store", "repair", where], ["status", where])
    codes = [run(command) for command in commands]
    assert verify(store) == [] and codes == [0, 0, 0], codes

where, scratch, acts = *sys.argv[1:3], json.loads(sys.argv[3])
sys.stdout = sys.stderr
pyarrow.array(["once"])  # With the first array, Arrow imports pandas, where that is installed; here, not in each child.
ended = []
for user, group, start in acts:
    # A process of its own for each, forked before any library has started a thread.
    child = os.fork()
    if child == 0:
        act(where, scratch, user, group, start)
        os._exit(0)
    ended.append(os.waitpid(child, 0)[1])
print(json.dumps(ended), file=sys.__stdout__)
"""


@pytest.fixture
def shared_folder() -> Iterator[Path]:
    """A folder that others may enter."""
    path = Path(tempfile.mkdtemp(prefix="adaafford-users-"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become other users")
def test_users_of_one_group_share_a_store(shared_folder: Path, tmp_path: Path) -> None:
    group, users = 54321, (54322, 54323)
    common = shared_folder / "common"
    common.mkdir()
    os.chown(common, 0, group)
    common.chmod(0o2775)
    where = str(common / "store")

    acts = [(user, group, 4 * turn + 2 * k) for turn in range(2) for k, user in enumerate(users)]
    acts.append((54329, 54328, 8))
    command = [sys.executable, "-c", AS_USERS, where, str(tmp_path), json.dumps(acts)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=100)
    assert done.returncode == 0, done.stderr
    *members, stranger = json.loads(done.stdout)
    assert members == [0] * 4, done.stderr
    assert stranger != 0
    assert "write permission" in done.stderr
    assert Store.open(where).digest() == make(str(tmp_path / "whole"), 8).digest()
