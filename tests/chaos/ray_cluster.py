"""A Ray cluster on this machine that outlives drivers: a head without CPUs, and two nodes that may go and come."""

import random
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from tests.chaos.killer import end
from tests.chaos.processes import Marked, Role

NODES = 2
START = ("from ray.scripts.scripts import main; main()", "start", "--disable-usage-stats")
START_LIMIT_S = 300.0
NODE = ("--min-worker-port=0", "--max-worker-port=0", "--include-log-monitor=false", "--object-store-memory=80000000")
"""Nobody reads what log monitors send to drivers."""


class RayCluster:
    """Starts with the first `mend`; has token authentication, as clusters should.

    Args:
        environment: variables that its processes have, and its drivers.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        # Not within a test's folder: the paths of Ray's sockets may have no more than 107 letters.
        self._folder = Path(tempfile.mkdtemp(prefix="ada", dir="/tmp"))
        self._port = free_port()
        self.address = f"127.0.0.1:{self._port}"
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0123456789abcdef" * 2}
        self.marked = Marked({**environment, **token}, outlives=True)

    def mend(self, role: Role | None = None) -> None:
        """Start what is missing, after something in this role was killed."""
        if not self.marked.in_role(Role.HEAD):
            head = ["--head", f"--port={self._port}", f"--ray-client-server-port={free_port()}", "--num-cpus=0"]
            head += [f"--temp-dir={self._folder}/ray", "--include-dashboard=false"]
            # What is left of a head, also of one that did not come up in time, holds the port.
            self._start(*head, before=self.close_all)
        for _ in range(NODES - len(self.marked.in_role(Role.RAYLET))):
            self._start(f"--address={self.address}", "--num-cpus=1")

    def close_all(self) -> None:
        """Kill everything."""
        while living := self.marked.living():
            for process in living:
                end(process)

    def close(self) -> None:
        """Kill everything, and leave nothing."""
        self.close_all()
        shutil.rmtree(self._folder)

    def _start(self, *arguments: str, before: Callable[[], None] = lambda: None) -> None:
        """Start a node; a busy machine may need several attempts, and `before` is called before each."""
        log = self._folder / "log.txt"
        deadline = time.monotonic() + START_LIMIT_S
        command = [sys.executable, "-c", *START, *arguments, *NODE]
        before()
        while self.marked.execute(command, log).wait(START_LIMIT_S) != 0:
            assert time.monotonic() < deadline, log.read_text()[-3000:]
            before()


def free_port() -> int:
    """A port that nobody listens on, below those that the system gives to programs that ask for any."""
    while True:
        with socket.socket() as free, suppress(OSError):
            port = random.randrange(20_000, 30_000)
            free.bind(("", port))
            return port
