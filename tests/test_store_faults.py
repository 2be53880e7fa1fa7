"""A commit that fails or is killed at any of its write steps: nothing committed is lost, and nothing is doubled."""

import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from shared.errors import StoreError
from shared.plan import Job, Plan
from shared.store import Store, verify
from tests.fabricate import fabricate_rollouts, fabricate_setting
from tests.faults import BUCKET_FAULTS, DISK_FAULTS, Fault, bucket_faults, disk_faults

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)
JOBS = (Job(PLAN.key, 0, 1), Job(PLAN.key, 1, 2))
ROLLOUTS = {job: fabricate_rollouts(PLAN, job, 1) for job in JOBS}
ROOT = Path(__file__).parents[1]

Faults = Callable[[Fault], AbstractContextManager[list[str]]]


def commit(where: str, job: Job) -> None:
    Store.open(where).commit(PLAN, job, ROLLOUTS[job], {})


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest without any fault."""
    store = Store.create(tmp_path_factory.mktemp("undisturbed") / "store", SETTING)
    for job in JOBS:
        commit(store.where, job)
    return store.digest()


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


def disturb_all(places: Callable[[str], str], faults: Faults, kind: str, undisturbed: str, every: int = 1) -> None:
    steps = disturb(places("none"), faults, Fault(kind, 0), undisturbed)
    tried = range(1, steps + 1, every)
    for step in tried:
        disturb(places(str(step)), faults, Fault(kind, step), undisturbed)
    print(f"{kind}: at {len(tried)} of {steps} steps, and nothing was lost or doubled")
    assert steps > 10


def test_an_error_at_some_steps_on_a_disk_does_no_harm(tmp_path: Path, undisturbed: str) -> None:
    disturb_all(lambda name: str(tmp_path / name), disk_faults, "ENOSPC", undisturbed, every=7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", DISK_FAULTS)
def test_an_error_at_any_step_on_a_disk_does_no_harm(kind: str, tmp_path: Path, undisturbed: str) -> None:
    disturb_all(lambda name: str(tmp_path / name), disk_faults, kind, undisturbed)


@pytest.mark.parametrize("kind", [pytest.param(BUCKET_FAULTS[0], marks=pytest.mark.slow), BUCKET_FAULTS[1]])
def test_an_error_at_any_step_in_a_bucket_does_no_harm(kind: str, s3_url: str, undisturbed: str) -> None:
    disturb_all(lambda name: f"{s3_url}/{name}", bucket_faults, kind, undisturbed)


@pytest.mark.parametrize("kind", [pytest.param("kill before", marks=pytest.mark.slow), "kill after"])
def test_a_kill_at_any_step_in_a_bucket_does_no_harm(kind: str, s3_url: str) -> None:
    command = [sys.executable, "-m", "tests.store_processes", "kill-in-bucket", s3_url, kind]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    steps = int(done.stdout)
    store = Store.open(s3_url)
    plan = store.plans()[0]
    committed = [manifest.start for manifest in store.committed()]
    assert committed == sorted(set(committed))
    assert verify(store) == []
    whole = Store.create(f"{s3_url}-whole", store.setting)
    jobs = [Job(plan.key, k, k + 1) for k in range(steps)]
    for job in jobs:
        for each in (store, whole):
            each.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    assert verify(store) == []
    assert store.digest() == whole.digest()
    print(f"{kind}: at each of {steps} steps; {len(committed)} shards had been committed")
    assert steps > 10
