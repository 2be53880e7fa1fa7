"""Time from the start of a collection to its first committed shard, as a table in Markdown.

    python -m benchmarks.starting OBJECTS --repeats 5 [--workers 2] [--checkout FOLDER ...]

Processor time is that of the command and of all processes that it started, Ray's included, and hardly depends on other
work on the machine. Each turn collects pushes into a store in a temporary folder, and is stopped at its first shard.
With checkouts of this repository, their code is measured in turns with the code here, by this interpreter.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from statistics import median

import psutil

PROGRAM = "import sys, importlib.util as u; sys.argv[0] = 'adaafford'\n"
PROGRAM += "name = 'adaafford.console' if u.find_spec('adaafford.console') else 'cluster.cli'\n"
PROGRAM += "__import__(name, fromlist=['main']).main()"
"""The command, in checkouts that are older than its entry point, too."""
LOOK_S = 0.02
LIMIT_S = 900.0


def main() -> None:
    """Measure in turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--checkout", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    checkouts = [Path(__file__).resolve().parents[1], *(each.resolve() for each in arguments.checkout)]
    turns: dict[Path, list[tuple[float, float]]] = {each: [] for each in checkouts}
    print("| code | workers | wall s | CPU s | load |\n| --- | --- | --- | --- | --- |")
    for _ in range(arguments.repeats):
        for each, found in turns.items():
            found.append(started(each, arguments.objects.resolve(), arguments.workers))
            print(_row(each, arguments.workers, *found[-1]), flush=True)
    for each, found in turns.items():
        print(_row(each, arguments.workers, *map(median, zip(*found, strict=True))) + " median")


def started(checkout: Path, objects: Path, workers: int) -> tuple[float, float]:
    """Wall time and processor time of the code in a checkout until the first shard, s."""
    with tempfile.TemporaryDirectory(prefix="starting-") as folder:
        store = Path(folder, "store")
        flags = {"objects": objects, "task": "push", "seed": 11, "rollouts": 16, "workers": workers, "store": store}
        command = [sys.executable, "-c", PROGRAM, "collect", *(f"--{name}={value}" for name, value in flags.items())]
        paths = [str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])]
        begun = time.monotonic()
        with subprocess.Popen(
            command, cwd=folder, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, stderr=subprocess.DEVNULL
        ) as process:
            try:
                while not any(store.glob("shards/*/manifest.json")):
                    if process.poll() is not None or time.monotonic() - begun > LIMIT_S:
                        raise SystemExit(f"{checkout}: no shard came of: adaafford {' '.join(command[3:])}")
                    time.sleep(LOOK_S)
                return time.monotonic() - begun, _cpu_s(psutil.Process(process.pid))
            finally:
                process.terminate()


def _cpu_s(process: psutil.Process) -> float:
    """Processor time of a process and its descendants, s."""
    total = 0.0
    for each in (process, *process.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):
            used = each.cpu_times()
            total += used.user + used.system
    return total


def _row(checkout: Path, workers: int, wall_s: float, cpu_s: float) -> str:
    return f"| {checkout.name} | {workers} | {wall_s:.1f} | {cpu_s:.1f} | {os.getloadavg()[0]:.0f} |"


if __name__ == "__main__":
    main()
