"""Ray sessions: what the environment says of others changes nothing, and nobody else reads or reaches a private one."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import psutil
import pytest

from cluster.cli.commands import bench
from cluster.workers import ray_process, session
from cluster.workers.session import ray_session
from shared.errors import UsageError, WorkerError
from shared.interrupts import undisturbed
from shared.io import private
from shared.io.files import DAY_S

ROOT = Path(__file__).parents[2]
SOME_USER = ["unshare", "--user", "--map-user=54321", "--map-group=54321"]
"""A program thinks that it belongs to a user who has no name and no home."""
FOREIGN = {
    "RAY_ADDRESS": "http://127.0.0.1:8265",
    "RAY_NAMESPACE": "theirs",
    "RAY_CLIENT_MODE": "1",
    "RAY_AUTH_MODE": "disabled",
    "RAY_AUTH_TOKEN": "theirs",
    "RAY_AUTH_TOKEN_PATH": "/nonexistent",
    "RAY_TMPDIR": "/nonexistent",
    "RAY_OVERRIDE_RESOURCES": '{"CPU": 0}',
    "RAY_JOB_CONFIG_JSON_ENV_VAR": '{"runtime_env": {"working_dir": "gcs://theirs.zip"}}',
    "RAY_RUNTIME_ENV_HOOK": "no.such.module",
    "RAY_NUM_REDIS_GET_RETRIES": "many",
    "RAY_memory_monitor_refresh_ms": "often",
    "RAY_object_store_memory": "none",
    "RAY_USE_TLS": "1",
    "RAY_LOG_TO_STDERR": "1",
    "RAY_REDIS_ADDRESS": "127.0.0.1:1",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "1",
}
"""What a node, a job or a notebook of another cluster leaves in an environment, and worse."""

RAY_PROCESS = ray_process.__file__
UNUSED = ("monitor", "log_monitor", "dashboard")
"""Programs of Ray that serve nobody in a private session, and slow its start down."""


@pytest.fixture
def scratch() -> Iterator[Path]:
    """A folder whose name is short, as sockets need it."""
    with tempfile.TemporaryDirectory(prefix="", dir="/tmp", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@pytest.fixture
def sessions(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where sessions have their folders, by way of TMPDIR."""
    monkeypatch.setenv("TMPDIR", str(scratch))
    return scratch / f"adaafford-{os.geteuid()}" / "ray"


def look_around() -> None:
    """Print what a private session looks like from within, and what it leaves."""
    before = dict(os.environ)
    found = look_at_session()
    changed = sorted(name for name in before if os.environ.get(name) != before[name])
    print(json.dumps({**found, "changed": changed, "left": len(session_files())}))


def session_files() -> list[Path]:
    """Files of private sessions, living or left behind; not empty folders, which Ray may make again at its end."""
    return [file for file in private.private_folder("ray").rglob("*") if file.is_file()]


def look_at_session() -> dict[str, Any]:
    with ray_session(1):
        import ray

        told = ray.get(ray.remote(lambda: dict(os.environ)).remote())
        token = told["RAY_AUTH_TOKEN"]
        folder, files = private.private_folder("ray"), session_files()
        commands = [" ".join(child.cmdline()) for child in psutil.Process().children(recursive=True)]
        return {
            "token": token,
            "told": {name: value for name, value in told.items() if name in FOREIGN},
            "written": [file.name for file in files if token.encode() in file.read_bytes()],
            "logs": any("raylet" in file.name for file in files),
            "argument": token in " ".join(commands),
            "servers": sum("raylet" in command for command in commands),
            "unused": [each for each in commands if any(f"{name}.py" in each for name in UNUSED)],
            "agents": [each for each in commands if "agent" in each.partition(" --")[0] and RAY_PROCESS not in each],
            "modes": [oct(each.stat().st_mode & 0o777) for each in (folder, folder.parent)],
            "loopback_alone": all(ip_address(each.removeprefix("::ffff:")).is_loopback for each in listened_at()),
            "stranger": stranger_at(ray.get_runtime_context().gcs_address),
        }


