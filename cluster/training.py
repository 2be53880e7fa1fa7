"""Training stages as child processes: the learner shares a process with neither Ray nor SAPIEN."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from shared.errors import UsageError, WorkerError

LEARNER_MODULE = "learner"
THREADS = 2
"""Of torch, in a learner: the collectors rest while it trains."""
PATIENCE_S = 10.0
"""How long a learner may take to end when asked to."""
OUTPUT_FILE = "output.txt"


def run_learner(arguments: Sequence[str], out: Path, say: Callable[[str], None]) -> None:
    """Run `python -m learner ARGUMENTS` and wait; it dies with this process, however that dies.

    Args:
        arguments: after `python -m learner`.
        out: folder that gets output.txt, everything the learner printed.
        say: is given each line as it comes.

    Raises:
        UsageError: the learner refused its input; its own line is the message.
        WorkerError: it failed otherwise; the message names output.txt.
    """
    out.mkdir(parents=True, exist_ok=True)
    wrapper = [sys.executable, "-m", "cluster.lifeline", str(os.getpid())]
    command = [*wrapper, sys.executable, "-m", LEARNER_MODULE, *arguments]
    # A session of its own: Ctrl-C reaches this process alone, which then ends the learner in an orderly way.
    with (out / OUTPUT_FILE).open("w", encoding="utf-8") as log:
        child = subprocess.Popen(
            command,
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            text=True,
            errors="replace",
        )
        try:
            last = _relay(child, log.write, say)
        finally:
            _end(child)
    if child.returncode == UsageError.exit_code:
        raise UsageError(last)
    if child.returncode != 0:
        raise WorkerError(
            f"`python -m learner {' '.join(arguments)}` ended with code {child.returncode}; see {out / OUTPUT_FILE}"
        )


def _relay(child: "subprocess.Popen[str]", write: Callable[[str], object], say: Callable[[str], None]) -> str:
    """Pass the child's lines on; returns the last one."""
    last = ""
    assert child.stdout is not None
    for line in child.stdout:
        write(line)
        last = line.rstrip() or last
        say(line.rstrip())
    child.wait()
    return last


def _end(child: "subprocess.Popen[str]") -> None:
    """End the child if it still runs: politely, then not."""
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    if child.stdout is not None:
        child.stdout.close()


def _environment() -> dict[str, str]:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(THREADS))
    return {**os.environ, **threads, "PYTHONUNBUFFERED": "1"}
