"""A folder of the user's that has the name of one of our packages: one line that says which."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from adaafford.packages import PACKAGES, ROOT
from shared.io.interpreter import PYTHON, own_environment

COMMAND = "import sys; sys.argv[0] = 'adaafford'; from adaafford.console import main; main()"
FACE = "import adaafford"


def started(arguments: list[str], folder: Path, path: str) -> "subprocess.CompletedProcess[str]":
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    environment["PYTHONPATH"] = path
    return subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("kind", ["package", "module"])
@pytest.mark.parametrize("name", [name for name in PACKAGES if name != "adaafford"])
def test_a_folder_in_the_way_is_named_in_one_line(tmp_path: Path, name: str, kind: str) -> None:
    intruder = tmp_path / (name if kind == "package" else f"{name}.py")
    if kind == "package":
        intruder.mkdir()
        (intruder / "__init__.py").write_text("")
    else:
        intruder.write_text("")
    for code in (COMMAND, FACE):
        done = started(["-c", code, "version"], tmp_path, f"{tmp_path}{os.pathsep}{ROOT}")
        assert done.returncode == 1
        assert done.stdout == ""
        assert done.stderr.startswith(
            f"adaafford: {intruder.resolve()}: has the name of adaafford's own package '{name}'"
        )
        assert done.stderr.count("\n") == 1


def test_the_command_line_as_a_module_sees_it_too(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "__init__.py").write_text("")
    done = started(["-m", "cluster", "version"], tmp_path, str(ROOT))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert f"{tmp_path.resolve() / 'shared'}: has the name" in done.stderr


def test_an_empty_folder_of_such_a_name_is_in_nobodys_way(tmp_path: Path) -> None:
    for name in PACKAGES:
        (tmp_path / name).mkdir()
    done = started(["-c", COMMAND, "version"], tmp_path, f"{tmp_path}{os.pathsep}{ROOT}")
    assert (done.returncode, done.stderr) == (0, "")


def test_processes_of_ours_do_not_look_into_the_working_folder(tmp_path: Path) -> None:
    for name in PACKAGES:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('an intruder')")
    code = "import adaafford, cluster.runs.subprocesses, collector, learner, shared; print(shared.__file__)"
    done = subprocess.run(
        [*PYTHON, "-c", code], cwd=tmp_path, env=own_environment(), capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(ROOT / "shared" / "__init__.py")


def test_the_face_has_what_it_names_and_nothing_else() -> None:
    import adaafford

    for name in adaafford.__all__:
        assert getattr(adaafford, name) is not None
    assert adaafford.open_store == adaafford.Store.open
    assert {*adaafford.__all__} <= {*dir(adaafford)}
    with pytest.raises(AttributeError, match="no attribute 'Adaptor'"):
        _ = adaafford.Adaptor


def test_the_face_alone_imports_nothing_heavy() -> None:
    code = "import sys, adaafford; print(sorted({'torch', 'numpy', 'zarr', 'shared'} & sys.modules.keys()))"
    done = subprocess.run([*PYTHON, "-c", code], env=own_environment(), capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