def stranger_at(address: str) -> str:
    """What somebody is told who can reach the session's ports but does not have its token."""
    program = "import sys; from ray._raylet import GcsClient; print(GcsClient(sys.argv[1]).internal_kv_keys(b'', None))"
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    forged = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
    done = subprocess.run(
        [sys.executable, "-c", program, address], env={**kept, **forged}, capture_output=True, text=True, timeout=100
    )
    return f"{done.returncode} {done.stdout} {done.stderr}"


def listened_at() -> set[str]:
    """Addresses that processes of this session listen at."""
    children = psutil.Process().children(recursive=True)
    connections = [each for child in children for each in child.net_connections("inet")]
    return {each.laddr.ip for each in connections if each.status == psutil.CONN_LISTEN}


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_private_session_is_private_whatever_the_environment_says(scratch: Path) -> None:
    """Of other sessions, and of a user who has neither a name nor a home."""
    home = scratch / "home"
    home.touch()
    kept = {"PATH": os.environ["PATH"], "LC_ALL": "POSIX", "COLUMNS": "0", "PYTHONPATH": ":/nonexistent:."}
    some_user = SOME_USER if subprocess.run([*SOME_USER, "true"], capture_output=True).returncode == 0 else []
    program = "from tests.cluster.test_ray_session import look_around; look_around()"
    done = subprocess.run(
        [*some_user, sys.executable, "-c", program],
        env={**kept, **FOREIGN, "TMPDIR": str(scratch), **({} if some_user else {"HOME": str(home)})},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found = json.loads(done.stdout)
    assert found["changed"] == []
    assert found["left"] == 0
    assert len(found["token"]) == 64
    assert found["told"] == {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": found["token"], "RAY_CLIENT_MODE": "0"}
    assert found["written"] == [], "nobody needs the token but processes that are given it"
    assert not found["argument"]
    assert found["logs"] and found["servers"], "that was a session"
    assert found["unused"] == []
    assert found["agents"] == [], "programs of ours wait in their place"
    assert found["modes"] == ["0o700", "0o700"]
    assert found["loopback_alone"]
    assert found["stranger"].startswith("1  ") and "AuthenticationError" in found["stranger"]


def test_every_session_has_a_token_of_its_own(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens: list[str] = []

    def note(**settings: object) -> None:
        tokens.append(os.environ["RAY_AUTH_TOKEN"])
        raise RuntimeError("enough")

    monkeypatch.setattr("ray.init", note)
    for _ in range(2):
        with pytest.raises(WorkerError), ray_session(1):
            pass
    assert {len(token) for token in tokens} == {64}
    assert len(set(tokens)) == len(tokens) == 2 * session.START_ATTEMPTS


def test_benchmarks_import_ray_without_foreign_settings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look(settings: object) -> dict[str, object]:
        return {"settings of Ray": sum(name.startswith("RAY_") for name in os.environ)}

    monkeypatch.setenv("RAY_NUM_REDIS_GET_RETRIES", "many")
    monkeypatch.setitem(bench.BENCHMARKS, "collect", (bench.CollectSettings, look))
    assert bench.main(["collect", "--json"]) == 0
    assert '"settings of Ray": 0' in capsys.readouterr().out
    assert os.environ["RAY_NUM_REDIS_GET_RETRIES"] == "many"


@pytest.mark.parametrize(
    "address",
    [
        "http://127.0.0.1:8265",
        "ray://127.0.0.1:10001",
        "head",
        "head:",
        ":6379",
        "head:0",
        "head:65536",
        "a b:1",
        "",
        "local",
    ],
)
def test_what_is_no_address_of_a_cluster_is_refused(address: str) -> None:
    with (
        pytest.raises(UsageError, match=r"is no address of a Ray cluster; give HOST:PORT of its head"),
        ray_session(1, address),
    ):
        pass


def test_auto_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "http://127.0.0.1:8265")
    with pytest.raises(UsageError, match=r"'http://127.0.0.1:8265' is no address"), ray_session(1, "auto"):
        pass


def test_a_cluster_that_does_not_answer_is_said_before_ray_tries_for_long() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with (
        pytest.raises(UsageError, match=rf"no Ray cluster answers at '{address}' \(Connection refused\)"),
        ray_session(1, address),
    ):
        pass


class Server:
    """Answers each connection with some bytes, or not at all."""

    def __init__(self, answer: bytes | None) -> None:
        self._answer, self._socket, self._kept = answer, socket.create_server(("127.0.0.1", 0)), list[socket.socket]()
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> "Server":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        for each in (self._socket, *self._kept):
            each.close()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                self._kept.append(self._socket.accept()[0])
                if self._answer is not None:
                    self._kept[-1].sendall(self._answer)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (None, "timed out"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "something else answers"),
        (b"SSH-2.0-x\r\n", "something else"),
    ],
)
def test_what_is_no_cluster_but_answers_is_refused(
    answer: bytes | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "ANSWER_S", 0.2)
    with (
        Server(answer) as server,
        pytest.raises(UsageError, match=rf"no Ray cluster answers at '{server.address}' \({said}"),
        ray_session(1, server.address),
    ):
        pass


