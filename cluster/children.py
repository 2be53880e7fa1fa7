"""Child processes that share this one with neither Ray nor SAPIEN: learners, and what judges a policy.

They die with this process, however that dies (`cluster.lifeline`).
"""

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path

from shared.errors import UsageError, WorkerError
from shared.interpreter import PYTHON, own_environment
from shared.redaction import without_places

THREADS = 2
"""Of torch, in a child: the collectors rest while it works."""
PATIENCE_S = 10.0
"""How long a child may take to end when asked to."""
OUTPUT_FILE = "output.txt"
ENDED = "\x1e"
"""What the line begins with, before an exit code, in which a child says that one piece of work has ended: the ASCII
record separator, which no other line begins with."""


class Child:
    """`python -m MODULE ARGUMENTS`.

    Args:
        module: what to run.
        arguments: its arguments.
        told: whether it is given its work on standard input.
    """

    def __init__(self, module: str, arguments: Sequence[str] = (), *, told: bool = False) -> None:
        wrapper = [*PYTHON, "-m", "cluster.lifeline", str(os.getpid())]
        # A session of its own: Ctrl-C reaches this process alone, which then ends the child in an orderly way.
        self._process = subprocess.Popen(
            [*wrapper, *PYTHON, "-m", module, *arguments],
            env=_environment(),
            stdin=subprocess.PIPE if told else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            text=True,
            errors="replace",
        )

    def tell(self, line: str) -> None:
        """Give it a line of input; if it is dead, `wait` says so."""
        assert self._process.stdin is not None, "it is one that is told"
        with suppress(BrokenPipeError):
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()

    def wait(self, out: Path, what: str, say: Callable[[str], None], root: Path | None = None) -> None:
        """Wait until it ends, or until it has done what it was told.

        Args:
            out: folder that gets output.txt, everything that it printed, with paths relative to `root`.
            what: its command, for messages.
            say: is given each line as it comes.
            root: the run's folder, which may be published or moved; `out` where none is given.

        Raises:
            UsageError: it refused its input; its own line is the message.
            WorkerError: it failed otherwise; the message names output.txt.
        """
        out.mkdir(parents=True, exist_ok=True)
        with (out / OUTPUT_FILE).open("w", encoding="utf-8") as log:
            last, code = self._relay(lambda line: log.write(without_places(line, root or out)), say)
        if code == UsageError.exit_code:
            raise UsageError(last.removeprefix("adaafford: "))
        if code != 0:
            raise WorkerError(f"`{what}` ended with code {code}; see {out / OUTPUT_FILE}")

    def close(self) -> None:
        """End it if it still runs: politely, then not."""
        process = self._process
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

    def _relay(self, write: Callable[[str], object], say: Callable[[str], None]) -> tuple[str, int]:
        """Pass its lines on; returns the last one and the exit code."""
        last = ""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(ENDED):
                return last, int(line.removeprefix(ENDED))
            write(line)
            last = line.rstrip() or last
            say(line.rstrip())
        return last, self._process.wait()


def run_child(
    module: str, arguments: Sequence[str], out: Path, say: Callable[[str], None], root: Path | None = None
) -> None:
    """Run `python -m MODULE ARGUMENTS` and wait for its end; see `Child.wait`."""
    with closing(Child(module, arguments)) as child:
        child.wait(out, f"python -m {module} {' '.join(arguments)}", say, root)


class Learner:
    """A process that runs training stages one after another, so that it need not read and encode the same twice.

    It begins with the first stage, and ends with `close` or with a stage that fails; the next stage begins another.
    """

    def __init__(self) -> None:
        self._child: Child | None = None

    def train(self, arguments: Sequence[str], out: Path, say: Callable[[str], None], root: Path | None = None) -> None:
        """Run `adaafford train ARGUMENTS`; see `Child.wait`."""
        if self._child is None:
            self._child = Child("cluster.learning", told=True)
        try:
            self._child.tell(json.dumps(arguments))
            self._child.wait(out, f"adaafford train {' '.join(arguments)}", say, root)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the process."""
        if self._child is not None:
            self._child.close()
        self._child = None


def _environment() -> dict[str, str]:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(THREADS))
    return {**own_environment(), **threads, "PYTHONUNBUFFERED": "1"}
