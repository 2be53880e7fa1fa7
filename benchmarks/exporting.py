"""Time, memory and size of each export format on a made-up store, as a table in Markdown.

    python -m benchmarks.exporting /tmp/exporting --interactions 100000

A shard has 25 rollouts of 16 interactions, and each rollout a cloud of 2,048 points. All coordinates are random, so
that they compress worse than those of objects. Each format is written by a process of its own. The store stays in the
folder; the exports are removed.
"""

import argparse
import shutil
import sys
from pathlib import Path

from benchmarks.many_shards import measured
from shared.store import Store, export
from shared.store.maintenance.export import splits_by_share
from shared.store.maintenance.formats import EXPORT_FORMATS
from tests.support.fabricate import fabricate_store

ROLLOUTS, INTERACTIONS, POINTS = 25, 16, 2048


def main() -> None:
    """Make the store if it is not there yet, and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--interactions", type=int, default=100_000)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds of each format")
    parser.add_argument("--formats", nargs="+", choices=EXPORT_FORMATS.names(), default=EXPORT_FORMATS.names())
    arguments = parser.parse_args()
    shards = -(-arguments.interactions // (ROLLOUTS * INTERACTIONS))
    store, out = arguments.folder / str(shards), arguments.folder / "out"
    if not store.exists():
        fabricate_store(store, shards, ROLLOUTS, POINTS, INTERACTIONS)
    print("| format | interactions | MB | files | peak MB | CPU s | wall s | |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in arguments.formats:
        cells = measured(["benchmarks.exporting", "--one", name, str(store), str(out)], arguments.limit)
        files = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
        steps = shards * ROLLOUTS * INTERACTIONS
        print(f"| {name} | {steps} | {sum(files) / 1e6:.0f} | {len(files)} | {cells} |", flush=True)
        for left in arguments.folder.glob("out*"):
            shutil.rmtree(left)


def _one(name: str, where: str, out: str) -> None:
    store = Store.open(where)
    export(store, out, splits_by_share(store, 0.0, 1), lambda done, _: print(done, flush=True), format=name)


if __name__ == "__main__":
    _one(*sys.argv[2:]) if sys.argv[1] == "--one" else main()
