"""The Ray cluster of this suite, with another program in Ray's place."""

import socket
from collections.abc import Iterator

import pytest

from tests.chaos import ray_cluster
from tests.chaos.ray_cluster import RayCluster

pytestmark = pytest.mark.chaos

HOLDER = """
import socket, sys, time
with socket.create_server(("", int(sys.argv[1]))):
    print("listening", flush=True)
    time.sleep(600)
"""
FAILS_AT_FIRST = f"""
import pathlib, socket, subprocess, sys
options = dict(option.partition("=")[::2] for option in sys.argv)
if "--head" in options:
    port, tried = options["--port"], pathlib.Path(options["--temp-dir"] + "-tried")
    if not tried.exists():
        tried.touch()
        left = subprocess.Popen([sys.executable, "-c", {HOLDER!r}, port], stdout=subprocess.PIPE)
        left.stdout.readline()
        sys.exit("not up within the time")
    socket.create_server(("", int(port))).close()
"""


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[RayCluster]:
    monkeypatch.setattr(ray_cluster, "START", (FAILS_AT_FIRST,))
    monkeypatch.setattr(ray_cluster, "START_LIMIT_S", 20.0)
    cluster = RayCluster({})
    yield cluster
    cluster.close()


def test_what_a_head_that_did_not_come_up_has_left_does_not_hold_the_port_of_the_next(cluster: RayCluster) -> None:
    cluster.mend()


def test_ports_are_not_those_that_are_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("", 0)) as used:
        drawn = iter([used.getsockname()[1], 20_001])
        monkeypatch.setattr("random.randrange", lambda *bounds: next(drawn))
        assert ray_cluster.free_port() == 20_001
