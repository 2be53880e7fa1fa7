"""The Ray session: a private one on this machine's loopback, or a connection to a cluster that runs already.

A private session depends on nothing that the environment says of other Ray sessions, and other users of the machine can
neither reach nor read it: it has a token of its own, handed over in the environment alone, and a private folder.
"""

import logging
import os
import re
import secrets
import socket
import subprocess
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from cluster.workers import ray_process
from cluster.workers.worker_group import SerialWorkerGroup, WorkerGroup, make_worker
from collector.job_result import WorkerFactory
from collector.watchdog import Limits
from shared.errors import StoreError, UsageError, WorkerError
from shared.extras import require_packages
from shared.interrupts import undisturbed
from shared.io.files import (
    DAY_S,
    is_abandoned,
    process_name,
    read_bounded,
    remove_if_abandoned,
    remove_tree,
    temporary_name,
)
from shared.io.private import private_folder
from shared.store import Store
from shared.store.crash_log import CrashLog

OBJECT_STORE_BYTES = 128 << 20
"""Only weights and job results travel, so the smallest object store that Ray likes is ample."""
ANSWER_S = 5.0
"""How long a cluster may take to answer."""
AGENTS_S = 10.0
"""How long Ray's agents, which write to the session's folder, may take to end after it."""
START_ATTEMPTS = 2
"""How often Ray is started before a session is given up: Ray allows itself 30 s, too few for a busy machine. After the
first attempt, Ray's own programs are used throughout: another version of Ray may need them."""
RAY_PREFIX = "RAY_"
"""Of the environment variables that Ray reads."""

_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # The new behaviour; unset, Ray warns that it will come.
    "RAY_DISABLE_IMPORT_WARNING": "1",
    # Actors inherit these: one CPU each, and no library may think that it has more.
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
_SYSTEM = {"gcs_rpc_server_reconnect_timeout_s": 20}
"""The control store of a private session never comes back: it is given up after 20 s, not after 60. Not by a variable,
which Ray's native part may fail to parse where it is loaded after SAPIEN."""
_UNUSED = ("start_monitor", "start_log_monitor", "start_api_server")
"""Methods of Ray's node that start its autoscaler, what follows its log files, and the server of its dashboard.

A private session has no use for them, and each takes two seconds of a processor just when the workers start."""
_REPLACED = ("_private/workers/default_worker.py", "dashboard/agent.py", "_private/runtime_env/agent/main.py")
"""Programs of Ray in whose place `cluster.workers.ray_process` runs: the worker's, and those of two agents.

The agents serve the dashboard, metrics, and environments of single tasks. A private session has none of these, but the
raylet needs two agents that live, and their ports."""
_PORTS = {"metrics_agent_port": -1, "metrics_export_port": -1, "dashboard_agent_listen_port": -1}
"""Ports of the agents that are not in use, as the agents of Ray's minimal installation state them."""
_NO_PORT = {"runtime_env_agent_port": 1}
"""Nothing listens there, and no other user could."""
_ADDRESS = re.compile(r"(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})")
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_SETTINGS = bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""How a connection of HTTP/2 begins: the client's preface, and a frame of settings, here of none."""
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108
_OWNER_FILE = "owner"

WorkerGroupMaker = Callable[[WorkerFactory, CrashLog], WorkerGroup]
"""Makes a worker group from a worker factory and the crash log for its heartbeats."""

logger = logging.getLogger(__name__)


class CurrentWorkerGroup:
    """The live worker group: one at a time, since each worker holds a CPU; kept as long as the store stays the same."""

    def __init__(self, make_worker_group: WorkerGroupMaker) -> None:
        self._make_worker_group = make_worker_group
        self._worker_group: WorkerGroup | None = None
        self._of: tuple[str, Path] | None = None

    def for_store(self, store: Store, objects: Path) -> WorkerGroup:
        """The worker group whose workers write to `store`."""
        if self._worker_group is None or self._of != (store.where, objects):
            self.dismiss()
            self._worker_group = self._make_worker_group(partial(make_worker, store.where, objects), store.crash_log)
            self._of = store.where, objects
        return self._worker_group

    def dismiss(self) -> None:
        """End the workers."""
        if self._worker_group is not None:
            self._worker_group.close()
        self._worker_group = None


