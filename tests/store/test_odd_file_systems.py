"""File systems without locks, links or a way to force folders to the disk, as network and removable disks are."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shared.errors import UsageError
from shared.io import files
from shared.plan import Job, Plan
from shared.store import Store, verify
from tests.support.fabricate import fabricate_rollout, fabricate_setting

REFUSALS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)
HOLDER = """
import errno, fcntl, pathlib, sys, time
from shared.io import files
def refuse(*_):
    raise OSError(errno.ENOSYS, "Function not implemented")
if sys.argv[2] == "no locks":
    fcntl.flock = refuse
with files.exclusive_lock(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def refuse_locks(monkeypatch: pytest.MonkeyPatch, number: int = errno.ENOSYS) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)


def refuse_links(monkeypatch: pytest.MonkeyPatch, number: int = errno.EPERM) -> None:
    def link(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", link)


def holder(path: Path, kind: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(path), kind], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def end(process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.stdout is not None
    process.stdout.close()


@pytest.mark.parametrize("number", REFUSALS)
def test_a_lock_is_held_where_the_disk_knows_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    refuse_locks(monkeypatch, number)
    path = tmp_path / ".lock-driver"
    with (
        files.exclusive_lock(path),
        pytest.raises(UsageError, match=rf"in use by process {os.getpid()} on .*; wait"),
        files.exclusive_lock(path),
    ):
        pass
    with files.exclusive_lock(path):
        pass
    assert [each.name for each in tmp_path.iterdir()] == [".lock-driver"]


@pytest.mark.parametrize("theirs", ["locks", "no locks"])
@pytest.mark.parametrize("ours", ["locks", "no locks"])
def test_a_holder_is_respected_and_its_lock_goes_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, theirs: str, ours: str
) -> None:
    path = tmp_path / "lock"
    if ours == "no locks":
        refuse_locks(monkeypatch)
    process = holder(path, theirs)
    try:
        with pytest.raises(UsageError, match=rf"in use by process {process.pid}"), files.exclusive_lock(path):
            pass
    finally:
        end(process)
    with files.exclusive_lock(path, wait_seconds=10.0):
        pass


def test_of_a_holder_on_another_machine_the_user_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_locks(monkeypatch)
    path, note = tmp_path / "lock", tmp_path / "lock.note"
    note.write_text("7 on gpu-server\nabc-1~7~9\ntoken")
    with (
        pytest.raises(
            UsageError, match=rf"process 7 on gpu-server; wait .* remove {note} if you know that it has ended"
        ),
        files.exclusive_lock(path),
    ):
        pass
    assert note.exists()
    note.unlink()
    with files.exclusive_lock(path):
        pass


@pytest.mark.slow
def test_of_many_who_find_a_dead_holder_one_at_a_time_takes_over(tmp_path: Path) -> None:
    path, count = tmp_path / "lock", tmp_path / "count"
    end(holder(path, "no locks"))
    assert (tmp_path / "lock.note").exists()
    count.write_text("0")
    code = HOLDER.replace("time.sleep(60)", "n = int(c.read_text()); time.sleep(0.01); c.write_text(str(n + 1))")
    code = code.replace("(sys.argv[1]))", "(sys.argv[1]), 60.0)").replace(
        "with files", "c = pathlib.Path(sys.argv[3])\nwith files"
    )
    command = [sys.executable, "-c", code, str(path), "no locks", str(count)]
    for process in [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(6)]:
        assert process.wait() == 0
    assert count.read_text() == "6"


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS])
def test_only_the_first_creator_wins_without_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    refuse_links(monkeypatch, number)
    path = tmp_path / "a.json"
    assert files.create_exclusively(path, b"first")
    assert not files.create_exclusively(path, b"second")
    assert path.read_bytes() == b"first"
    assert sorted(each.name for each in tmp_path.iterdir()) == [".tmp-create.lock", "a.json"]


def test_a_link_that_fails_for_another_reason_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_links(monkeypatch, errno.EIO)
    with pytest.raises(OSError, match="Input/output"):
        files.create_exclusively(tmp_path / "a.json", b"first")
    assert list(tmp_path.iterdir()) == []


def test_a_store_works_where_the_disk_can_do_hardly_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_locks(monkeypatch)
    refuse_links(monkeypatch)
    fsync = os.fsync

    def files_only(descriptor: int) -> None:
        if os.path.isdir(descriptor):  # noqa: PTH112 - a descriptor.
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", files_only)
    store = Store.create(tmp_path / "store", fabricate_setting())
    plan = Plan(setting=store.setting)
    with store.only_driver():
        for start in (0, 2):
            job = Job(plan.key, start, start + 2)
            store.commit(plan, job, [fabricate_rollout(plan, index) for index in range(start, start + 2)], {})
    assert [job.start for job in store.jobs()] == [0, 2]
    assert verify(store) == []


def test_a_folder_that_cannot_be_synced_for_a_real_reason_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(OSError, match="Input/output"):
        files.sync_folder(tmp_path)


def test_a_machine_with_the_same_name_is_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = files.process_name()
    boot = tmp_path / "boot_id"
    boot.write_text("3f0e1c9e-0000-4000-8000-000000000000\n")
    monkeypatch.setattr(files, "_BOOT_ID", boot)
    files.machine_name.cache_clear()
    files._process_space.cache_clear()
    try:
        theirs = files.process_name()
        assert theirs.partition("~")[2] == ours.partition("~")[2]
        assert theirs != ours
        assert not files.is_gone(ours.replace(f"~{os.getpid()}~", "~999999999~"))
        assert files.is_gone(theirs.replace(f"~{os.getpid()}~", "~999999999~"))
        assert files.host_name() not in theirs
    finally:
        files.machine_name.cache_clear()
        files._process_space.cache_clear()


def test_what_another_machine_left_is_removed_after_a_day(tmp_path: Path) -> None:
    fresh, old = (tmp_path / f".tmp-shard~abc-1~7~9~0{number}" for number in (1, 2))
    for path in (fresh, old):
        path.write_bytes(b"x")
    long_ago = time.time() - 2 * 86400
    os.utime(old, (long_ago, long_ago))
    assert not files.remove_if_abandoned(fresh)
    assert files.remove_if_abandoned(old)
    assert list(tmp_path.iterdir()) == [fresh]
