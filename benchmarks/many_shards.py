"""Memory and time of each command on made-up stores of many shards, as a table in Markdown.

    python -m benchmarks.many_shards /tmp/many 1000 10000 --limit 600

A shard has two rollouts of one interaction and clouds of 64 points, so that next to nothing but the cost of a shard
shows. Each command runs in a process of its own; one that takes longer than the limit is ended, and the table says how
far it came. The stores, 60 KB and 24 files and folders a shard, stay in the folder; what the commands write is removed.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from cluster.collection.status_writer import read_status
from learner.data.dataset import load_dataset
from shared.networks.network_config import NetworkConfig
from shared.plan import missing_ranges
from shared.store import Store, compact, export, info, merge, repair, verify
from shared.store.maintenance.export import splits_by_share
from tests.support.fabricate import fabricate_store

Progress = Callable[[int, int], None]


def _resume(store: Store) -> None:
    """What `collect` does before its first job."""
    store.sweep()
    missing_ranges(10**9, [(job.start, job.stop) for job in store.jobs()])


# Compaction comes last: it changes the store.
COMMANDS: dict[str, Callable[[Store, Path, Progress], object]] = {
    "status": lambda store, out, progress: read_status(store.backend),
    "collect (start)": lambda store, out, progress: _resume(store),
    "digest": lambda store, out, progress: store.digest(),
    "info": lambda store, out, progress: info(store),
    "train prior (loading)": lambda store, out, progress: load_dataset(store, NetworkConfig()),
    "verify": lambda store, out, progress: verify(store, progress),
    "repair": lambda store, out, progress: repair(store.where, progress),
    "export": lambda store, out, progress: export(store, out, splits_by_share(store, 0.0, 1), progress),
    "merge": lambda store, out, progress: merge([store], out, progress),
    "compact": lambda store, out, progress: compact(store, 256, progress),
}


def main() -> None:
    """Make the stores that are not there yet, and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("shards", type=int, nargs="+")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds of each command")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    arguments = parser.parse_args()
    print("| command | shards | peak MB | CPU s | wall s | |\n| --- | --- | --- | --- | --- | --- |")
    for shards in arguments.shards:
        store, out = arguments.folder / str(shards), arguments.folder / "out"
        if not store.exists():
            fabricate_store(store, shards)
        for command in arguments.commands:
            one = ["benchmarks.many_shards", "--one", command, str(store), str(out)]
            print(f"| {command} | {shards} | {measured(one, arguments.limit)} |", flush=True)
            shutil.rmtree(out, ignore_errors=True)


def measured(arguments: Sequence[str], limit_s: float) -> str:
    """The table's cells of one command: peak of memory, processor time, wall time, and how far it came.

    Args:
        arguments: a module and its arguments; it prints how many shards are done, now and then.
        limit_s: after which it is ended.
    """
    begun = time.monotonic()
    with subprocess.Popen([sys.executable, "-m", *arguments], stdout=subprocess.PIPE, text=True) as child:
        signal.signal(signal.SIGALRM, lambda *_: child.terminate())
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        _, status, used = os.wait4(child.pid, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        said = child.stdout.read().split() if child.stdout else []
    end = {0: "", -signal.SIGTERM: "stopped"}.get(child.returncode, "failed")
    far = f"{end} after {said[-1]} shards" if end and said else end
    cpu_s = used.ru_utime + used.ru_stime
    return f"{used.ru_maxrss / 1024:.0f} | {cpu_s:.0f} | {time.monotonic() - begun:.0f} | {far}"


def _one(command: str, store: str, out: str) -> None:
    COMMANDS[command](Store.open(store), Path(out), lambda done, _: None if done % 100 else print(done, flush=True))


if __name__ == "__main__":
    _one(*sys.argv[2:]) if sys.argv[1] == "--one" else main()
