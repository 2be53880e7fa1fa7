"""Writers that die, and writers that meet: nothing committed is lost or doubled."""

import subprocess
import sys
from pathlib import Path

import pytest

from shared.io.files import temporary_name
from shared.plan import Job, Plan, missing_jobs
from shared.store import Store, verify
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.killed_writers import kill_while_writing

ROOT = Path(__file__).parents[2]


def run(task: str, path: Path) -> int:
    """What the script prints."""
    command = [sys.executable, "-m", "tests.support.store_processes", task, path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


@pytest.mark.slow
def test_a_writer_killed_at_any_step_leaves_a_store_that_finishes_with_the_same_digest(tmp_path: Path) -> None:
    steps = run("kill-commits", tmp_path / "killed")
    assert steps > 40, "every file is opened and forced to the disk, so there are many steps"
    store = Store.open(tmp_path / "killed")
    plan = store.plans()[0]
    done = {manifest.start for manifest in store.committed()}
    assert 1 <= len(done) < steps, "deaths before the rename lose the shard, the last run commits it"
    assert verify(store) == []

    assert not list(store.path.rglob(".tmp-*")), "each writer removes what the dead left"
    kill_while_writing(store.path / "shards/random-v0-00000000-00000032")
    assert store.sweep() == 1
    assert not list(store.path.rglob(".tmp-*"))
    ranges = [(manifest.start, manifest.stop) for manifest in store.committed()]
    for job in missing_jobs(plan.key, steps, ranges, per_shard=32):
        store.commit(plan, job, fabricate_rollouts(plan, job, 2), {})

    whole = Store.create(tmp_path / "whole", store.setting)
    job = Job(plan.key, 0, steps)
    whole.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    assert store.digest() == whole.digest()


def test_a_learner_that_publishes_removes_what_a_killed_one_left(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", fabricate_setting())
    (store.path / "policies").mkdir()
    kill_while_writing(store.path / "policies/000001")
    store.publish_policy(1, {"policy.json": b"{}"})
    assert [path.name for path in (store.path / "policies").glob("[!.]*")] == ["000001"]
    assert not list(store.path.rglob(".tmp-*"))


def test_a_creator_killed_at_any_step_leaves_a_folder_that_can_become_the_store(tmp_path: Path) -> None:
    assert run("kill-creations", tmp_path) > 5


@pytest.mark.slow
def test_several_processes_create_and_commit_the_same_at_once(tmp_path: Path) -> None:
    assert run("race", tmp_path / "store") == 0
    store = Store.open(tmp_path / "store")
    assert [manifest.shard_id for manifest in store.committed()] == ["random-v0-00000000-00000004"]
    assert verify(store) == []
    assert not list(store.path.rglob(".tmp-*")), "losers clean up after themselves"


def test_sweep_leaves_what_a_live_writer_writes(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", fabricate_setting())
    (store.path / "shards").mkdir()
    ours = store.path / "shards" / temporary_name("random-v0-00000000-00000004")
    ours.mkdir()
    elsewhere = store.path / "shards" / ".tmp-random-v0-00000000-00000004~another-host~1~1~aa"
    elsewhere.mkdir()
    assert store.sweep() == 0
    assert ours.exists(), "this process is alive"
    assert elsewhere.exists(), "nobody here can tell whether that host's process is alive"


def test_an_uncommitted_folder_of_the_same_name_is_replaced(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", fabricate_setting())
    plan = Plan(setting=store.setting)
    job = Job(plan.key, 0, 2)
    remnant = store.path / "shards" / job.shard_id
    remnant.mkdir(parents=True)
    (remnant / "interactions.parquet").write_bytes(b"half")
    assert store.committed() == []
    assert [problem.where for problem in verify(store)] == [f"shards/{job.shard_id}"]
    store.commit(plan, job, fabricate_rollouts(plan, job), {})
    assert verify(store) == []
