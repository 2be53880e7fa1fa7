"""Standard streams that are closed, full or broken: no traceback, nothing lost, and no code 0 without its output."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cluster.cli.main import COMMANDS
from collector.objects.procedural.catalogue import generate
from shared.plan import Job, Plan
from shared.policies.policy import Policy
from shared.store import Store
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.finished_run import SMALL_NETWORK, make_finished_run

ADAAFFORD = (sys.executable, "-m", "cluster")
SPEAKING = {
    "version": ["version"],
    "help": ["--help"],
    "run": ["run", "--preset", "smoke", "--dry-run"],
    "resume": ["resume", "--help"],
    "evaluate": ["evaluate", "--help"],
    "compare": ["compare", "--help"],
    "report": ["report", "--help"],
    "adapt": ["adapt", "--help"],
    "export-policy": ["export-policy", "RUN", "--out", "EXPORTED"],
    "calibrate": ["calibrate", "--help"],
    "collect": ["collect", "--help"],
    "train": ["train", "--help"],
    "curve": ["curve", "--help"],
    "status": ["status", "STORE"],
    "status of a run as JSON": ["status", "RUN", "--json"],
    "learn": ["learn", "--help"],
    "store": ["store", "info", "STORE"],
    "store verify": ["store", "verify", "STORE"],
    "store digest": ["store", "digest", "STORE"],
    "objects": ["objects", "check", "OBJECTS"],
    "bench": ["bench", "--help"],
    "view": ["view", "--help"],
    "rehearse": ["rehearse", "--help"],
}
"""Cheap command lines that say something and end with 0."""
REFUSED = {
    "an unknown command": ["rum"],
    "a missing run": ["resume", "MISSING"],
    "a missing store": ["store", "info", "MISSING"],
    "a wrong flag": ["collect", "--store", "MISSING", "--rollouts", "x"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("streams")
    generate(folder / "OBJECTS", {"Faucet": 2}, seed=1)
    run = make_finished_run(folder / "RUN")
    run.log.write_text("")
    store = Store.create(folder / "STORE", fabricate_setting())
    plan = Plan(setting=store.setting)
    job = Job(plan.key, 0, 2)
    store.commit(plan, job, fabricate_rollouts(plan, job), {})
    store.publish_policy(1, Policy.untrained(store.setting.task, SMALL_NETWORK, seed=1).to_files())
    return folder


def ended(
    folder: Path, redirection: str, args: Sequence[str], environment: dict[str, str] | None = None
) -> "subprocess.CompletedProcess[bytes]":
    """A command line that was run with some of its streams redirected, as a shell does it."""
    command = ["bash", "-c", f'"$@" {redirection}', "bash", *ADAAFFORD, *args]
    root = str(Path(__file__).parents[2])
    return subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": root, "PYTHONSAFEPATH": "1", **(environment or {})},
        capture_output=True,
        stdin=subprocess.DEVNULL,
    )


def all_ended(
    folder: Path, redirection: str, lines: dict[str, list[str]], environment: dict[str, str] | None = None
) -> dict[str, "subprocess.CompletedProcess[bytes]"]:
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(lambda args: ended(folder, redirection, args, environment), lines.values())
        return dict(zip(lines, done, strict=True))


def test_every_command_is_in_the_table() -> None:
    assert {args[0] for args in SPEAKING.values()} >= COMMANDS.keys()


@pytest.mark.slow
@pytest.mark.parametrize("redirection", [">&-", "> /dev/full"])
def test_output_that_cannot_be_written_is_no_success(folder: Path, redirection: str) -> None:
    for name, done in all_ended(folder, redirection, SPEAKING).items():
        said = done.stderr.decode()
        assert done.returncode == 1, name
        assert "Traceback" not in said and "Exception" not in said, name
        assert said.splitlines()[-1].startswith("adaafford: the standard output could not be written ("), name


@pytest.mark.slow
@pytest.mark.parametrize("redirection", ["2>&-", "2> /dev/full", "< /dev/null 2>&- <&-"])
def test_progress_that_nobody_sees_changes_nothing(folder: Path, redirection: str) -> None:
    for name, done in all_ended(folder, redirection, SPEAKING).items():
        assert (done.returncode, bool(done.stdout)) == (0, True), name
    for name, done in all_ended(folder, redirection, REFUSED).items():
        assert done.returncode == 2, name


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii", "COLUMNS": "1", "TERM": "dumb"},
        {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "COLUMNS": "0"},
        {"COLUMNS": "-7", "LINES": "x", "TERM": "no-such-terminal", "NO_COLOR": "1"},
    ],
)
def test_a_poor_terminal_is_enough(folder: Path, environment: dict[str, str]) -> None:
    for name, done in all_ended(folder, "", SPEAKING, environment).items():
        assert (done.returncode, done.stderr) == (0, b""), name
        assert done.stdout, name


def without_reader(folder: Path, args: Sequence[str], unbuffered: bool) -> "subprocess.CompletedProcess[bytes]":
    """A command line whose output goes into a pipe that nobody reads."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "PYTHONUNBUFFERED": "1" * unbuffered}
    reading, writing = os.pipe()
    os.close(reading)
    try:
        command = [*ADAAFFORD, *args]
        return subprocess.run(command, cwd=folder, env=environment, stdout=writing, stderr=subprocess.PIPE)
    finally:
        os.close(writing)


