"""Child processes without Ray and SAPIEN, for training and for evaluation of a policy.

    Child(say).run("learner.stages.jobs:run_from_json", {"job": ..., "config": ...}, out)

calls that function with these arguments, which are JSON, in a process that lives until `close` or until a call fails.
It dies with this process, however that dies. Each call is one line of the child's standard input, a JSON list of the
function and its arguments; the answer is a line of `ENDED` and an exit code, after all that the function printed.
"""

import json
import os
import subprocess
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from learner.settings import OUTPUT_FILE
from shared.errors import UsageError, WorkerError
from shared.io.interpreter import PYTHON, own_environment
from shared.io.text import without_places

THREADS = 2
"""Of torch, in a child: the collectors rest while it works."""
PATIENCE_S = 10.0
"""How long a child may take to end when asked to."""
CHILD = "cluster.cli.child"
"""The module that a child runs."""
ENDED = "\x1e"
"""The ASCII record separator, which no other line begins with."""


class Child:
    """A process that runs one function after another; it starts with the first, and again after a failure.

    Args:
        say: receives each line that the process prints.
        root: the run's folder, which may be published or moved; default: the folder of each call.
    """

    def __init__(self, say: Callable[[str], None], root: Path | None = None) -> None:
        self._say = say
        self._root = root
        self._process: subprocess.Popen[str] | None = None

    def run(self, function: str, arguments: Mapping[str, Any], out: Path) -> None:
        """Call a function in the process, and wait for its end.

        Args:
            function: "module:name" of one that returns nothing.
            arguments: its arguments by name, as JSON.
            out: folder for output.txt, with everything that it printed and with paths relative to the root.

        Raises:
            UsageError: it refused its input; its own line is the message.
            WorkerError: it failed otherwise; the message names output.txt.
        """
        out.mkdir(parents=True, exist_ok=True)
        if self._process is None:
            self._process = _start()
        try:
            with (out / OUTPUT_FILE).open("w", encoding="utf-8") as log:
                # Where it is dead, the relay says so.
                with suppress(BrokenPipeError):
                    print(json.dumps([function, arguments]), file=self._process.stdin, flush=True)
                places = self._root or out
                last, code = _relay(self._process, lambda line: log.write(without_places(line, places)), self._say)
            if code == UsageError.exit_code:
                raise UsageError(last.removeprefix("adaafford: "))
            if code != 0:
                raise WorkerError(f"the process of {out} ended with code {code}; see {out / OUTPUT_FILE}")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the process: by SIGTERM, then by SIGKILL."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


def _start() -> "subprocess.Popen[str]":
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(THREADS))
    # A session of its own: Ctrl-C reaches this process alone, which then ends the child in an orderly way.
    return subprocess.Popen(
        [*PYTHON, "-m", CHILD, str(os.getpid())],
        env={**own_environment(), **threads, "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
        errors="replace",
    )


def _relay(
    process: "subprocess.Popen[str]", write: Callable[[str], object], say: Callable[[str], None]
) -> tuple[str, int]:
    """Pass its lines on; returns the last one and the exit code."""
    last = ""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(ENDED):
            return last, int(line.removeprefix(ENDED))
        write(line)
        last = line.rstrip() or last
        say(line.rstrip())
    return last, process.wait()
