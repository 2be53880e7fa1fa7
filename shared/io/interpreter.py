"""Starting modules of ours in processes of their own: `[*PYTHON, "-m", "cluster.cli.child"]`, `own_environment()`.

Python would look for them in the working folder first, where a user may have a folder called `shared` or `learner`.
"""

import os
import site
import sys
import sysconfig
from pathlib import Path

PYTHON = (sys.executable, "-P")
"""This interpreter, which looks for modules nowhere but where they are installed, and in PYTHONPATH."""
ROOT = Path(__file__).resolve().parents[2]
"""The folder that our packages are in."""


def own_environment() -> dict[str, str]:
    """The environment of a process that is to find the packages that this one has found."""
    installed = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), site.getusersitepackages()}
    if str(ROOT) in {os.path.realpath(path) for path in installed}:
        return dict(os.environ)
    # A checkout, which this process may have found by its working folder alone.
    others = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *others])}