@pytest.mark.parametrize("error", [RuntimeError("Version mismatch:\n 1\n 2"), ConnectionError("no"), ValueError("odd")])
def test_a_cluster_that_cannot_be_joined_is_said_in_a_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def refuse(**settings: object) -> None:
        os.write(2, b"what Ray's native part says meanwhile")
        raise error

    monkeypatch.setattr("ray.init", refuse)
    with (
        Server(session._SETTINGS) as server,
        pytest.raises(UsageError, match=re.escape(" ".join(str(error).split()))),
        ray_session(1, server.address),
    ):
        pass
    assert capfd.readouterr().err == ""


def test_a_removed_current_folder_is_said_in_a_line(
    sessions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(UsageError, match="the current folder has been removed"), ray_session(1):
        pass


@pytest.mark.parametrize("has", [True, False])
def test_where_there_is_little_shared_memory_a_folder_of_the_session_does(
    has: bool, sessions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, object] = {}

    def note(**settings: object) -> None:
        given.update(settings)
        raise RuntimeError("enough")

    monkeypatch.setattr("ray.init", note)
    monkeypatch.setattr(session, "_SHARED_MEMORY", tmp_path if has else tmp_path / "missing")
    with pytest.raises(WorkerError), ray_session(1):
        pass
    assert Path(str(given["_temp_dir"])).parent == sessions
    assert given["_plasma_directory"] == (None if has else given["_temp_dir"])
    assert list(sessions.iterdir()) == []


def test_folders_of_killed_sessions_go_and_those_of_live_ones_stay(sessions: Path) -> None:
    program = "from cluster.workers.session import _session_folder as folder\n"
    program += "with folder() as made: print(made, flush=True); input()"

    def driver() -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [sys.executable, "-c", program], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    with driver() as killed, driver() as living:
        assert killed.stdout is not None and living.stdout is not None
        left, kept = (Path(each.stdout.readline().strip()) for each in (killed, living) if each.stdout is not None)
        (left / "sockets").mkdir()
        (sessions / "again" / "logs").mkdir(parents=True)  # As agents make it that outlive their session.
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        assert left.exists()
        with session._session_folder() as own:
            assert sorted(sessions.iterdir()) == sorted([kept, own])
        living.communicate("\n")
    assert list(sessions.iterdir()) == []


def test_a_session_that_does_not_come_up_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def late(**settings: object) -> None:
        tried.append(settings["_temp_dir"])
        raise Exception("The current node timed out during startup.\nraylet failed")

    monkeypatch.setattr("ray.init", late)
    with pytest.raises(WorkerError, match=r"timed out during startup\.\); run the same command again"), ray_session(1):
        pass
    assert len(set(tried)) == session.START_ATTEMPTS


@pytest.mark.slow
def test_a_session_that_does_not_come_up_at_first_is_started_again_and_leaves_no_process(
    sessions: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import ray

    init, left = ray.init, list[subprocess.Popen[bytes]]()

    def late(**settings: Any) -> None:
        if not left:
            left.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]))
            raise Exception("The current node timed out during startup.")
        init(**settings)

    monkeypatch.setattr("ray.init", late)
    with ray_session(1):
        assert ray.is_initialized()
        assert left[0].poll() is not None
        assert len(list(sessions.iterdir())) == 1
    assert "timed out during startup.); starting it again" in caplog.text
    assert list(sessions.iterdir()) == []


