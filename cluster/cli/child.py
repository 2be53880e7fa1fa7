"""A child process, as `cluster.runs.subprocesses` starts it: calls one function after another (Linux)."""

import ctypes
import json
import os
import signal
import sys
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from typing import Any

from cluster.cli.main import begin_process, guarded
from cluster.runs.subprocesses import ENDED

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Call each function that a line of the standard input names, until that ends; die with the parent."""
    # Here instead of in a `preexec_fn` of the parent, which may deadlock in a process with threads.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(sys.argv[1]):
        sys.exit("the parent was gone before the child began")
    begin_process()
    for line in sys.stdin:
        function, arguments = json.loads(line)
        module, _, name = function.partition(":")
        code = guarded(partial(_call, module, name, arguments), ["train"])
        print(f"{ENDED}{code}", flush=True)


def _call(module: str, name: str, arguments: Mapping[str, Any]) -> int:
    getattr(import_module(module), name)(**arguments)
    return 0


if __name__ == "__main__":
    main()