@contextmanager
def worker_groups(workers: int, limits: Limits, address: str | None = None) -> Iterator[WorkerGroupMaker]:
    """A maker of worker groups that live at most as long as the context: serial if `workers` is 0, else on Ray.

    Ray starts with the first worker group, so that what needs none does not wait for it.

    Args:
        workers: how many actors a worker group has; 0 does without Ray.
        limits: what a rollout may take.
        address: of a running Ray cluster; None starts a session of our own on this machine.

    Raises:
        UsageError: as soon as a worker group is wanted, where Ray or SAPIEN is not installed.
    """
    with ExitStack() as stack:
        begun = False

        def make(make_worker: WorkerFactory, crash_log: CrashLog) -> WorkerGroup:
            nonlocal begun
            if workers == 0:
                require_packages("collecting", "sapien")
                return SerialWorkerGroup(make_worker)
            # On a cluster, it is the workers that need SAPIEN.
            require_packages("collecting", "ray", *(["sapien"] if address is None else []))
            if not begun:
                stack.enter_context(ray_session(workers, address))
                begun = True
            from cluster.workers.ray_group import RayWorkerGroup

            worker_group = RayWorkerGroup(make_worker, crash_log, workers, limits)
            stack.callback(worker_group.close)
            return worker_group

        yield make


