"""Laws of the file layer: whole or not at all, bounded, and never taken from a live process."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.errors import StoreError, UsageError
from shared.io import files
from shared.types import pack_normals, round_normals, round_points, unpack_normals
from tests.support.killed_writers import kill_while_writing


def test_writing_replaces_the_whole_content_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    files.write_atomically(path, b"long old content")
    files.write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    files.write_atomically(path, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for write in (files.write_atomically, files.create_exclusively):
        with pytest.raises(OSError, match="No space") as raised:
            write(path, b"new")
        assert raised.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_only_the_first_creator_wins(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    assert files.create_exclusively(path, b"first")
    assert not files.create_exclusively(path, b"second")
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]


def test_durable_writing_never_replaces(tmp_path: Path) -> None:
    files.write_durably(tmp_path / "a", b"1")
    with pytest.raises(FileExistsError):
        files.write_durably(tmp_path / "a", b"2")


@given(data=st.binary(max_size=64), limit=st.integers(0, 64))
def test_reading_is_bounded(tmp_path_factory: pytest.TempPathFactory, data: bytes, limit: int) -> None:
    path = tmp_path_factory.getbasetemp() / "bounded"
    path.write_bytes(data)
    if len(data) <= limit:
        assert files.read_bounded(path, limit) == data
    else:
        with pytest.raises(StoreError, match="larger"):
            files.read_bounded(path, limit)


def test_reading_refuses_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"secret")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe", "missing", "."):
        with pytest.raises(StoreError) as caught:
            files.read_bounded(tmp_path / name, 100)
        assert "\n" not in str(caught.value)


def test_a_lock_names_its_holder_and_dies_with_it(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    code = "import sys, time, pathlib; from shared.io.files import exclusive_lock\n"
    code += f"with exclusive_lock(pathlib.Path({str(path)!r})): print('held', flush=True); time.sleep(60)"
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(UsageError, match=rf"in use by process {holder.pid}"), files.exclusive_lock(path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        holder.stdout.close()
    with files.exclusive_lock(path):
        assert path.read_text().startswith(f"{os.getpid()} on ")
    with files.exclusive_lock(path):
        pass


def test_a_lock_waits_as_long_as_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(files, "time", SimpleNamespace(monotonic=lambda: sum(waits), sleep=waits.append))
    with files.exclusive_lock(tmp_path / "lock"):
        with pytest.raises(UsageError), files.exclusive_lock(tmp_path / "lock", wait_seconds=0.05):
            pass
        assert 0.05 <= sum(waits) < 0.1


def test_only_what_the_dead_left_is_removed(tmp_path: Path) -> None:
    code = f"from shared.io.files import temporary_name; import pathlib; (pathlib.Path({str(tmp_path)!r})"
    code += " / temporary_name('shard')).mkdir()"
    subprocess.run([sys.executable, "-c", code], check=True)
    left = next(tmp_path.iterdir())
    (left / "file").write_bytes(b"x")
    ours = tmp_path / files.temporary_name("shard")
    ours.write_bytes(b"x")
    other = tmp_path / ".tmp-of-something-else"
    other.write_bytes(b"x")
    # The number of a live process, but another start time: a stranger that was given a dead writer's number.
    reused = tmp_path / left.name.replace(left.name.split("~")[2], str(os.getpid()))
    reused.mkdir()
    assert [files.remove_if_abandoned(path) for path in (left, ours, other, reused)] == [True, False, False, True]
    assert sorted(tmp_path.iterdir()) == sorted([ours, other])


@pytest.mark.parametrize("write", [files.write_atomically, files.create_exclusively])
def test_what_a_killed_writer_left_goes_when_a_process_first_writes_beside_it(
    write: Callable[[Path, bytes], object], tmp_path: Path
) -> None:
    kill_while_writing(tmp_path / "sheet.png")
    write(tmp_path / "other.png", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["other.png"]


def test_what_the_dead_left_and_cannot_be_removed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left = kill_while_writing(tmp_path / "a.json")

    def refuse(path: Path) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(files, "remove_tree", refuse)
        files.remove_remnants(tmp_path)
        assert left.exists()
    files.remove_remnants(tmp_path)
    assert not left.exists()


def test_a_scratch_folder_of_a_killed_process_goes_with_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import os, signal; from shared.io.files import scratch_folder\n"
    code += "with scratch_folder('export') as folder:\n"
    code += "    (folder / 'piece').write_bytes(b'x'); os.kill(os.getpid(), signal.SIGKILL)"
    killed = subprocess.run([sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert (left / "piece").exists()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with files.scratch_folder("export") as folder, files.scratch_folder("bench") as other:
        assert sorted(tmp_path.iterdir()) == sorted([folder, other])
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not list(tmp_path.iterdir())


def test_a_folder_for_results_has_nothing_of_killed_writers(tmp_path: Path) -> None:
    left = kill_while_writing(tmp_path / "a.json")
    (tmp_path / "b.json").touch()
    files.make_folder(tmp_path)
    assert not left.exists()
    assert (tmp_path / "b.json").exists()


def test_removing_a_link_leaves_what_it_points_at(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    files.remove_tree(tmp_path / "link")
    assert (tmp_path / "folder" / "file").exists()
    assert not (tmp_path / "link").exists()


@given(st.lists(st.floats(-60000, 60000, width=32), min_size=3, max_size=30))
def test_rounding_points_twice_changes_nothing(values: list[float]) -> None:
    points = round_points(np.array(values))
    assert points.dtype == np.float32
    assert np.array_equal(round_points(points), points)
    assert np.abs(points - np.array(values)).max() <= np.abs(values).max() * 2**-11 + 2**-24


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=30))
def test_rounding_normals_twice_changes_nothing(values: list[float]) -> None:
    normals = round_normals(np.array(values))
    assert normals.dtype == np.float32
    assert np.array_equal(unpack_normals(pack_normals(normals)), normals)
    assert np.abs(normals - np.array(values)).max() <= 0.5 / 127 + 1e-6


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "loop", "missing", "large"])
def test_what_a_user_names_and_is_no_file_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "named"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "device":
            path.symlink_to("/dev/zero")
        case "loop":
            path.symlink_to("named")
        case "large":
            path.write_bytes(bytes(11))
    with pytest.raises(UsageError, match=r"named: .*; name another"):
        files.read_named(path, 10, "name another")


def test_a_link_that_a_user_names_is_followed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    (tmp_path / "b").symlink_to("a")
    assert files.read_named(tmp_path / "b", 3, "") == b"abc"
