"""Files that deploy us pass validators, hold what they promise about safety, and give commands that exist.

No engine runs here: that is tests/containers.
"""

import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from ray.scripts.scripts import start

from cluster.cli.commands import collect, learn
from shared.errors import StoreError
from shared.plan import Job, Plan
from shared.store import Store, compact, repair, verify
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "docker-compose.yml"
KUBERAY = ROOT / "cluster" / "deploy" / "kuberay.yaml"
PROMETHEUS = ROOT / "cluster" / "deploy" / "prometheus.yml"
S3_INIT = ROOT / "cluster" / "deploy" / "s3-init.sh"
S3_STAND_IN = ROOT / "tests" / "containers" / "s3" / "server.py"
KUBERNETES = "1.33"
OURS = {"head", "collector", "driver", "learner"}


def with_variables(text: str) -> str:
    """The text as compose sees it once variables have their values; those without a default must be given."""
    text = re.sub(r"\$\{[A-Z0-9_]+:\?[^}]*\}", "given", text)
    return re.sub(r"\$\{[A-Z0-9_]+:-([^}]*)\}", r"\1", text)


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return yaml.safe_load(with_variables(COMPOSE.read_text()))


@pytest.fixture(scope="module")
def kuberay() -> dict[str, dict[str, Any]]:
    """By kind."""
    return {item["kind"]: item for item in yaml.safe_load(KUBERAY.read_text())["items"]}


def pods(kuberay: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The specifications of all pods."""
    cluster = kuberay["RayJob"]["spec"]["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"], kuberay["Job"]["spec"]]
    return [group["template"]["spec"] for group in groups]


def words_of(command: str | list[str]) -> list[str]:
    """A command as words; those of a shell's script after those of the shell."""
    if isinstance(command, str):
        return [word for part in shlex.split(command) for word in (shlex.split(part) if " " in part else [part])]
    return words_of(" ".join(shlex.quote(word) for word in command))


def invocations(words: list[str], program: str) -> Iterator[list[str]]:
    """The arguments of each call of a program, to the end of its line or statement."""
    ends = [k for k, word in enumerate(words) if word in ("adaafford", "ray", "exec", "cd")] + [len(words)]
    for begin in (k for k, word in enumerate(words) if word == program):
        # A line that goes on leaves its break behind as a word.
        found = words[begin + 1 : min(end for end in ends if end > begin)]
        yield [word.rstrip(";") for word in found if word != "\n"]


def test_the_compose_file_is_one() -> None:
    compose_spec = pytest.importorskip("compose_spec", reason="compose-spec is not installed")
    document = yaml.safe_dump(yaml.safe_load(with_variables(COMPOSE.read_text())))
    compose_spec.PyCompose.from_yaml(document).validate()


def test_what_the_manifest_says_of_pods_volumes_and_jobs_is_kubernetes(kuberay: dict[str, dict[str, Any]]) -> None:
    kubernetes = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed")
    bare = [{"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "pod"}, "spec": spec} for spec in pods(kuberay)]
    for item in [kuberay["PersistentVolumeClaim"], kuberay["Job"], *bare]:
        kubernetes.validate(item, KUBERNETES, strict=True)


def test_nothing_is_published_beyond_loopback(compose: dict[str, Any], kuberay: dict[str, dict[str, Any]]) -> None:
    for name, service in compose["services"].items():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ())), name
        assert service.get("network_mode") is None
    for pod in pods(kuberay):
        assert not pod.get("hostNetwork")
        assert not any("hostPort" in port for container in pod["containers"] for port in container.get("ports", ()))
    assert "serviceType" not in kuberay["RayJob"]["spec"]["rayClusterSpec"]["headGroupSpec"]


def test_every_ray_asks_for_the_token_and_no_secret_has_a_default(
    compose: dict[str, Any], kuberay: dict[str, dict[str, Any]]
) -> None:
    for name in OURS:
        environment = compose["services"][name]["environment"]
        assert environment["RAY_AUTH_MODE"] == "token"
        assert {environment[name] for name in ("RAY_AUTH_TOKEN", "AWS_SECRET_ACCESS_KEY")} == {"given"}
    assert kuberay["RayJob"]["spec"]["rayClusterSpec"]["authOptions"] == {"mode": "token"}
    assert "RAY_AUTH_MODE=token" in (ROOT / "Dockerfile").read_text()


def test_nothing_of_ours_is_root_or_may_become_it(compose: dict[str, Any], kuberay: dict[str, dict[str, Any]]) -> None:
    users = re.findall(r"^USER (.*)$", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE)
    assert users == ["1000:1000"]
    for name in OURS:
        assert compose["services"][name]["image"] == "adaafford"
        assert "user" not in compose["services"][name]
    for service in compose["services"].values():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert not service.get("privileged")
    for pod in pods(kuberay):
        assert pod["securityContext"]["runAsNonRoot"] and pod["securityContext"]["runAsUser"] == 1000
        assert all(not each["securityContext"]["allowPrivilegeEscalation"] for each in pod["containers"])


def test_the_image_holds_the_packages_and_nothing_that_was_not_named() -> None:
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    allowed = {line[1:] for line in ignored if line.startswith("!")}
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE)
    assert "*" in ignored
    assert {name for names in copied for name in names.split()} == allowed
    assert all((ROOT / name).exists() for name in allowed)


