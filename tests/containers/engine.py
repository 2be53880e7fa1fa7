"""An engine of containers for tests: podman with its own storage, networks and images, without any registry.

    with engine(folder) as podman:
        podman.make_base("python:3.11-slim-bookworm")
        podman.build("adaafford", context)
        services = Services(podman, compose_file, environment)
        services.up("head")

The base image is a bare Debian made by debootstrap. Networks are in a namespace, so that this machine's own network and
ports are not touched. `Services` runs the health checks, since podman leaves them to systemd, which may be absent.
All of it is removed at the end.
"""

import ast
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import yaml

PACKAGES = {
    "podman": "podman",
    "runc": "runc",
    "catatonit": "catatonit",
    "debootstrap": "debootstrap",
    "iptables": "iptables",
    "ip": "iproute2",
    "/usr/lib/podman/netavark": "netavark",
    "/usr/lib/podman/aardvark-dns": "aardvark-dns",
}
"""What must be installed, and the Debian packages that have it."""
MEMORY_BYTES = 8 << 30
DISK_BYTES = 15 << 30
MOST_PROCESSES = 16384
"""Of each user, and most open files of each process."""
PATIENCE_S = 1200
SUITE = "bookworm"


def why_not(folder: Path) -> str | None:
    """Why no containers can be run here; None if they can."""
    if os.geteuid() != 0:
        return "containers need root here"
    if missing := sorted(package for program, package in PACKAGES.items() if shutil.which(program) is None):
        return f"containers need the Debian packages {', '.join(missing)}"
    if (free := psutil.virtual_memory().available) < MEMORY_BYTES:
        return f"containers need {MEMORY_BYTES >> 30} GiB of memory, {free >> 30} GiB are available"
    if (free := shutil.disk_usage(folder).free) < DISK_BYTES:
        return f"containers need {DISK_BYTES >> 30} GiB of disk in {folder}, {free >> 30} GiB are free"
    if _mirror() is None:
        return "no source of Debian's packages is configured"
    return None


@dataclass(frozen=True, slots=True)
class Engine:
    """Podman with a folder and a network namespace of its own.

    Attributes:
        folder: holds everything.
        netns: name of the network namespace.
        environment: of podman's processes.
        mounts: folders that pip reads packages from on this machine; builds see them, containers do not.
    """

    folder: Path
    netns: str
    environment: Mapping[str, str]
    mounts: list[str] = field(default_factory=list)

    def podman(self, *arguments: str, stdin: bytes | None = None) -> str:
        """Run podman among its networks; returns what it prints."""
        return self.run("nsenter", f"--net=/run/netns/{self.netns}", "podman", *arguments, stdin=stdin)

    def run(self, *command: str, stdin: bytes | None = None, more: Mapping[str, str] | None = None) -> str:
        """Run a command with the engine's environment; returns what it prints."""
        done = subprocess.run(
            command, env={**self.environment, **(more or {})}, input=stdin, capture_output=True, timeout=PATIENCE_S
        )
        assert done.returncode == 0, f"{command}: {done.stdout.decode()[-4000:]} {done.stderr.decode()[-4000:]}"
        return done.stdout.decode()

    def make_base(self, name: str) -> None:
        """Make an image of a bare Debian with Python, set up to install packages as this machine is."""
        system, archive = self.folder / "base", self.folder / "base.tar"
        include = "--include=ca-certificates,python3,python3-venv"
        self.run("debootstrap", "--variant=minbase", include, SUITE, str(system), _mirror() or "")
        (system / "usr/bin/python").symlink_to("python3")
        settings = _pip_settings()
        (system / "etc/pip.conf").write_text(
            "[global]\n" + "".join(f"{name} = {value}\n" for name, value in settings.items())
        )
        for path in {Path(word.removeprefix("file://")) for value in settings.values() for word in value.split()}:
            if path.is_absolute() and path.is_file():
                target = system / path.relative_to("/")
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)
            elif path.is_absolute() and path.is_dir():
                # The pages of an index lead to files beside them.
                root = path.parent if path.name == "simple" else path
                self.mounts.append(f"--volume={root}:{root}:ro")
        self.run("tar", "--directory", str(system), "--create", "--file", str(archive), ".")
        self.podman("import", str(archive), f"docker.io/library/{name}")
        shutil.rmtree(system)
        archive.unlink()

    def build(self, name: str, context: Path) -> None:
        """Build the Dockerfile of a folder; it reaches what this machine reaches."""
        self.run("podman", "build", "--layers=false", "--tag", name, *self.mounts, str(context))

    def state(self, container: str) -> dict[str, Any]:
        """A container's state as podman tells it."""
        (found,) = json.loads(self.podman("inspect", container))
        state: dict[str, Any] = found["State"] | {"restarts": found["RestartCount"]}
        return state


