"""The package in examples/plugin, installed for tests as pip would install it, without a network and build tools."""

import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from collector.sim.grippers import GRIPPERS
from shared.hidden import HIDDEN_PARAMETERS
from shared.policies.methods import BASELINES, METHODS, PROPOSERS
from shared.primitives import PRIMITIVES
from shared.store.codecs.columns import added_column
from shared.tasks import TASKS

PLUGIN = Path(__file__).parents[2] / "examples" / "plugin"
PACKAGE = "adaafford-example 1.0"
REGISTRIES = (PRIMITIVES, GRIPPERS, HIDDEN_PARAMETERS, TASKS, PROPOSERS, BASELINES, METHODS)


def install(folder: Path) -> None:
    """Put the package into a folder of Python's path."""
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    described = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    described.mkdir(parents=True)
    (described / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = [
        line
        for group, entries in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
    ]
    (described / "entry_points.txt").write_text("\n".join(lines) + "\n")
    shutil.copytree(PLUGIN / "adaafford_example", folder / "adaafford_example")


def install_here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the package in this process, until `monkeypatch` is undone."""
    install(folder)
    monkeypatch.syspath_prepend(folder)
    forget(monkeypatch)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """What this process has loaded of packages is looked for again."""
    for registry in REGISTRIES:
        monkeypatch.setattr(registry, "_loaded", {})
    for name in [name for name in sys.modules if name.startswith("adaafford_example")]:
        monkeypatch.delitem(sys.modules, name)
    added_column.cache_clear()
