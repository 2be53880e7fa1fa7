"""Machines: network namespaces of this one, joined by a switch of their own; this machine's network is not touched.

    with network() as switch:
        head = switch.machine()
        node = head.start("ray", "start", ...)
        switch.cut_off(head)

Each has its own loopback and one address that the others reach. They share disk, memory and process numbers, so that
Ray's nodes and a store in a folder can be put on them as on machines with a shared file system.
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

NET = "10.77.77"
"""Addresses of the machines; they exist in the namespaces alone."""


def why_not() -> str | None:
    """Why no machines can be made here; None if they can."""
    if shutil.which("ip") is None:
        return "network namespaces need the command `ip` (package iproute2)"
    if os.geteuid() != 0:
        return "network namespaces need root"
    probe = f"adaprobe{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", probe], capture_output=True).returncode:
        return "this system lets nobody make network namespaces"
    subprocess.run(["ip", "netns", "del", probe], check=True)
    return None


@dataclass(frozen=True, slots=True)
class Machine:
    """A namespace with one address."""

    name: str
    address: str
    port: str
    """The other end of its cable, on the switch."""
    environment: Mapping[str, str]
    started: "list[subprocess.Popen[bytes]]" = field(default_factory=list)

    def start(self, *command: str, log: Path) -> "subprocess.Popen[bytes]":
        """Start a process there, in the folder of the file that gets what it prints."""
        with log.open("ab") as file:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.name, *command],
                env={**self.environment},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                cwd=log.parent,
            )
        self.started.append(process)
        return process

    def pids(self) -> list[int]:
        """Every process there."""
        found = subprocess.run(["ip", "netns", "pids", self.name], capture_output=True, text=True, check=False)
        return [int(word) for word in found.stdout.split()]

    def lose_power(self) -> int:
        """Kill every process at once; returns how many there were."""
        killed: set[int] = set()
        for _ in range(50):
            pids = self.pids()
            for pid in pids:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    continue
                killed.add(pid)
            if not pids:
                break
            time.sleep(0.05)
        for process in self.started:
            process.wait()
        return len(killed)


@dataclass(slots=True)
class Switch:
    """What the machines are plugged into."""

    name: str
    environment: Mapping[str, str]
    machines: list[Machine] = field(default_factory=list)

    def machine(self) -> Machine:
        """Plug in another machine."""
        number = len(self.machines) + 1
        machine = Machine(f"{self.name}m{number}", f"{NET}.{number}", f"port{number}", self.environment)
        ip("netns", "add", machine.name)
        self.machines.append(machine)
        ip("-n", self.name, "link", "add", machine.port, "type", "veth", "peer", "name", "eth0", "netns", machine.name)
        ip("-n", self.name, "link", "set", machine.port, "master", "bridge", "up")
        ip("-n", machine.name, "address", "add", f"{machine.address}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            ip("-n", machine.name, "link", "set", device, "up")
        return machine

    def cut_off(self, machine: Machine) -> None:
        """Pull its cable: nobody is told, packets are just gone."""
        ip("-n", self.name, "link", "set", machine.port, "down")


@contextmanager
def network(environment: Mapping[str, str]) -> Iterator[Switch]:
    """A switch without machines; in the end all that runs on its machines is killed, and they are removed.

    Args:
        environment: of every process on them, and nothing else.
    """
    switch = Switch(f"ada{os.getpid()}", environment)
    ip("netns", "add", switch.name)
    try:
        ip("-n", switch.name, "link", "add", "bridge", "type", "bridge")
        ip("-n", switch.name, "link", "set", "bridge", "up")
        yield switch
    finally:
        for machine in switch.machines:
            machine.lose_power()
        for name in [machine.name for machine in switch.machines] + [switch.name]:
            ip("netns", "del", name)


def ip(*words: str) -> None:
    """Run `ip`."""
    subprocess.run(["ip", *words], check=True, capture_output=True)