@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("args", [["--help"], ["objects", "check", "OBJECTS"]], ids=lambda args: args[0])
def test_a_reader_that_has_enough_ends_the_command_without_a_word(
    folder: Path, args: list[str], unbuffered: bool
) -> None:
    done = without_reader(folder, args, unbuffered)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


@pytest.mark.slow
def test_a_reader_that_has_enough_ends_every_command_that_only_prints_without_a_word(folder: Path) -> None:
    more = {
        "store info as JSON": ["store", "info", "STORE", "--json"],
        "store compact": ["store", "compact", "STORE"],
        "store help": ["store", "--help"],
    }
    lines = [args for args in (SPEAKING | more).values() if "--out" not in args]
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(lambda args: without_reader(folder, args, unbuffered=True), lines)
        for args, each in zip(lines, done, strict=True):
            assert (each.returncode, each.stderr) == (128 + signal.SIGPIPE, b""), args


@pytest.mark.slow
def test_what_goes_into_out_is_written_although_nobody_reads_the_output(folder: Path) -> None:
    done = without_reader(folder, ["store", "merge", "STORE", "--out", "MERGED"], unbuffered=True)
    assert done.returncode == 1
    assert done.stderr.decode().splitlines()[-1].startswith("adaafford: the standard output could not be written (")
    assert Store.open(folder / "MERGED").digest() == Store.open(folder / "STORE").digest()


def test_a_closed_stream_takes_no_file_of_ours(folder: Path) -> None:
    # Without /dev/null in its place, the first file that is opened would have the number of the standard output.
    code = "from cluster.cli.main import begin_process; begin_process(); import os\n"
    code += "print('lost'); file = os.open('made', os.O_CREAT | os.O_WRONLY); assert file > 2, file\n"
    code += "os.write(1, b'by a library'); assert input_is_empty()"
    code = code.replace("input_is_empty()", "__import__('sys').stdin.read() == ''")
    command = ["bash", "-c", '"$@" <&- >&- 2>&-', "bash", sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    assert subprocess.run(command, cwd=folder, env=environment).returncode == 0
    assert (folder / "made").read_bytes() == b""


def test_long_work_goes_on_when_its_reader_has_gone(tmp_path: Path) -> None:
    code = (
        "import sys; sys.argv = ['adaafford', 'train', 'prior']\n"
        "import cluster.cli.commands.train as train, cluster.cli.main as cli\n"
        "def long(args):\n"
        "    for step in range(20000): print('step', step, flush=step % 100 == 0)\n"
        "    open('done', 'w').close()\n"
        "    return 0\n"
        "train.main = long\n"
        "cli.main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == "step 0\n"
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 1
    assert (tmp_path / "done").exists()
    assert said.startswith("adaafford: the standard output could not be written (Broken pipe)")
    assert said.count("\n") == 1


@pytest.mark.parametrize(("ignored", "code"), [(False, 128 + signal.SIGHUP), (True, 0)])
def test_a_terminal_that_goes_away_ends_a_command_in_an_orderly_way_unless_told_otherwise(
    tmp_path: Path, ignored: bool, code: int
) -> None:
    script = (
        "import os, signal, time, sys\n"
        f"signal.signal(signal.SIGHUP, {'signal.SIG_IGN' if ignored else 'signal.SIG_DFL'})\n"
        "from cluster.cli.main import begin_process; begin_process()\n"
        "try: os.kill(os.getpid(), signal.SIGHUP); time.sleep(0.1)\n"
        "finally: open('tidied', 'w').close()"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    assert subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment).returncode == code
    assert (tmp_path / "tidied").exists()


def test_what_an_encoding_lacks_is_written_with_backslashes() -> None:
    code = "from cluster.cli.main import begin_process; begin_process(); print('caf\\u00e9 \\udcff', flush=True)"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout == b"caf\\xe9 \\udcff\n"


def test_what_the_system_refuses_is_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from cluster.cli import main

    def full() -> int:
        raise OSError(28, "No space left on device", "runs/a/log.jsonl")

    assert main.guarded(full, ["run"]) == 1
    said = capsys.readouterr().err
    assert said == "adaafford: runs/a/log.jsonl: No space left on device; correct this and run the same command again\n"
