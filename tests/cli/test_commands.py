"""The command line: one clear line and code 2 for bad input, and instant help."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from adaafford import console
from cluster.cli.main import COMMANDS, guarded, only_prints, run
from shared.store import Store
from shared.tasks import TEST_CATEGORIES
from tests.support.fabricate import fabricate_setting


def complaint(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """The one line that a refused command line prints."""
    assert run(list(args)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("adaafford: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


def with_signals(*lines: str) -> "subprocess.CompletedProcess[str]":
    """The command line in a process that ignores no signal, after some lines of Python that change it."""
    begin = (
        "import signal, sys; from cluster.cli import main",
        "signal.signal(signal.SIGINT, signal.default_int_handler); signal.signal(signal.SIGHUP, signal.SIG_DFL)",
    )
    script = "\n".join((*begin, *lines, "main.main()"))
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; from cluster.cli.main import run; assert run(['--help']) == 0;"
        "print(sorted({'torch', 'ray', 'sapien', 'zarr', 'matplotlib', 'tyro', 'numpy'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert all(name in done.stdout for name in COMMANDS)


@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - {"version", "store", "objects", "bench", "train"}))
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run([command, "--help"])
    assert stop.value.code == 0
    assert f"adaafford {command}" in capsys.readouterr().out


def test_an_unknown_command_lists_those_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert "allowed: run, resume" in complaint(capsys, "rum")


def test_an_unknown_task_lists_those_there_are(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for command in (["run", "--out"], ["collect", "--store"]):
        line = complaint(capsys, *command, str(tmp_path / "new"), "--task", "pusk")
        assert "unknown task 'pusk'; allowed: push, pull" in line
    assert not (tmp_path / "new").exists()


def test_a_missing_folder_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    gone = str(tmp_path / "gone")
    assert gone in complaint(capsys, "objects", "check", gone)
    assert gone in complaint(capsys, "store", "info", gone)
    assert gone in complaint(capsys, "resume", gone)
    assert gone in complaint(capsys, "report", gone)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[rollouts]\nrandum = 3\n", "unknown setting 'rollouts.randum'; did you mean 'random'?"),
        ("[rollouts]\nrandom = 0\n", "setting 'rollouts.random'"),
        ("[rollouts\n", "not valid TOML"),
        ("[splits]\ntrain = 0.9\n", "must sum to 1"),
    ],
)
def test_a_bad_configuration_file_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, text: str, expected: str
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    line = complaint(capsys, "run", "--config", str(file), "--out", str(tmp_path / "run"))
    assert expected in line
    assert str(file) in line


def test_an_unknown_preset_lists_those_there_are(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    line = complaint(capsys, "run", "--preset", "huge", "--out", str(tmp_path / "run"))
    assert "unknown preset 'huge'; allowed: laptop, paper, smoke" in line


def test_a_place_with_other_things_is_refused_before_objects_are_made(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("x")
    Store.create(tmp_path / "store", fabricate_setting())
    for name, said in (("foreign", "is not empty and no store"), ("store", "holds another setting")):
        assert said in complaint(capsys, "collect", "--store", str(tmp_path / name), "--workers", "0")
        assert not (tmp_path / f"{name}-objects").exists()


@pytest.mark.parametrize(
    "command",
    [
        "run --out FILE",
        "evaluate --policy push-faucet --objects GONE --out FILE",
        "compare GONE --out FILE",
        "rehearse FILE --task push",
        "export-policy GONE --out FILE",
        "calibrate --policy GONE --store GONE --out FILE",
        "train prior --store GONE --out FILE",
        "train segmentation --scenes GONE --out FILE",
        "learn --store GONE --out FILE",
        "curve --store GONE --runs a=GONE --out FILE",
        "objects generate FILE",
        "objects import GONE --out FILE",
        "objects export GONE --out FILE",
        "objects scenes GONE FILE",
        "bench collect --out FILE",
    ],
)
def test_a_file_in_the_place_of_a_folder_is_refused_before_anything_is_done(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    (tmp_path / "nowhere").symlink_to("gone")
    for out in (file, file / "below", tmp_path / "nowhere"):
        words = [str({"FILE": out, "GONE": tmp_path / "missing"}.get(word, word)) for word in command.split()]
        line = complaint(capsys, *words)
        assert f"{out}: no folder can be made of this name" in line
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    "command",
    [
        "adapt --cloud GONE --history GONE --out OUT.ply",
        "view GONE.ply --out OUT.npz",
    ],
)
def test_a_file_is_refused_where_it_cannot_be_before_anything_is_done(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    name = command.rpartition(".")[2]
    (tmp_path / f"folder.{name}").mkdir()
    for out, said in (("none/out", "there is no folder"), ("folder", "is a folder; name a file")):
        words = command.replace("GONE", str(tmp_path / "missing")).replace("OUT", str(tmp_path / out)).split()
        assert f"{tmp_path / out}.{name}: {said}" in complaint(capsys, *words)


def test_a_picture_of_another_kind_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for action in ("preview", "film"):
        out = tmp_path / "sheet.xyz"
        assert f"{out}: not a kind of picture" in complaint(capsys, "objects", action, str(tmp_path), str(out))
        assert not out.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_says_how_to_go_on(number: signal.Signals) -> None:
    done = with_signals(
        f"main._run = lambda args: signal.raise_signal({int(number)})",
        "sys.argv[1:] = ['collect', '--store', 'my store']",
    )
    assert done.returncode == 128 + number
    assert done.stderr == (
        "adaafford: interrupted; committed data stay, and the same command continues: "
        "adaafford collect --store 'my store'\n"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_whose_exception_a_library_drops_ends_the_command(number: signal.Signals) -> None:
    done = with_signals(
        "import time, weakref",
        "def version(args):",
        "    thing = {*()}",
        f"    reference = weakref.ref(thing, lambda _: signal.raise_signal({int(number)}))",
        "    del thing",
        "    time.sleep(100)",
        "main.import_module('cluster.cli.commands.version').main = version",
        "sys.argv[1:] = ['version']",
    )
    assert (done.returncode, done.stderr) == (128 + number, "adaafford: interrupted\n")


@pytest.mark.parametrize("error", ["AttributeError('half imported')", "StoreError('damaged')"])
def test_what_fails_after_a_signal_is_an_interruption(error: str) -> None:
    done = with_signals(
        "from shared.errors import StoreError",
        "def version(args):",
        "    try: signal.raise_signal(signal.SIGINT)",
        f"    except BaseException: raise {error} from None",
        "main.import_module('cluster.cli.commands.version').main = version",
        "sys.argv[1:] = ['version']",
    )
    assert (done.returncode, done.stderr) == (130, "adaafford: interrupted\n")


def test_an_interrupt_before_the_command_line_is_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(console, "import_module", interrupted)
    with pytest.raises(SystemExit) as ended:
        console.main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "adaafford: interrupted\n"


@pytest.mark.parametrize("args", [["--rollouts", "x"], ["--rolouts", "3"], ["--rollouts", "0"]])
def test_bad_flags_end_with_code_2(args: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "roll" in complaint(capsys, "collect", "--store", str(tmp_path / "store"), *args)


def test_aip_needs_a_policy(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "--policy" in complaint(capsys, "collect", "--store", str(tmp_path), "--proposer", "aip")


def test_a_folder_with_something_else_is_left_alone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    assert "holds something that is not a run" in complaint(capsys, "run", "--out", str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_store_of_another_schema_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "store.json").write_text(json.dumps({"schema_version": 999}))
    assert "schema" in complaint(capsys, "store", "info", str(tmp_path))


def test_objects_are_made_of_a_group_of_categories(tmp_path: Path) -> None:
    assert run(["objects", "generate", str(tmp_path), "--per-category", "1", "--categories", "test", "Box"]) == 0
    made = {folder.name.removesuffix("-0000") for folder in tmp_path.iterdir()}
    assert made == {name.lower() for name in (*TEST_CATEGORIES, "Box")}


@pytest.mark.parametrize(
    "args",
    [
        ["objects", "generate", "DIR", "--per-category", "0"],
        ["objects", "export", "DIR", "--out", "DIR", "--part-mass", "0"],
        ["train", "segmentation", "--scenes", "DIR", "--out", "DIR", "--seed", "-1"],
        ["objects", "import", "DIR", "--out", "DIR", "--size", "inf"],
        ["objects", "import", "DIR", "--out", "DIR", "--scale", "nan"],
    ],
)
def test_a_flag_out_of_bounds_is_refused_in_one_line(
    args: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = complaint(capsys, *(str(tmp_path) if word == "DIR" else word for word in args))
    assert args[-2].strip("-").replace("-", "_") in line
    assert "Input should be greater than" in line or "Input should be a finite number" in line
    assert list(tmp_path.iterdir()) == []


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip()[0].isdigit()


@pytest.mark.parametrize("columns", ["0", "1"])
def test_a_terminal_without_columns_is_written_to(columns: str) -> None:
    script = (
        "from cluster.cli.main import begin_process; begin_process()\n"
        "from rich.console import Console; Console().print('all of it')"
    )
    told = {**os.environ, "COLUMNS": columns}
    done = subprocess.run([sys.executable, "-c", script], env=told, capture_output=True, text=True, check=True)
    assert done.stdout == "all of it\n"


def test_threads_that_wait_for_each_other_do_not_keep_a_busy_processor_for_long() -> None:
    begin = "from cluster.cli.main import begin_process; begin_process()"
    script = f"import os; {begin}; print(os.environ.get('GOMP_SPINCOUNT'), flush=True)"
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    for given, spins in (({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, "None"), ({}, "30000")):
        # It takes some seconds to import PyTorch, which is asked what it makes of our own choice alone.
        code = script if given else f"{script}; import torch"
        told = {**kept, **given, "OMP_DISPLAY_ENV": "verbose"}
        done = subprocess.run([sys.executable, "-c", code], env=told, capture_output=True, text=True, check=True)
        assert done.stdout == f"{spins}\n"
    assert "GOMP_SPINCOUNT = '30000'" in done.stderr


@pytest.mark.parametrize(
    ("args", "continues"),
    [
        (["train", "aap", "--out", "RUN"], True),
        (["objects", "scenes", "OBJECTS", "SCENES"], True),
        (["store", "export", "STORE", "--out", "DATA"], True),
        (["objects", "check", "OBJECTS"], False),
        (["store", "verify", "STORE"], False),
    ],
)
def test_an_interrupt_is_one_line_that_says_whether_the_same_command_continues(
    args: list[str], continues: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> int:
        raise KeyboardInterrupt

    assert guarded(interrupt, args) == 130
    hint = f"; committed data stay, and the same command continues: adaafford {' '.join(args)}"
    assert capsys.readouterr().err == f"adaafford: interrupted{hint if continues else ''}\n"
    assert only_prints(args) is not continues


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_disturb_the_report_of_the_first(
    first: signal.Signals, second: signal.Signals
) -> None:
    done = with_signals(
        f"main._run = lambda args: signal.raise_signal({int(first)})",
        f"main.plain = lambda text: [text, signal.raise_signal({int(second)})][0]",
        "sys.argv[1:] = ['resume', 'RUN']",
    )
    assert done.returncode == 128 + first
    assert done.stderr == (
        "adaafford: interrupted; committed data stay, and the same command continues: adaafford resume RUN\n"
    )


def test_a_second_interrupt_after_the_report_ends_the_process_without_a_traceback() -> None:
    done = with_signals(
        "def interrupt(*_): signal.raise_signal(signal.SIGINT)",
        "main._run = main.Streams.settle = interrupt",
    )
    assert done.returncode == -signal.SIGINT
    assert "Traceback" not in done.stderr
