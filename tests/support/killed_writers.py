"""Writers that were killed, and what they leave."""

import signal
import subprocess
import sys
from pathlib import Path

from shared.io.files import TEMPORARY_PREFIX


def kill_while_writing(path: Path) -> Path:
    """Kill a process that writes `path` atomically before it has ended; returns the temporary file that it leaves."""
    before = set(path.parent.iterdir())
    code = "import os, signal, sys; from pathlib import Path; from shared.io.files import write_atomically\n"
    code += "os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)\n"
    code += "write_atomically(Path(sys.argv[1]), b'half')"
    assert subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode == -signal.SIGKILL
    (left,) = set(path.parent.iterdir()) - before
    assert left.name.startswith(TEMPORARY_PREFIX)
    return left