@pytest.mark.parametrize("step", ["ray.shutdown", "cluster.workers.session.remove_tree"])
def test_a_signal_during_the_end_of_a_session_waits_until_nothing_is_left(
    step: str, sessions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []

    def disturbed(*paths: Path) -> None:
        signal.raise_signal(signal.SIGINT)
        for path in paths:
            shutil.rmtree(path)
        done.append(step)

    monkeypatch.setattr("ray.init", lambda **settings: None)
    monkeypatch.setattr("ray.shutdown", lambda: None)
    monkeypatch.setattr(step, disturbed)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), ray_session(1):
            pass
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == [step]
    assert list(sessions.iterdir()) == []


def test_a_session_may_end_in_a_thread_where_no_signals_are_handled() -> None:
    done: list[bool] = []

    def end() -> None:
        with undisturbed():
            done.append(True)

    thread = threading.Thread(target=end)
    thread.start()
    thread.join()
    assert done == [True]


def test_sigterm_ends_a_session_that_starts_as_it_ends_any_command(
    sessions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def starting(**settings: object) -> None:
        from ray._private import utils

        # As Ray does at the beginning of its own.
        utils.set_sigterm_handler(lambda number, frame: sys.exit(number))
        signal.raise_signal(signal.SIGTERM)

    def end(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ray.init", starting)
    before = signal.signal(signal.SIGTERM, end)
    try:
        with pytest.raises(KeyboardInterrupt), ray_session(1):
            pass
    finally:
        signal.signal(signal.SIGTERM, before)
    assert list(sessions.iterdir()) == []


@pytest.mark.timeout(400)
def test_sigterm_just_after_the_native_part_of_ray_has_started_ends_a_command_as_any_other(scratch: Path) -> None:
    lines = (
        "import signal, sys; from ray import _raylet; from cluster.workers.session import ray_session",
        "native = _raylet.CoreWorker",
        "def disturbed(*args):",
        "    started = native(*args)",
        "    signal.raise_signal(signal.SIGTERM)",
        "    return started",
        "_raylet.CoreWorker = disturbed",
        "signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(7))",
        "with ray_session(1): pass",
    )
    told = {**os.environ, "TMPDIR": str(scratch)}
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=ROOT, env=told, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (7, "", "")
    assert list((scratch / f"adaafford-{os.geteuid()}" / "ray").iterdir()) == []


def test_a_session_of_an_earlier_boot_goes_once_nothing_in_it_changes_any_more(sessions: Path) -> None:
    with session._session_folder():
        pass
    long_ago = time.time() - 2 * DAY_S
    for name, changed in (("quiet", long_ago), ("alive", time.time())):
        (sessions / name / "logs").mkdir(parents=True)
        (sessions / name / "owner").write_text("another-boot~1~1")
        (sessions / name / "logs/raylet.out").touch()
        for path in (sessions / name / "logs", sessions / name / "owner", sessions / name):
            os.utime(path, (long_ago, long_ago))
        os.utime(sessions / name / "logs/raylet.out", (changed, changed))
    with session._session_folder() as own:
        assert sorted(sessions.iterdir()) == sorted([sessions / "alive", own])


def test_an_interrupt_while_a_session_starts_leaves_no_process(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[subprocess.Popen[bytes]] = []

    def interrupted(**settings: object) -> None:
        left.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]))
        raise KeyboardInterrupt

    monkeypatch.setattr("ray.init", interrupted)
    with pytest.raises(KeyboardInterrupt), ray_session(1):
        pass
    assert left[0].poll() is not None
    assert list(sessions.iterdir()) == []


