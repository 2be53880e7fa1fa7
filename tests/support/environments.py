"""Environments of other programs, made beside ours; a test is skipped where no package index answers."""

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest


def environment(folder: Path) -> Path:
    """The Python of a new environment that also finds the packages of ours, which need not be installed again."""
    venv.create(folder, with_pip=True)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    paths = [path for path in sys.path if path.endswith("site-packages")] or [sysconfig.get_path("purelib")]
    (folder / f"lib/{version}/site-packages/zz_ours.pth").write_text("\n".join(paths) + "\n")
    return folder / "bin/python"


def install(python: Path, *args: str) -> None:
    """Install packages, or skip the test where there is no index of them."""
    done = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--no-compile", *args], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"packages cannot be installed here: {done.stderr.strip().splitlines()[-1]}")
