"""Folders of one user alone, where other users of the machine write beside them."""

import os
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.errors import UsageError
from shared.io import private
from shared.io.files import process_name
from shared.io.private import private_folder
from shared.store.crash_log import CrashLog, Heartbeat

OTHER = 54321
"""A user who is not this one, and need not exist."""
BUCKET = "s3://bucket/store"
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may become a second user")


@pytest.fixture
def base() -> Iterator[Path]:
    """A folder as /tmp is: with a short name, and anybody may write to it."""
    with tempfile.TemporaryDirectory(prefix="", dir="/tmp") as folder:
        Path(folder).chmod(0o1777)
        yield Path(folder)


@pytest.fixture(autouse=True)
def temporary(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is where temporary files go."""
    monkeypatch.setattr(private, "_TEMPORARY", (str(base),))
    monkeypatch.delenv("TMPDIR", raising=False)


@pytest.fixture
def own(base: Path) -> Path:
    """The folder of this user there, not made."""
    return base / f"adaafford-{os.geteuid()}"


def by_other(command: str) -> subprocess.CompletedProcess[str]:
    """What a second user of the machine does."""
    return subprocess.run(
        ["sh", "-c", command], user=OTHER, group=OTHER, extra_groups=[], cwd="/", capture_output=True, text=True
    )


def test_a_folder_is_made_for_this_user_alone_and_found_again(own: Path) -> None:
    folder = private_folder("ray")
    assert folder == own / "ray"
    assert [stat.S_IMODE(each.stat().st_mode) for each in (own, folder)] == [0o700, 0o700]
    (folder / "file").touch()
    assert private_folder("ray") == folder
    assert (folder / "file").exists()


@pytest.mark.parametrize("kind", ["missing", "a file", "relative", "too long for sockets", "open to all", "empty"])
def test_a_tmpdir_that_will_not_do_is_passed_over(kind: str, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = own.parent / ("x" * 60 if kind == "too long for sockets" else "x")
    if kind == "a file":
        folder.touch()
    elif kind != "missing":
        folder.mkdir()
    if kind == "open to all":
        folder.chmod(0o777)
    monkeypatch.chdir(own.parent)
    named = {"relative": "x", "empty": ""}
    monkeypatch.setenv("TMPDIR", named.get(kind, str(folder)))
    assert private_folder("ray") == own / "ray"


def test_tmpdir_comes_first(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="", dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        assert private_folder("ray").is_relative_to(folder)
    assert list(base.iterdir()) == []


@pytest.mark.parametrize("kind", ["a link", "a file", "others may enter", "another user's"])
def test_what_somebody_else_has_put_there_is_not_used(kind: str, own: Path, tmp_path: Path) -> None:
    if kind == "a link":
        own.symlink_to(tmp_path)
    elif kind == "a file":
        own.touch()
    elif kind == "others may enter":
        own.mkdir(0o755)
    elif os.geteuid() != 0:
        pytest.skip("only root may give a folder away")
    else:
        own.mkdir(0o700)
        os.chown(own, OTHER, OTHER)
    with pytest.raises(UsageError, match=rf"{own}: not a folder of this user alone\); set TMPDIR to a folder"):
        private_folder("ray")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@as_root
def test_a_second_user_reads_and_replaces_nothing(own: Path) -> None:
    crash_log = CrashLog(None, BUCKET)
    with crash_log.open_fault_log() as log:
        log.write(b"Fatal Python error: Aborted\n")
    (file,) = own.glob("underway-*/*.fault")
    attempts = (f"ls {own}", f"ls {file.parent}", f"cat {file}", f"ln -s /etc/passwd {file.parent}/link")
    attempts += (f"rm -rf {own}", f"mv {own} {own}-away", f"echo forged > {file}")
    for attempt in attempts:
        by_other(attempt)
        assert by_other(attempt).stdout == ""
    assert by_other(f"cd {own}").returncode != 0
    assert crash_log.fault_of(process_name()) == "Aborted"
    assert [path.name for path in own.parent.iterdir()] == [own.name]
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@as_root
def test_a_second_user_who_was_there_first_learns_and_changes_nothing(own: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("untouched")
    assert by_other(f"mkdir -m 777 {own} && ln -s {victim} {own}/ray").returncode == 0
    with pytest.raises(UsageError, match="not a folder of this user alone"), CrashLog(None, BUCKET).open_fault_log():
        pass
    assert [path.name for path in own.iterdir()] == ["ray"]
    assert victim.read_text() == "untouched"


@pytest.mark.parametrize("kind", ["a link", "a pipe"])
def test_crash_logs_and_heartbeats_go_through_no_link_and_wait_for_nobody(kind: str, tmp_path: Path) -> None:
    """Of a store on a disk, which several people may write to."""
    folder, victim = tmp_path / "underway", tmp_path / "victim"
    folder.mkdir()
    victim.write_text("untouched")
    crash_log = CrashLog(folder)
    for name in (f"{process_name()}.fault", f"{process_name()}.json"):
        if kind == "a link":
            (folder / name).symlink_to(victim)
        else:
            os.mkfifo(folder / name)
    with pytest.raises(OSError):
        crash_log.open_fault_log()
    with pytest.raises(OSError):
        crash_log.leave(Heartbeat(shard_id="random-v0-00000000-00000001", rollout=0))
    assert victim.read_text() == "untouched"
