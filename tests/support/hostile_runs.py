"""Tries hostile input in processes of its own."""

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

SEED = 20221023


LIMIT_S = 40.0
"""For one object, on a machine that does other things as well."""


REPOSITORY = Path(__file__).parents[2]


def assert_harmless(
    scratch: Path, subjects: Sequence[Path | str], numbers: range, module: str = "tests.support.hostile_batch"
) -> Counter[str]:
    """Try mutants in a child process, and go on after any that ends it; returns how many were refused or survived."""
    results, problems, start = Counter[str](), [], numbers.start
    while start < numbers.stop:
        under_way = f"{start} (at the start)"
        batch = Batch(scratch / f"from-{start}", module, subjects, start, numbers.stop)
        for line in batch.lines():
            word, number, rest = line.split(" ", 2)
            start = int(number) + 1
            if word == "begin":
                under_way = f"{number}: {rest}"
                continue
            result = rest.split(" ", 1)[1]
            results[result.partition(":")[0]] += 1
            if result.startswith("failed"):
                problems.append(f"{under_way}: {result}")
            under_way = ""
        if under_way:
            problems.append(f"{under_way}: {batch.how_it_ended()}")
            start = max(start, numbers.start + 1)
    assert not problems, "\n".join(problems)
    assert results.total() == len(numbers)
    return results


class Batch:
    """A child process that tries mutants, ended when it says nothing for too long."""

    def __init__(self, scratch: Path, module: str, subjects: Sequence[Path | str], start: int, stop: int) -> None:
        scratch.mkdir()
        arguments = [str(scratch), str(SEED), str(start), str(stop), *map(str, subjects)]
        self._child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=REPOSITORY,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )

    def lines(self) -> Iterator[str]:
        """What it prints."""
        assert self._child.stdout is not None
        with self._child.stdout as output:
            while True:
                watchdog = threading.Timer(LIMIT_S, self._child.kill)
                watchdog.start()
                line = output.readline()
                watchdog.cancel()
                if line.startswith(("begin ", "end ")):
                    yield line.strip()
                elif not line:
                    break
        self._child.wait()

    def how_it_ended(self) -> str:
        """The signal, or the exit code, that its process ended with."""
        code = self._child.returncode
        if code == -signal.SIGKILL:
            return f"took longer than {LIMIT_S:g} s"
        return f"ended its process by {signal.Signals(-code).name}" if code < 0 else f"ended its process with {code}"
