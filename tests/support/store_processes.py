"""Processes that write a store at once, or are killed while they do; run as a script by tests.

It forks before any library has started a thread, which a test process cannot promise. Only what starts none is done
before: Zarr is imported, and Arrow imports pandas, where that is installed, at the first array that it makes.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import zarr.codecs
import zarr.storage  # noqa: F401 - once, and not in each child.

from shared.plan import Job, Plan, RolloutRecord
from shared.store import Store
from shared.store.backends.base import is_url
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.faults import Fault, bucket_faults, disk_faults

POINTS = 64


def kill_at(step: int, folder: Path, work: Callable[[], object]) -> bool:
    """Do `work` in a child that kills itself before its n-th write below `folder`; whether it was killed."""
    child = os.fork()
    if child == 0:
        count = 0

        def count_down(*_: object) -> None:
            nonlocal count
            count += 1
            if count == step:
                os.kill(os.getpid(), signal.SIGKILL)

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            if event in {"open", "os.mkdir", "os.rename", "os.link", "os.remove", "os.rmdir"}:
                path = arguments[0]
                if isinstance(path, str | os.PathLike) and str(folder) in os.fspath(path):
                    count_down()

        synchronise = os.fsync
        os.fsync = lambda descriptor: (count_down(), synchronise(descriptor))
        sys.addaudithook(hook)
        work()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def kill_commits(path: Path) -> int:
    """Commit rollout n in a child that dies at its n-th step, for every step there is; how many there were."""
    setting = fabricate_setting(points=POINTS)
    plan = Plan(setting=setting)
    Store.create(path, setting).add_plan(plan)
    for step in range(1, 1000):
        job = Job(plan.key, step - 1, step)
        rollouts = fabricate_rollouts(plan, job, interactions=2)
        killed = kill_at(step, path / "shards", lambda: Store.open(path).commit(plan, job, rollouts, {}))  # noqa: B023
        committed = [manifest.start for manifest in Store.open(path).committed()]
        assert committed == sorted(set(committed))
        if not killed:
            return step
    raise AssertionError("the commit never ended")


def kill_in_place(where: str, kind: str) -> int:
    """Commit rollout n in a child that is killed at its n-th write, for every one there is; how many there were."""
    faults = bucket_faults if is_url(where) else disk_faults
    setting = fabricate_setting(points=POINTS)
    plan = Plan(setting=setting)

    def in_child(work: Callable[[], object]) -> bool:
        # The parent never opens the store: the client has threads, which a fork would lose.
        child = os.fork()
        if child == 0:
            work()
            os._exit(0)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL

    in_child(lambda: Store.create(where, setting).add_plan(plan))
    for step in range(1, 1000):
        job = Job(plan.key, step - 1, step)
        rollouts = fabricate_rollouts(plan, job, interactions=2)

        def work(job: Job = job, rollouts: list[RolloutRecord] = rollouts, step: int = step) -> None:
            with faults(Fault(kind, step)):
                Store.open(where).commit(plan, job, rollouts, {})

        if not in_child(work):
            return step
    raise AssertionError("the commit never ended")


def kill_creations(path: Path) -> int:
    """Create a store in a child that dies at its n-th step, then again; how many steps there were."""
    setting = fabricate_setting(points=POINTS)
    for step in range(1, 1000):
        folder = path / str(step)
        killed = kill_at(step, folder, lambda: Store.create(folder, setting))  # noqa: B023
        assert Store.create(folder, setting).setting == setting
        if not killed:
            return step
    raise AssertionError("the creation never ended")


def race(path: Path, writers: int) -> int:
    """Create one store and commit one job from several processes at the same moment; how many failed."""
    setting = fabricate_setting(points=POINTS)
    plan = Plan(setting=setting)
    job = Job(plan.key, 0, 4)
    rollouts = fabricate_rollouts(plan, job)
    start = time.time() + 0.2
    children = []
    for _ in range(writers):
        child = os.fork()
        if child == 0:
            time.sleep(max(0.0, start - time.time()))
            manifest = Store.create(path, setting).commit(plan, job, rollouts, {"writer": str(os.getpid())})
            os._exit(0 if manifest == Store.open(path).committed()[0] else 1)
        children.append(child)
    return sum(os.waitpid(child, 0)[1] != 0 for child in children)


if __name__ == "__main__":
    pa.array(["once, and not in each child"])
    if sys.argv[1] == "kill-in-place":
        print(kill_in_place(*sys.argv[2:]))
        sys.exit()
    task, folder = sys.argv[1], Path(sys.argv[2])
    print({"kill-commits": kill_commits, "kill-creations": kill_creations, "race": lambda p: race(p, 4)}[task](folder))
