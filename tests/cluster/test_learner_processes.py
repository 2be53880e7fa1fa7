"""Learner processes: their errors become ours, and they never outlive the driver."""

import os
import signal
import subprocess
import sys
import textwrap
import time
import tomllib
from pathlib import Path

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster import children, training
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
            print("step 1", flush=True)
            if sys.argv[1] == "refuse":
                print("setting 'steps': too few", file=sys.stderr); sys.exit(2)
            if sys.argv[1] == "crash":
                sys.exit(7)
            if sys.argv[1] == "hang":
                time.sleep(60)
            print(os.environ["OMP_NUM_THREADS"])
            """
        )
    )
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{Path(__file__).parents[2]}")
    return folder


def test_its_lines_are_passed_on_and_kept(learner: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    children.run_child(STAND_IN, ["work"], tmp_path / "out", lines.append)
    assert lines == ["step 1", str(children.THREADS)]
    assert (tmp_path / "out" / children.OUTPUT_FILE).read_text().splitlines() == lines


def test_what_it_refuses_is_refused_in_its_words(learner: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^setting 'steps': too few$"):
        children.run_child(STAND_IN, ["refuse"], tmp_path, lambda line: None)


def test_a_crash_names_its_output(learner: Path, tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r"ended with code 7; see .*output\.txt$"):
        children.run_child(STAND_IN, ["crash"], tmp_path, lambda line: None)


def test_an_interrupt_ends_it(learner: Path, tmp_path: Path) -> None:
    def interrupt(line: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        children.run_child(STAND_IN, ["hang"], tmp_path, interrupt)
    assert not [child for child in psutil.Process().children() if STAND_IN in " ".join(child.cmdline())]


def test_it_dies_with_a_driver_that_is_killed(learner: Path, tmp_path: Path) -> None:
    driver = subprocess.Popen(
        [
            sys.executable,
            "-uc",
            "import pathlib; from cluster import children;"
            f"children.run_child({STAND_IN!r}, ['hang'], pathlib.Path({str(tmp_path)!r}), print)",
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


scalars = st.integers(-5, 5) | st.floats(allow_nan=False, allow_infinity=False) | st.booleans() | st.text('aé"\\\n ')
settings = st.recursive(
    scalars | st.lists(scalars, max_size=3),
    lambda inner: st.dictionaries(st.sampled_from(["a", "b", "c"]), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from(["a", "b", "c"]), settings))
def test_settings_survive_toml(values: dict[str, object]) -> None:
    assert tomllib.loads(training.as_toml(values)) == values
    assert tomllib.loads(training.as_toml({**values, "none": None})) == values