@contextmanager
def ray_session(workers: int, address: str | None = None) -> Iterator[None]:
    """Hold a Ray session: no dashboard, quiet, and shut down in the end whatever happens.

    Args:
        workers: processors of a session of our own.
        address: HOST:PORT of a cluster's head, or "auto"; None starts a session of our own.

    Raises:
        UsageError: there is no cluster at `address`, or no private folder for a session of our own.
        WorkerError: a session of our own does not come up, however often it is tried.
    """
    with _private_session(workers) if address is None else _cluster(address):
        yield


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """Connect to a cluster that runs already, as the environment's variables for Ray say.

    Raises:
        UsageError: there is none.
    """
    named = (os.environ.get("RAY_ADDRESS") or address) if address == "auto" else address
    match = _ADDRESS.fullmatch(named)
    if named != "auto" and (match is None or not 0 < int(match["port"]) < 1 << 16):
        raise UsageError(
            f"'{named}' is no address of a Ray cluster; give HOST:PORT of its head (not of its dashboard, and without "
            "http:// or ray://), or auto on one of its machines, or leave the address out"
        )
    # A server that has answered is asked thrice whether it is a head, not for 20 s.
    with _changed_environment({**_ENVIRONMENT, "RAY_gcs_server_port_wait_time_s": "3"}), _ray() as ray:
        from ray._private.services import canonicalize_bootstrap_address_or_die

        try:
            with _native_silence():
                _greet(canonicalize_bootstrap_address_or_die("auto") if match is None else named)
                ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        except Exception as error:
            # What Ray raises depends on what answers: another program, another version, one that wants a token.
            said = " ".join(str(getattr(error, "strerror", None) or error).split())[:300]
            raise UsageError(
                f"no Ray cluster answers at '{named}' ({said}); start one, or leave the address out"
            ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _greet(address: str) -> None:
    """See that a server of HTTP/2 is there, as Ray's head is one: with anything else, Ray takes minutes to give up.

    Raises:
        OSError: there is none.
    """
    host, _, port = address.rpartition(":")
    with socket.create_connection((host.strip("[]"), int(port)), ANSWER_S) as connection:
        if os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true"):
            return
        connection.sendall(_PREFACE + _SETTINGS)
        # A server's first frame is its settings, too; the fourth byte is the kind.
        if connection.recv(9)[3:4] != _SETTINGS[3:4]:
            raise ConnectionError("something else answers")


@contextmanager
def _native_silence() -> Iterator[None]:
    """Nothing reaches standard error: Ray's native part complains there while it tries, before it raises."""
    try:
        kept = os.dup(2)
    except OSError:  # It is closed.
        yield
        return
    try:
        with open(os.devnull, "wb") as nothing:  # noqa: PTH123
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextmanager
def _private_session(workers: int) -> Iterator[None]:
    """Start a session that listens on loopback alone, and whose files and token are this user's alone."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise UsageError("the current folder has been removed; change into one that is there") from None
    # For as long as the session lives, since Ray reads some of them late.
    with without_foreign_settings(), ExitStack() as session:
        for attempt in range(START_ATTEMPTS):
            try:
                session.enter_context(_started_session(workers, lean=attempt == 0))
                break
            except WorkerError as error:
                if attempt + 1 == START_ATTEMPTS:
                    raise
                logger.warning("%s; starting it again", str(error).partition(";")[0])
        yield


@contextmanager
def _started_session(workers: int, *, lean: bool) -> Iterator[None]:
    """A session in a folder of its own; of one that does not come up, no process and no folder is left.

    Args:
        workers: processors of the session.
        lean: see `_start_on_loopback`.

    Raises:
        WorkerError: it does not come up.
    """
    with _session_folder() as folder:
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        with _changed_environment({**_ENVIRONMENT, **token}), _ray() as ray:
            others = psutil.Process().children(recursive=True)
            try:
                _start_on_loopback(workers, folder, lean=lean)
            except BaseException:  # An interrupt, too.
                with undisturbed():
                    ray.shutdown()
                    _kill(set(psutil.Process().children(recursive=True)) - set(others))
                raise
        try:
            yield
        finally:
            with undisturbed():
                processes = _processes_of_ray()
                ray.shutdown()
                psutil.wait_procs(processes, AGENTS_S)


def _start_on_loopback(workers: int, folder: Path, *, lean: bool) -> None:
    """Start Ray so that nothing listens beyond this machine: it executes code for whoever reaches its ports.

    Ray replaces 127.0.0.1 by the address that others would reach, except where it believes that clusters are not
    supported (as on macOS and Windows); so that belief is installed while the session starts.

    Args:
        workers: processors of the session.
        folder: of the session.
        lean: whether `cluster.workers.ray_process` runs in place of some programs of Ray.
    """
    import ray
    from ray._private import ray_constants, services
    from ray._private.node import Node

    idle = {name: lambda self, **_: None for name in _UNUSED if hasattr(Node, name)}
    start = services.start_ray_process
    try:
        with (
            _changed_attributes(ray_constants, {"ENABLE_RAY_CLUSTER": False}),
            _changed_attributes(Node, idle),
            _changed_attributes(services, {"start_ray_process": partial(_start_lean, start) if lean else start}),
        ):
            ray.init(
                address="local",
                num_cpus=workers,
                num_gpus=0,
                include_dashboard=False,
                object_store_memory=OBJECT_STORE_BYTES,
                logging_level=logging.ERROR,
                log_to_driver=False,
                _node_ip_address="127.0.0.1",
                _temp_dir=str(folder),
                _plasma_directory=None if _has_shared_memory() else str(folder),
                _system_config=_SYSTEM,
            )
    except Exception as error:
        # Ray has no class of its own for a session that does not come up in its 30 s.
        said = str(error).partition("\n")[0]
        raise WorkerError(f"Ray did not start ({said}); run the same command again, or with --workers 0") from error


def _start_lean(start: Callable[..., Any], command: Sequence[str], process_type: str, **settings: Any) -> Any:
    """Start a process of Ray by `start`; the raylet's workers start faster, and its agents only wait."""
    if process_type != "raylet":
        return start(command, process_type, **settings)
    from ray import _raylet
    from ray._private.services import RAY_PATH

    native: Any = _raylet
    options = dict(option.partition("=")[::2] for option in command)
    for name, port in {**_PORTS, **_NO_PORT}.items():
        native.persist_port(options["--session_dir"], options["--node_id"], name, port)
    lean = list(command)
    for program in _REPLACED:
        theirs = str(Path(RAY_PATH, program))
        both = subprocess.list2cmdline([ray_process.__file__, theirs])
        # Each option of these is a command line in one string.
        lean = [option.replace(f" {subprocess.list2cmdline([theirs])} ", f" {both} ") for option in lean]
    return start(lean, process_type, **settings)


@contextmanager
def _changed_attributes(owner: Any, changes: Mapping[str, Any]) -> Iterator[None]:
    """Attributes that are others meanwhile."""
    before = {name: getattr(owner, name) for name in changes}
    for name, value in changes.items():
        setattr(owner, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(owner, name, value)


def _kill(processes: Iterable[psutil.Process]) -> None:
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(processes, AGENTS_S)


def _processes_of_ray() -> list[psutil.Process]:
    found = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.name().startswith("ray"):
                found.append(process)
    return found


def _has_shared_memory() -> bool:
    """Whether the object store fits where Ray expects it; a container may have little there."""
    try:
        found = os.statvfs(_SHARED_MEMORY)
    except OSError:
        return False
    return found.f_bavail * found.f_frsize > OBJECT_STORE_BYTES and os.access(_SHARED_MEMORY, os.W_OK)


@contextmanager
def _session_folder() -> Iterator[Path]:
    """A folder for one session, which is removed in the end; those that killed drivers left are removed before.

    Its name is short, as that of sockets has to be, so a file in it says whose it is; it is made and removed under a
    temporary name, so that it has that file for as long as it has the short name.
    """
    sessions = private_folder("ray")
    for left in sessions.iterdir():
        if not remove_if_abandoned(left) and _is_abandoned(left):
            _remove_session(left)
    new, folder = sessions / temporary_name("session"), sessions / secrets.token_hex(3)
    new.mkdir(0o700)
    (new / _OWNER_FILE).write_text(process_name())
    new.rename(folder)
    try:
        yield folder
    finally:
        with undisturbed():
            _remove_session(folder)


def _is_abandoned(folder: Path) -> bool:
    try:
        owner = read_bounded(folder / _OWNER_FILE, 1 << 10).decode(errors="replace")
        # Whether the owner lives in another container or did so before this boot, only the folder can tell: a live
        # session writes to its logs every few seconds.
        newest = max((folder, *folder.rglob("*")), key=lambda path: path.lstat().st_mtime)
        return is_abandoned(newest, owner, DAY_S)
    except StoreError:
        # None, so this is no folder of a session any more: agents of one that was killed have made it again.
        return True
    except OSError:
        # It changes right now, so somebody is at work in it.
        return False


def _remove_session(folder: Path) -> None:
    old = folder.with_name(temporary_name("session"))
    with suppress(FileNotFoundError):  # Another driver was faster.
        folder.rename(old)
        remove_tree(old)


@contextmanager
def without_foreign_settings() -> Iterator[None]:
    """The environment has no variables for Ray, which other sessions, nodes and jobs leave there."""
    with _changed_environment(dict.fromkeys(name for name in os.environ if name.startswith(RAY_PREFIX))):
        yield


@contextmanager
def _changed_environment(changes: Mapping[str, str | None]) -> Iterator[None]:
    """Environment variables that are set meanwhile, and others (None) that are not."""
    before = {name: os.environ.get(name) for name in changes}
    _set_environment(changes)
    try:
        yield
    finally:
        _set_environment(before)


def _set_environment(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


@contextmanager
def _ray() -> Iterator[Any]:
    """Ray, made quiet, while it starts; what it has kept of the environment is read anew.

    Neither its Python part nor its native part puts a handler of SIGTERM in place of ours, which would end this process
    without a word while Ray starts. Signals wait while its native part starts, which crashes where it is interrupted.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own deprecations; a user can do nothing about them.
        with ray_process.without_slow_imports():
            import ray
        from ray import _raylet
        from ray._private import ray_constants, utils, worker

        native: Any = _raylet
        worker.print_to_stdstream = _to_log
        native.Config.initialize("")
        native.AuthenticationTokenLoader.instance().reset_cache()
        with (
            _changed_attributes(utils, {"set_sigterm_handler": lambda handler: None}),
            _changed_attributes(ray_constants, {"RAY_DISABLE_FAILURE_SIGNAL_HANDLER": True}),
            _changed_attributes(worker, {"connect": undisturbed()(worker.connect)}),
        ):
            yield ray


def _to_log(data: dict[str, Any], ignore_prefix: bool = False) -> None:
    """Take what raylets would print on our terminal: the end of an actor, say, which we report ourselves."""
    logger.debug("%s", " ".join(data.get("lines", ())))