def commands(compose: dict[str, Any], kuberay: dict[str, dict[str, Any]]) -> list[list[str]]:
    found = [compose["services"][name]["command"] for name in OURS]
    found += [kuberay["RayJob"]["spec"]["entrypoint"]]
    found += [container["args"] for pod in pods(kuberay) for container in pod["containers"] if "args" in container]
    return [words_of(command) for command in found]


def test_our_commands_are_understood(
    compose: dict[str, Any], kuberay: dict[str, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    understood: list[Any] = []
    monkeypatch.setattr(collect, "run_collection", understood.append)
    monkeypatch.setattr(learn, "_learn", understood.append)
    modules = {"collect": collect, "learn": learn}
    for words in commands(compose, kuberay):
        for name, *arguments in invocations(words, "adaafford"):
            assert modules[name].main(arguments) == 0
    stores = {command.store for command in understood}
    assert stores == {"s3://adaafford/store", "s3://BUCKET/store"}
    for where in stores:
        kinds = [type(command).__name__ for command in understood if command.store == where]
        assert sorted(kinds) == ["CollectCommand", "CollectCommand", "LearnCommand"]


def test_rays_commands_are_understood(compose: dict[str, Any], kuberay: dict[str, dict[str, Any]]) -> None:
    cluster = kuberay["RayJob"]["spec"]["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    found = [[f"--{name}={value}" for name, value in group["rayStartParams"].items()] for group in groups]
    found = [[word.replace("=true", "") if "disable" in word else word for word in words] for words in found]
    for words in commands(compose, kuberay):
        found += [arguments[1:] for arguments in invocations(words, "ray") if arguments[0] == "start"]
    assert len(found) == 5
    for arguments in found:
        start.make_context("start", list(arguments))


def test_prometheus_looks_where_metrics_are(compose: dict[str, Any]) -> None:
    (job,) = yaml.safe_load(PROMETHEUS.read_text())["scrape_configs"]
    (found,) = job["dns_sd_configs"]
    exporting = {
        name for name in OURS if "--metrics-export-port=8080" in words_of(compose["services"][name]["command"])
    }
    assert set(found["names"]) == exporting == {"head", "collector", "driver"}
    assert found["port"] == 8080


def test_images_are_named_by_version(compose: dict[str, Any]) -> None:
    bases = re.findall(r"^FROM (\S+)", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE)
    others = [service["image"] for name, service in compose["services"].items() if name not in OURS]
    for image in [*bases, *others]:
        name, _, tag = image.rpartition(":")
        assert name and re.match(r"v?\d", tag), image


def test_only_the_server_and_what_makes_keys_know_the_root_key(compose: dict[str, Any]) -> None:
    knowing = {name for name, service in compose["services"].items() if "RUSTFS_SECRET_KEY" in repr(service)}
    assert knowing == {"s3", "bucket"}


def listens(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def s3_with_keys(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address of a server that checks rights; `s3-init.sh` made its bucket and the key that the environment names."""
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    root = {"RUSTFS_ACCESS_KEY": "root", "RUSTFS_SECRET_KEY": "root's secret"}
    ours = {
        "S3_ENDPOINT": f"http://127.0.0.1:{port}",
        "S3_BUCKET": "adaafford",
        "S3_KEY": "ours",
        "S3_SECRET": "secret",
    }
    server = {**os.environ, **root, "ADDRESS": "127.0.0.1", "PORT": str(port)}
    with subprocess.Popen([sys.executable, str(S3_STAND_IN)], env=server, stderr=subprocess.DEVNULL) as process:
        try:
            while process.poll() is None and not listens(port):
                time.sleep(0.05)
            for _ in range(2):
                subprocess.run(["sh", str(S3_INIT)], env={**os.environ, **root, **ours}, check=True)
            for name in [name for name in os.environ if name.startswith("AWS_")]:
                monkeypatch.delenv(name)
            for name, value in (("ACCESS_KEY_ID", "ours"), ("SECRET_ACCESS_KEY", "secret"), ("REGION", "us-east-1")):
                monkeypatch.setenv(f"AWS_{name}", value)
            monkeypatch.setenv("AWS_ENDPOINT_URL", ours["S3_ENDPOINT"])
            yield ours["S3_ENDPOINT"]
        finally:
            process.terminate()


@pytest.mark.slow
def test_the_rights_of_our_key_are_enough_for_a_store_and_for_nothing_else(
    s3_with_keys: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    setting = fabricate_setting()
    plan = Plan(setting=setting)
    store = Store.create("s3://adaafford/store", setting)
    for job in (Job(plan.key, 0, 2), Job(plan.key, 2, 4)):
        store.commit(plan, job, fabricate_rollouts(plan, job), {})
    compact(store, 4)
    repair("s3://adaafford/store")
    assert verify(store) == []
    with pytest.raises(StoreError):
        Store.create("s3://another/store", setting)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError):
        Store.open("s3://adaafford/store")