@dataclass(frozen=True, slots=True)
class Services:
    """The services of a compose file, brought up by podman-compose; what a service depends on comes first.

    Attributes:
        engine: runs them.
        file: the compose file.
        variables: those that it names.
    """

    engine: Engine
    file: Path
    variables: Mapping[str, str]
    _up: set[str] = field(default_factory=set)

    @property
    def declared(self) -> dict[str, Any]:
        """Each service as the file has it; variables are not replaced."""
        services: dict[str, Any] = yaml.safe_load(self.file.read_text())["services"]
        return services

    def up(self, service: str, copies: int = 1) -> None:
        """Start a service as soon as what it depends on has come to the condition that the file names."""
        for needed, how in self.declared[service].get("depends_on", {}).items():
            if needed not in self._up:
                self.up(needed)
            wait_for(f"{needed} of {service}", lambda needed=needed, how=how: self._is(needed, how["condition"]))
        self._compose("up", "--detach", "--no-deps", "--scale", f"{service}={copies}", service)
        self._up.add(service)

    def container(self, service: str, number: int = 1) -> str:
        """Name of a service's container."""
        return f"{yaml.safe_load(self.file.read_text())['name']}_{service}_{number}"

    def execute(self, service: str, *command: str) -> str:
        """Run a command in a service's container; returns what it prints."""
        return self.engine.podman("exec", self.container(service), *command)

    def state(self, service: str) -> dict[str, Any]:
        """Of a service's container."""
        return self.engine.state(self.container(service))

    def logs(self, service: str) -> str:
        """What a service printed."""
        command = ["podman", "logs", self.container(service)]
        done = subprocess.run(
            command, env=dict(self.engine.environment), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True
        )
        return done.stdout.decode(errors="replace")

    def has_ended(self, service: str) -> bool:
        """Whether a service ended well; asserts that it did not end otherwise."""
        state = self.state(service)
        if state["Status"] != "exited":
            return False
        assert state["ExitCode"] == 0, self.logs(service)[-4000:]
        return True

    def _is(self, service: str, condition: str) -> bool:
        if condition == "service_completed_successfully":
            return self.has_ended(service)
        assert condition == "service_healthy"
        check = ["nsenter", f"--net=/run/netns/{self.engine.netns}", "podman", "healthcheck", "run"]
        environment = dict(self.engine.environment)
        return not subprocess.run(
            [*check, self.container(service)], env=environment, capture_output=True, timeout=PATIENCE_S
        ).returncode

    def _compose(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "podman_compose", "--in-pod", "false", "--file", str(self.file)]
        self.engine.run(
            "nsenter", f"--net=/run/netns/{self.engine.netns}", *command, *arguments, more=dict(self.variables)
        )


@contextmanager
def engine(folder: Path) -> Iterator[Engine]:
    """An engine that leaves nothing behind."""
    netns = f"adaafford-{os.getpid()}"
    made = Engine(folder, netns, {**os.environ, **_configured(folder)})
    made.run("ip", "netns", "add", netns)
    try:
        made.run("ip", "-n", netns, "link", "set", "lo", "up")
        yield made
    finally:
        for command in (["rm", "--all", "--force", "--time=0"], ["network", "prune", "--force"], ["umount", "--all"]):
            made.podman(*command)
        made.run("ip", "netns", "delete", netns)
        mounted = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()]
        for point in sorted((point for point in mounted if point.startswith(f"{folder}/")), reverse=True):
            made.run("umount", point)
        shutil.rmtree(folder)


def wait_for(what: str, happened: Callable[[], bool]) -> None:
    """Wait until something has happened, much longer than it takes anywhere."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.5)


def _configured(folder: Path) -> dict[str, str]:
    """Write podman's configuration; returns the variables that name it."""
    # Podman's own limits may be above this machine's or, for processes, above those of a build, and are refused then.
    files, processes = resource.getrlimit(resource.RLIMIT_NOFILE)[1], resource.getrlimit(resource.RLIMIT_NPROC)[1]
    limits = [f"nofile={_limit(files)}", f"nproc={_limit(processes)}"]
    (folder / "containers.conf").write_text(
        f"[containers]\ndefault_ulimits = {limits}\n"
        '[engine]\nruntime = "runc"\ncgroup_manager = "cgroupfs"\nevents_logger = "file"\n'
        f'tmp_dir = "{folder / "libpod"}"\n'
        f'[network]\nnetwork_backend = "netavark"\nnetwork_config_dir = "{folder}/networks"\n'
    )
    kind = subprocess.run(["stat", "--file-system", "--format=%T", folder], capture_output=True, text=True, check=True)
    # Layers cannot be laid over layers, where this machine is a container itself.
    driver = "vfs" if kind.stdout.strip() == "overlayfs" else "overlay"
    (folder / "storage.conf").write_text(
        f'[storage]\ndriver = "{driver}"\ngraphroot = "{folder}/storage"\nrunroot = "{folder}/run"\n'
    )
    return {
        "CONTAINERS_CONF": str(folder / "containers.conf"),
        "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
        "BUILDAH_ISOLATION": "chroot",
        "TMPDIR": str(folder),
    }


def _limit(most: int) -> str:
    """A soft and a hard limit that this machine allows."""
    limit = MOST_PROCESSES if most == resource.RLIM_INFINITY else min(most, MOST_PROCESSES)
    return f"{limit}:{limit}"


def _pip_settings() -> dict[str, str]:
    """How pip is set up on this machine, by its files and its environment."""
    listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True)
    pairs = (line.split("=", 1) for line in listed.stdout.splitlines() if "=" in line)
    return {
        name.rpartition(".")[2]: " ".join(str(ast.literal_eval(value)).split())
        for name, value in pairs
        if not name.startswith(":env:.config")
    }


def _mirror() -> str | None:
    """Where this machine, if it is a Debian, gets the packages of its own suite from."""
    system = platform.freedesktop_os_release()
    if system["ID"] != "debian":
        return None
    own = re.escape(system["VERSION_CODENAME"])
    for file in [*Path("/etc/apt/sources.list.d").glob("*"), Path("/etc/apt/sources.list")]:
        for stanza in file.read_text().split("\n\n") if file.is_file() else ():
            uri = re.search(r"^URIs: *(\S+)", stanza, flags=re.MULTILINE)
            if uri and re.search(rf"^Suites:.*\b{own}(\s|$)", stanza, flags=re.MULTILINE):
                return uri[1]
            if line := re.search(rf"^deb (?:\[[^]]*\] *)?(\S+) +{own} .*main", stanza, flags=re.MULTILINE):
                return line[1]
    return None
