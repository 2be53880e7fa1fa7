"""Ray nodes on machines of their own: one dies, one is cut off, one joins late; the data are the same."""

import json
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared.store import Store, verify
from tests.machines import Machine, Switch, network, why_not

REFUSAL = why_not()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(REFUSAL is not None, reason=str(REFUSAL)),
]

BIN = Path(sys.executable).parent
PORT = 6379
ROLLOUTS = 160
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
    with network({**kept, **token, **quiet}) as switch:
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


def at_work(where: str) -> set[str]:
    """Processes that have left a breadcrumb and are not forgotten."""
    return set(Store.open(where).underway.crumbs())


def test_a_machine_dies_one_is_cut_off_and_one_joins_late(switch: Switch, scratch: Path) -> None:
    head, first, second = (switch.machine() for _ in range(3))
    where, alone = str(scratch / "store"), str(scratch / "alone")
    undisturbed = switch.machine().start(*command(alone, workers=0, per_shard=8), log=scratch / "alone.log")
    ray_node(head, head, scratch)
    wait_for("the head", lambda: up(head, scratch=scratch))
    for machine in (first, second):
        ray_node(machine, head, scratch)
    wait_for("the other nodes", lambda: up(first, second, scratch=scratch))
    flags = {"workers": 3, "per_shard": 1, "ray_address": f"{head.address}:{PORT}"}
    driver = head.start(*command(where, **flags), log=scratch / "driver")

    wait_for("the store", lambda: (Path(where) / "store.json").exists())
    wait_for("work on three machines", lambda: len(at_work(where)) == 3)
    before = at_work(where)
    third = switch.machine()
    ray_node(third, head, scratch)
    assert first.lose_power() > 0
    wait_for("work on a machine that joined late", lambda: len(at_work(where) - before) > 0)
    switch.cut_off(second)
    at_cut, cut = len(Store.open(where).jobs()), time.monotonic()
    assert at_cut < ROLLOUTS - 10, "the cable was pulled in mid-round"
    assert driver.wait(timeout=180) == 0, (scratch / "driver").read_text()
    print(f"{at_cut} of {ROLLOUTS} rollouts were there at the cut, all of them {time.monotonic() - cut:.1f} s later")
    assert undisturbed.wait(timeout=180) == 0
    assert verify(Store.open(where)) == []
    assert Store.open(where).digest() == Store.open(alone).digest()
