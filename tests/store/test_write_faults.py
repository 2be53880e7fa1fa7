"""A commit that fails or is killed at any of its write steps: nothing committed is lost, and nothing is doubled.

Every fault at every step is for the chaos suite; here are those that tell most.
"""

import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from shared.errors import StoreError
from shared.plan import Job, Plan
from shared.store import Store, verify
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.faults import Fault, bucket_faults, disk_faults

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)
JOBS = (Job(PLAN.key, 0, 1), Job(PLAN.key, 1, 2))
ROLLOUTS = {job: fabricate_rollouts(PLAN, job, 1) for job in JOBS}
ROOT = Path(__file__).parents[2]

Faults = Callable[[Fault], AbstractContextManager[list[str]]]


def commit(where: str, job: Job) -> None:
    Store.open(where).commit(PLAN, job, ROLLOUTS[job], {})


def digest_without_faults(folder: Path) -> str:
    store = Store.create(folder / "store", SETTING)
    for job in JOBS:
        commit(store.where, job)
    return store.digest()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    return digest_without_faults(tmp_path_factory.mktemp("undisturbed"))


def disturb(where: str, faults: Faults, fault: Fault, undisturbed: str) -> int:
    """A store with one shard, and a fault in the commit of another; returns how many steps that had."""
    store = Store.create(where, SETTING)
    commit(where, JOBS[0])
    with faults(fault) as steps:
        try:
            commit(where, JOBS[1])
        except (OSError, StoreError):
            assert fault.step
    what = f"{fault.kind} at step {fault.step}: {steps[fault.step - 1 : fault.step]}"
    taken = len(steps)
    assert verify(store) == [], what
    assert [manifest.start for manifest in store.committed()] in ([0], [0, 1]), what
    commit(where, JOBS[1])
    assert verify(store) == [], what
    assert store.digest() == undisturbed, what
    return taken


def disturb_all(places: Callable[[str], str], faults: Faults, kind: str, undisturbed: str, every: int = 1) -> int:
    """A fault of a kind at each step of a commit, or at each n-th of them; returns at how many."""
    steps = disturb(places("none"), faults, Fault(kind, 0), undisturbed)
    tried = range(1, steps + 1, every)
    for step in tried:
        disturb(places(str(step)), faults, Fault(kind, step), undisturbed)
    assert steps > 10
    return len(tried)


def kill_at_all(where: str, kind: str) -> int:
    """A kill before or after each step of a commit in a place; returns how many steps there were."""
    command = [sys.executable, "-m", "tests.support.store_processes", "kill-in-place", where, kind]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    steps = int(done.stdout)
    store = Store.open(where)
    plan = store.plans()[0]
    committed = [manifest.start for manifest in store.committed()]
    assert committed == sorted(set(committed))
    assert verify(store) == []
    for job in (Job(plan.key, k, k + 1) for k in range(steps)):
        store.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    whole = Store.create(f"{where}-whole", store.setting)
    job = Job(plan.key, 0, steps)
    whole.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    assert verify(store) == []
    assert store.digest() == whole.digest()
    assert steps > 10
    return steps


def test_an_error_at_some_steps_on_a_disk_does_no_harm(tmp_path: Path, undisturbed: str) -> None:
    disturb_all(lambda name: str(tmp_path / name), disk_faults, "ENOSPC", undisturbed, every=7)


@pytest.mark.slow
def test_an_error_at_some_steps_in_a_bucket_does_no_harm(s3_url: str, undisturbed: str) -> None:
    disturb_all(lambda name: f"{s3_url}/{name}", bucket_faults, "answer lost", undisturbed, every=6)


@pytest.mark.slow
def test_a_kill_after_any_step_in_a_bucket_does_no_harm(s3_url: str) -> None:
    kill_at_all(s3_url, "kill after")
