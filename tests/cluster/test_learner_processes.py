"""Learner processes: their errors become ours, and they never outlive the driver."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from pathlib import Path

import psutil
import pytest

from cluster.runs.subprocesses import THREADS, Child
from learner.settings import OUTPUT_FILE
from shared.errors import UsageError, WorkerError

STAND_IN = "learner_stand_in"


@pytest.fixture
def learner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that stands in for the learner: it does what its argument says."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / f"{STAND_IN}.py").write_text(
        textwrap.dedent(
            """
            import os, sys, time
            from shared.errors import UsageError
            def act(what):
                print("step 1", flush=True)
                if what == "refuse":
                    raise UsageError("setting 'steps': too few")
                if what == "crash":
                    os._exit(7)
                if what == "hang":
                    time.sleep(60)
                print(os.environ["OMP_NUM_THREADS"])
            """
        )
    )
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{Path(__file__).parents[2]}")
    return folder


def act(what: str, out: Path, lines: list[str]) -> None:
    with closing(Child(lines.append)) as child:
        child.run(f"{STAND_IN}:act", {"what": what}, out)


def test_its_lines_are_passed_on_and_kept(learner: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    act("work", tmp_path / "out", lines)
    assert lines == ["step 1", str(THREADS)]
    assert (tmp_path / "out" / OUTPUT_FILE).read_text().splitlines() == lines


def test_what_it_refuses_is_refused_in_its_words(learner: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^setting 'steps': too few$"):
        act("refuse", tmp_path, [])


def test_a_crash_names_its_output_and_the_next_call_has_a_process_of_its_own(learner: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    with closing(Child(lines.append)) as child:
        with pytest.raises(WorkerError, match=r"ended with code 7; see .*output\.txt$"):
            child.run(f"{STAND_IN}:act", {"what": "crash"}, tmp_path)
        child.run(f"{STAND_IN}:act", {"what": "work"}, tmp_path)
    assert lines == ["step 1", "step 1", str(THREADS)]


def test_an_interrupt_ends_it(learner: Path, tmp_path: Path) -> None:
    def interrupt(line: str) -> None:
        raise KeyboardInterrupt

    with closing(Child(interrupt)) as child, pytest.raises(KeyboardInterrupt):
        child.run(f"{STAND_IN}:act", {"what": "hang"}, tmp_path)
    assert not [child for child in psutil.Process().children() if "cluster.cli.child" in child.cmdline()]


def test_it_dies_with_a_driver_that_is_killed(learner: Path, tmp_path: Path) -> None:
    driver = subprocess.Popen(
        [
            sys.executable,
            "-uc",
            "import pathlib; from cluster.runs.subprocesses import Child;"
            f"Child(print).run('{STAND_IN}:act', {{'what': 'hang'}}, pathlib.Path({str(tmp_path)!r}))",
        ],
        stdout=subprocess.PIPE,
    )
    assert driver.stdout is not None
    driver.stdout.readline()
    children = psutil.Process(driver.pid).children()
    assert len(children) == 1
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    driver.stdout.close()
    deadline = time.monotonic() + 60
    while children[0].is_running() and children[0].status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.02)
