"""What users install: wheels alone, a core without simulator and cluster, and one line where an extra is missing."""

import json
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import shared.extras as extras_module
from cluster.cli.main import COMMANDS, NEEDS, run
from cluster.workers.ray_process import SLOW
from shared.extras import EXTRAS, extra_of
from tests.support.as_toml import as_toml
from tests.support.small_trainings import FAST, make_store

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
GLIBC = ("2_28", "2_27", "2_24", "2_17")


def test_extras_are_those_of_the_package() -> None:
    for extra, packages in EXTRAS.items():
        brought = {Requirement(line).name for line in PROJECT["optional-dependencies"][extra]} - {"adaafford"}
        assert brought == set(packages)
    assert {extra for needs in NEEDS.values() for extra in needs} <= EXTRAS.keys()
    assert NEEDS.keys() <= COMMANDS.keys()


def test_every_supported_python_is_named() -> None:
    named = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line}
    assert named == set(PYTHONS)
    assert PROJECT["requires-python"] == ">=3.11,<3.15"


def test_no_extra_brings_what_makes_the_import_of_ray_slow() -> None:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    locked = {canonicalize_name(line.partition("==")[0]) for line in lines if line[:1].isalnum()}
    assert "ray" in locked
    assert not locked & set(map(canonicalize_name, SLOW))


@pytest.mark.parametrize(
    ("command", "missing"), [("collect", "sapien"), ("compare", "plotly"), ("run", "jinja2"), ("view", "viser")]
)
def test_a_command_whose_extra_is_missing_says_how_to_get_it(
    command: str, missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = extras_module.find_spec
    monkeypatch.setattr(extras_module, "find_spec", lambda name: None if name == missing else found(name))
    assert run([command]) == 2
    line = f"adaafford {command} needs {missing}, not installed here: pip install 'adaafford[{extra_of(missing)}]'"
    assert capsys.readouterr() == ("", f"adaafford: {line}\n")


def robot_packages(python: str) -> list[str]:
    """Names of what `pip install 'adaafford[ros]'` brings, all the way down."""
    waiting, seen, where = ["adaafford"], set[str](), {"extra": "", "python_version": python}
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name in seen or name.startswith(("nvidia-", "cuda-")) or name == "triton":
            continue
        seen.add(name)
        try:
            ours = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["ros"]]
            needs = ours if name == "adaafford" else requires(name)
        except PackageNotFoundError:
            continue  # Of another platform or Python.
        requirements = [Requirement(line) for line in needs or ()]
        waiting.extend(need.name for need in requirements if not need.marker or need.marker.evaluate(where))
    return sorted(seen - {"adaafford"})


def pinned(python: str) -> dict[str, str]:
    """The versions of the constraints by name."""
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pins = [pin for pin in map(Requirement, lines) if not pin.marker or pin.marker.evaluate({"python_version": python})]
    return {canonicalize_name(pin.name): f"{pin.name}{pin.specifier}" for pin in pins}


def without_wheels(requirements: list[str], python: str, machine: str, folder: Path) -> str:
    """What pip says when it looks for a wheel of each requirement; "" where all are there."""
    wanted = folder / "wanted.txt"
    wanted.write_text("\n".join(requirements))
    platforms = [f"--platform=manylinux_{version}_{machine}" for version in GLIBC] + [
        f"--platform=manylinux2014_{machine}"
    ]
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"),
            *("--only-binary=:all:", "--implementation=cp", f"--python-version={python}", *platforms),
            *("--target", str(folder / "nothing"), "--requirement", str(wanted)),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    return "" if done.returncode == 0 else done.stderr


def skip_without_index(said: str) -> None:
    """Skip where no package index answers."""
    if "NewConnectionError" in said or "ConnectTimeout" in said or "Temporary failure in name resolution" in said:
        pytest.skip("no package index can be reached")


@pytest.mark.slow
@pytest.mark.parametrize("python", PYTHONS)
def test_every_pinned_dependency_has_a_wheel(python: str, tmp_path: Path) -> None:
    said = without_wheels(list(pinned(python).values()), python, "x86_64", tmp_path)
    skip_without_index(said)
    assert said == ""


@pytest.mark.slow
@pytest.mark.parametrize("python", (PYTHONS[0], PYTHONS[-1]))
def test_what_a_robot_needs_has_wheels_for_aarch64(python: str, tmp_path: Path) -> None:
    needed, pins = robot_packages(python), pinned(python)
    assert {"torch", "numba", "zarr", "rosbags"} <= set(needed)
    assert not {"ray", "sapien", "plotly"} & set(needed)
    said = without_wheels([pins.get(name, name) for name in needed], python, "aarch64", tmp_path)
    skip_without_index(said)
    assert said == ""


@pytest.mark.slow
def test_the_core_adapts_and_trains_in_an_empty_environment(tmp_path: Path) -> None:
    def call(*command: str | Path) -> str:
        done = subprocess.run(
            [str(part) for part in command], capture_output=True, text=True, check=False, cwd=tmp_path
        )
        skip_without_index(done.stderr)
        assert done.returncode == 0, done.stderr
        return done.stdout

    # From a copy: setuptools leaves a folder behind, from which a later build would take files that are gone here.
    source = tmp_path / "source"
    for package in ("adaafford", "shared", "collector", "learner", "cluster"):
        shutil.copytree(ROOT / package, source / package)
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, source)
    (wheel,) = tmp_path.glob("adaafford-*.whl")
    call(sys.executable, "-m", "venv", "new")
    python, adaafford = tmp_path / "new" / "bin" / "python", tmp_path / "new" / "bin" / "adaafford"
    call(python, "-m", "pip", "install", "--quiet", "--no-compile", "--constraint", ROOT / "constraints.txt", wheel)
    for package in ("ray", "sapien", "matplotlib", "plotly"):
        done = subprocess.run([python, "-c", f"import {package}"], capture_output=True, text=True, check=False)
        assert f"No module named '{package}'" in done.stderr

    scan = np.random.default_rng(0).uniform([0.9, -0.3, -0.4], [0.92, 0.3, 0.4], (3000, 3))
    np.savez(tmp_path / "scan.npz", points=scan)
    step = json.loads(
        call(adaafford, "adapt", "--policy", "pull-closed-door", "--cloud", "scan.npz", "--history", "history.json")
    )
    assert step["do"] == "try"
    assert (tmp_path / "heatmap.ply").is_file()

    make_store(tmp_path / "store")
    (tmp_path / "fast.toml").write_text(as_toml(FAST.model_dump(mode="json")))
    call(adaafford, "train", "prior", "--store", "store", "--out", "prior", "--config", "fast.toml")
    call(adaafford, "store", "verify", "store")
    call(adaafford, "store", "export", "store", "--out", "exported")
    assert (tmp_path / "prior" / "weights.safetensors").is_file()

    refused = subprocess.run([adaafford, "collect"], capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert refused.stderr.endswith("not installed here: pip install 'adaafford[collect]'\n")
    assert refused.stderr.count("\n") == 1
