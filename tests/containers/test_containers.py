"""The services of docker-compose.yml, really run: a small campaign, whose driver is killed twice, and its digest.

The S3 server is a stand-in for RustFS that checks each request's signature and policy; Prometheus does not run. This
takes ten minutes and some gigabytes of disk: `make test-container`.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from learner.settings import AlternationConfig
from tests.containers.engine import Engine, Services, engine, wait_for, why_not
from tests.support.as_toml import as_toml
from tests.support.small_trainings import FAST

ROOT = Path(__file__).parents[2]
STORE = "s3://adaafford/store"
BASE, IMAGE, S3_IMAGE = "python:3.11-slim-bookworm", "adaafford", "adaafford-s3"
RANDOM, PROPOSED, ROUND = 96, 8, 4
SETTINGS = {
    "ADAAFFORD_RANDOM": str(RANDOM),
    "ADAAFFORD_PROPOSED": str(PROPOSED),
    "ADAAFFORD_ROUND": str(ROUND),
    "ADAAFFORD_COLLECTOR_CPUS": "1",
    "ADAAFFORD_LEARNER_THREADS": "1",
    "ADAAFFORD_COLLECT_FLAGS": "--procedural-per-category 4 --per-shard 2 --collection.camera.points 256 "
    "--collection.rollout.interactions 8",
    # Rounds, since only then is it the same whenever a policy is published which version proposes what.
    "ADAAFFORD_PROPOSE_FLAGS": f"--per-version {ROUND}",
}
SECRETS = {name: f"secret-of-this-test-{name}" for name in ("ADAAFFORD_S3_SECRET", "ADAAFFORD_S3_ROOT_SECRET")}
TOKEN = {"ADAAFFORD_TOKEN": "0123456789abcdef" * 4}

pytestmark = [pytest.mark.slow, pytest.mark.container, pytest.mark.timeout(5400)]


@pytest.fixture(scope="module")
def podman(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    """An engine that has the images."""
    folder = tmp_path_factory.mktemp("engine")
    if reason := why_not(folder):
        pytest.skip(reason)
    pytest.importorskip("podman_compose", reason="podman-compose is not installed")
    with engine(folder) as made:
        made.make_base(BASE)
        made.build(IMAGE, ROOT)
        context = folder / "s3"
        shutil.copytree(Path(__file__).parent / "s3", context)
        shutil.copy(ROOT / "constraints.txt", context)
        made.build(S3_IMAGE, context)
        yield made


def learner_settings(folder: Path) -> str:
    """Write settings of a training that takes seconds; returns the flags of `adaafford learn` that name them."""
    folder.mkdir()
    settings = FAST.model_copy(update={"alternation": AlternationConfig(rounds=2, patience=2), "threads": 1})
    (folder / "learner.toml").write_text(as_toml(settings.model_dump(mode="json")))
    return "--poll-s 0.5 --config {}/learner.toml"


def rollouts(services: Services) -> dict[str, int]:
    """How many rollouts the store holds by plan, as the status command tells in a container."""
    told = json.loads(services.execute("head", "adaafford", "status", STORE, "--json"))
    return dict(told["stores"][0]["rollouts"])


def crash(services: Services, service: str) -> None:
    """Kill a container's first process; the file's restart policy must bring it back."""
    before = services.state(service)
    assert before["Status"] == "running"
    os.kill(before["Pid"], signal.SIGKILL)
    wait_for(f"the restart of {service}", lambda: services.state(service)["restarts"] > before["restarts"])
    print(f"killed {service}, which was started again")


def without_containers(services: Services, folder: Path) -> str:
    """Run what the file says of driver and learner in this environment, in one process each; returns the digest."""
    store, programs = folder / "store", folder / "bin"
    flags = learner_settings(folder / "objects").format(folder / "objects")
    programs.mkdir()
    for name, body in {"ray": "exit 0", "adaafford": f'exec {sys.executable} -m cluster "$@"'}.items():
        (programs / name).write_text(f"#!/bin/sh\n{body}\n")
        (programs / name).chmod(0o755)
    environment = {
        **os.environ,
        **SETTINGS,
        "ADAAFFORD_LEARN_FLAGS": flags,
        "ADAAFFORD_WORKERS": "0",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
        "PATH": f"{programs}:{os.environ['PATH']}",
    }
    started = []
    for service in ("learner", "driver"):
        *shell, script = services.declared[service]["command"]
        for there, here in (
            (STORE, str(store)),
            ("/data/learner", str(folder / "learner")),
            ("--ray-address auto", ""),
        ):
            script = script.replace(there, here)
        started.append(subprocess.Popen([*shell, script], env=environment, cwd=folder))
    assert [process.wait() for process in started] == [0, 0]
    digest = ["adaafford", "store", "digest", str(store)]
    return subprocess.run(digest, env=environment, capture_output=True, text=True, check=True).stdout.split()[-1]


def test_a_campaign_in_containers_survives_kills_and_ends_as_without_them(podman: Engine, tmp_path: Path) -> None:
    flags = learner_settings(tmp_path / "objects").format("/objects")
    variables = {"ADAAFFORD_S3_IMAGE": S3_IMAGE, "ADAAFFORD_OBJECTS": str(tmp_path / "objects")}
    services = Services(
        podman,
        ROOT / "docker-compose.yml",
        {**SETTINGS, **SECRETS, **TOKEN, **variables, "ADAAFFORD_LEARN_FLAGS": flags},
    )
    for service in ("head", "bucket"):
        services.up(service)
    wait_for("the bucket", lambda: services.has_ended("bucket"))
    print(services.execute("head", "adaafford", "store", "check-place", "s3://adaafford/check").strip())
    services.up("collector", copies=2)
    for service in ("learner", "driver"):
        services.up(service)
    wait_for("the first rollouts", lambda: "is committed" in services.logs("driver"))
    crash(services, "driver")
    print(podman.podman("ps", "--all", "--format", "table {{.Names}} {{.Image}} {{.Status}} {{.Ports}}"))
    wait_for("the second policy's rollouts", lambda: rollouts(services).get("aip-v1", 0) > 0)
    if not services.has_ended("driver"):
        crash(services, "driver")
    print(services.execute("head", "adaafford", "status", STORE, "--once"))
    for service in ("driver", "learner"):
        wait_for(f"the end of {service}", lambda service=service: services.has_ended(service))
    starts = re.findall(rf"collecting random-v0: (\d+) of {RANDOM} rollouts are there", services.logs("driver"))
    print(f"starts of the driver found {', '.join(starts)} of {RANDOM} random rollouts")
    assert starts[0] == "0" and 0 < int(starts[1]) < RANDOM

    assert rollouts(services) == {"random-v0": RANDOM, "aip-v1": ROUND, "aip-v2": PROPOSED - ROUND}
    assert services.execute("head", "adaafford", "store", "verify", STORE).startswith("no problems")
    digest = services.execute("head", "adaafford", "store", "digest", STORE).split()[-1]
    (tmp_path / "host").mkdir()
    undisturbed = without_containers(services, tmp_path / "host")
    print(f"digest in containers {digest}, without {undisturbed}")
    assert digest == undisturbed
