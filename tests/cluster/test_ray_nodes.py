"""Ray nodes on machines of their own: one dies, one is cut off, one joins late; the data are the same."""

import json
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from shared.store import Store
from tests.support.machines import NET, Machine, Switch, network, why_not

REFUSAL = why_not()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(REFUSAL is not None, reason=str(REFUSAL)),
]

BIN = Path(sys.executable).parent
PORT = 6379
S3_PORT = 5000
ROLLOUTS, PER_SHARD = 160, 4
FLAGS = {
    "task": "push-faucet",
    "seed": 4,
    "rollouts": ROLLOUTS,
    "procedural-per-category": 2,
    "collection.camera.image-size": 128,
    "collection.camera.points": 64,
    "collection.camera.candidates": 1000,
    "collection.rollout.interactions": 16,
}
NOTICE = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 1000,
    "health_check_failure_threshold": 3,
}
"""A node that is silent for about 3 s is given up; by default it takes Ray half a minute."""
WATCH = """
import json, sys, time
from shared.errors import StoreError
from shared.store import Store
while True:
    try:
        store = Store.open(sys.argv[1])
        print(json.dumps([len(store.jobs()), list(store.crash_log.heartbeats())]), flush=True)
    except StoreError:
        pass  # Not made yet.
    time.sleep(1.0)
"""


def command(store: str, **flags: object) -> list[str]:
    """The command that collects into a store."""
    given = FLAGS | {name.replace("_", "-"): value for name, value in flags.items()}
    words = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    return [str(BIN / "adaafford"), "collect", "--store", store, *words]


@pytest.fixture
def scratch() -> Iterator[Path]:
    """A folder whose name is short, as sockets need it."""
    with tempfile.TemporaryDirectory(prefix="ada-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@pytest.fixture
def switch(scratch: Path) -> Iterator[Switch]:
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    quiet = {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1", "TMPDIR": str(scratch)}
    bucket = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}
    bucket["AWS_ENDPOINT_URL"] = f"http://{NET}.1:{S3_PORT}"
    with network({**kept, **token, **quiet, **bucket}) as switch:
        yield switch


def ray_node(machine: Machine, head: Machine, scratch: Path) -> None:
    """Start a Ray node of one CPU; it is not waited for."""
    if machine is head:
        role = ["--head", f"--port={PORT}", "--include-dashboard=false", f"--system-config={json.dumps(NOTICE)}"]
    else:
        role = [f"--address={head.address}:{PORT}"]
    # On one disk, nodes that start at the same time would take the same names for their sockets.
    rest = [
        "--num-cpus=1",
        f"--temp-dir={scratch / machine.address}",
        f"--object-store-memory={80 << 20}",
        "--include-log-monitor=false",
        "--disable-usage-stats",
        "--block",
    ]
    machine.start(
        str(BIN / "ray"), "start", f"--node-ip-address={machine.address}", *role, *rest, log=scratch / machine.name
    )


def wait_for(what: str, is_so: Callable[[], bool], limit_s: float = 120.0) -> None:
    begun = time.monotonic()
    while not is_so():
        assert time.monotonic() - begun < limit_s, f"{what} did not come within {limit_s:g} s"
        time.sleep(0.1)


def up(*machines: Machine, scratch: Path) -> bool:
    """Whether the Ray nodes of some machines are."""
    return all(b"Ray runtime started" in (scratch / machine.name).read_bytes() for machine in machines)


@dataclass(frozen=True, slots=True)
class Watcher:
    """Looks at a store from one of the machines, since nobody else may reach it."""

    log: Path

    def look(self) -> tuple[int, set[str]]:
        """How many shards are there, and which processes have left a heartbeat and are not forgotten."""
        lines = [line for line in self.log.read_text().splitlines(keepends=True) if line.endswith("]\n")]
        shards, workers = json.loads(lines[-1]) if lines else (0, [])
        return shards, set(workers)

    def workers(self) -> set[str]:
        return self.look()[1]


def bucket_on(machine: Machine, scratch: Path) -> str:
    """An S3 server on a machine; the URL of a store there."""
    machine.start(str(BIN / "moto_server"), "-H", machine.address, "-p", str(S3_PORT), log=scratch / "s3")
    put = "import sys, urllib.request as r; r.urlopen(r.Request(sys.argv[1], method='PUT'))"
    address = f"http://{machine.address}:{S3_PORT}/campaign"
    wait_for("the bucket", lambda: machine.start(sys.executable, "-c", put, address, log=scratch / "put").wait() == 0)
    return "s3://campaign/store"


@pytest.mark.parametrize("place", ["disk", "bucket"])
def test_a_machine_dies_one_is_cut_off_and_one_joins_late(place: str, switch: Switch, scratch: Path) -> None:
    head, first, second = (switch.machine() for _ in range(3))
    alone = str(scratch / "alone")
    undisturbed = switch.machine().start(*command(alone, workers=0, per_shard=8), log=scratch / "alone.log")
    ray_node(head, head, scratch)
    where = bucket_on(head, scratch) if place == "bucket" else str(scratch / "store")
    wait_for("the head", lambda: up(head, scratch=scratch))
    for machine in (first, second):
        ray_node(machine, head, scratch)
    wait_for("the other nodes", lambda: up(first, second, scratch=scratch))
    flags = {"workers": 3, "per_shard": PER_SHARD, "ray_address": f"{head.address}:{PORT}"}
    driver = head.start(*command(where, **flags), log=scratch / "driver")
    watcher = Watcher(scratch / "watcher")
    head.start(sys.executable, "-c", WATCH, where, log=watcher.log)

    wait_for("work on three machines", lambda: len(watcher.workers()) == 3)
    before = watcher.workers()
    third = switch.machine()
    ray_node(third, head, scratch)
    assert first.lose_power() > 0
    wait_for("work on a machine that joined late", lambda: len(watcher.workers() - before) > 0)
    switch.cut_off(second)
    at_cut, cut = watcher.look()[0], time.monotonic()
    assert PER_SHARD * at_cut < 0.9 * ROLLOUTS, "the cable was pulled in mid-round"
    assert driver.wait(timeout=180) == 0, (scratch / "driver").read_text()
    print(f"{at_cut} of {ROLLOUTS // PER_SHARD} shards were there at the cut, all {time.monotonic() - cut:.1f} s later")
    assert undisturbed.wait(timeout=180) == 0
    assert adaafford(head, scratch, "verify", where).startswith("no problems")
    assert adaafford(head, scratch, "digest", where) == Store.open(alone).digest()


def adaafford(machine: Machine, scratch: Path, *words: str) -> str:
    """What `adaafford store` prints on a machine."""
    log = scratch / words[0]
    assert machine.start(str(BIN / "adaafford"), "store", *words, log=log).wait() == 0, log.read_text()
    return log.read_text().splitlines()[-1]