def test_a_second_attempt_starts_the_programs_of_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    from ray._private import services

    own, starts = services.start_ray_process, []

    def fail(**settings: object) -> None:
        starts.append(services.start_ray_process)
        raise RuntimeError("another version of Ray")

    monkeypatch.setattr("ray.init", fail)
    with pytest.raises(WorkerError), ray_session(1):
        pass
    assert [start is own for start in starts] == [False, True]
    assert services.start_ray_process is own


def test_only_the_raylets_programs_are_replaced(tmp_path: Path) -> None:
    from ray._private.services import RAY_PATH

    worker, agent = f"{RAY_PATH}/{session._REPLACED[0]}", f"{RAY_PATH}/{session._REPLACED[1]}"
    raylet = [
        "raylet",
        f"--session_dir={tmp_path}",
        f"--node_id={'0' * 56}",
        f"--python_worker_command=python {worker} -v",
    ]
    raylet += [f"--dashboard_agent_command=python -u {agent} --minimal", "--head"]

    def start(command: list[str], process_type: str, **settings: object) -> list[str]:
        return command

    assert session._start_lean(start, ["gcs_server"], "gcs_server") == ["gcs_server"]
    started = session._start_lean(start, raylet, "raylet")
    assert started[3:] == [
        f"--python_worker_command=python {RAY_PROCESS} {worker} -v",
        f"--dashboard_agent_command=python -u {RAY_PROCESS} {agent} --minimal",
        "--head",
    ]
    assert {file.name.removesuffix(f"_{'0' * 56}") for file in tmp_path.iterdir()} == {
        *session._PORTS,
        *session._NO_PORT,
    }


@pytest.mark.slow
def test_a_ray_process_in_place_of_an_agent_ends_with_its_raylet() -> None:
    """A shell stands for the raylet here, and is killed."""
    program = f"export RAY_RAYLET_PID=$$; '{sys.executable}' '{RAY_PROCESS}' /ray/dashboard/agent.py & echo $!; wait"
    with subprocess.Popen(["sh", "-c", program], stdout=subprocess.PIPE, text=True) as raylet:
        assert raylet.stdout is not None
        agent = psutil.Process(int(raylet.stdout.readline()))
        with pytest.raises(psutil.TimeoutExpired):
            agent.wait(timeout=0.5)
        raylet.kill()
        agent.wait(timeout=100)


def test_a_ray_process_in_place_of_a_worker_runs_rays_program_without_slow_imports(tmp_path: Path) -> None:
    """Ray and what it imports are made up here."""
    for name in ray_process.SLOW:
        (tmp_path / f"{name}.py").touch()
    (tmp_path / "ray.py").write_text(
        "import importlib\n"
        "def there(name):\n"
        "    try: return bool(importlib.import_module(name))\n"
        "    except ImportError: return False\n"
        f"found = [name for name in {ray_process.SLOW} if there(name)]\n"
    )
    worker = tmp_path / "workers" / ray_process.WORKER
    worker.parent.mkdir()
    worker.write_text("import ray, sys; print(__name__, sys.argv, sys.path[0], ray.found, ray.there('uri_template'))")
    done = subprocess.run(
        [sys.executable, RAY_PROCESS, worker, "--node"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.stderr == ""
    assert done.stdout.strip() == f"__main__ {[str(worker), '--node']} {worker.parent} [] True"
