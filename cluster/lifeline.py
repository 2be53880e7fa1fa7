"""Runs a command that cannot outlive its parent: `python -m cluster.lifeline PARENT COMMAND...` (Linux).

A wrapper instead of `preexec_fn`, which may deadlock in a process with threads; the setting survives `exec`.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Ask the kernel to kill this process with its parent, then become the command."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit("the parent was gone before the child began")
    os.execv(command[0], command)  # noqa: S606 - the command is the parent's own fixed list.


if __name__ == "__main__":
    main()
