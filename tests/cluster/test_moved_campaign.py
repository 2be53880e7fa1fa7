"""A small campaign that is stopped, moved, resumed with other software and published: it goes on and tells no place."""

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from cluster.config.campaign_config import CampaignConfig, LearnerSettings, RolloutCounts
from shared.io.interpreter import PYTHON, own_environment
from shared.plan import EvaluationConfig
from shared.store import Store, verify
from tests.support.as_toml import as_toml
from tests.support.small_trainings import FAST

pytestmark = pytest.mark.slow

HOST, USER, SECRET = "a-machine-of-mine", "somebody", "correct-horse-battery"
ALLOWED = ("status/machine-", "places.json")
"""What tells of machines and places; nobody publishes it."""
CONFIG = CampaignConfig(
    task="push-faucet",
    workers=0,
    alternations=0,
    rollouts=RolloutCounts(random=24, evaluation=3, per_shard=1),
    collection=CampaignConfig().collection.model_validate(
        {"camera": {"points": 64, "image_size": 64}, "rollout": {"interactions": 4}}
    ),
    learner=LearnerSettings(network=FAST.network, prior=FAST.prior, aap=FAST.aap, aip=FAST.aip),
    evaluation=EvaluationConfig(methods=("where2act", "ours-final"), budgets=(1,), queries=4),
)


class Command:
    """`adaafford` as somebody runs it, on a machine whose name and user are known."""

    def __init__(self, home: Path) -> None:
        self._home = home
        site = home / "site"
        site.mkdir(parents=True)
        # Read by the interpreter as it starts: here it stands for a machine of another name.
        (site / "sitecustomize.py").write_text(f"import socket; socket.gethostname = lambda: {HOST!r}\n")
        environment = own_environment()
        paths = [str(site), *environment.get("PYTHONPATH", "").split(os.pathsep)]
        self._environment = environment | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "HOME": str(home),
            "USER": USER,
            "AWS_ENDPOINT_URL": f"http://me:{SECRET}@127.0.0.1:9/",
            "AWS_SECRET_ACCESS_KEY": SECRET,
        }

    def begin(self, *args: object) -> "subprocess.Popen[str]":
        command = [*PYTHON, "-m", "cluster", *map(str, args)]
        return subprocess.Popen(
            command, cwd=self._home, env=self._environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, *args: object) -> str:
        """What it said, on both streams."""
        process = self.begin(*args)
        out, err = process.communicate()
        assert process.returncode == 0, err
        return out + err


def stopped_amid(command: Command, run: Path, *args: object) -> None:
    process = command.begin(*args)
    deadline = time.monotonic() + 300
    while len(list(run.glob("store/shards/*/manifest.json"))) < 2:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    process.kill()
    process.communicate()


def telling(folder: Path, *words: str) -> list[str]:
    """Files below a folder that hold one of some words, or have it in their names."""
    found = []
    for path in sorted(each for each in folder.rglob("*") if each.is_file()):
        name, data = path.relative_to(folder).as_posix(), path.read_bytes()
        if any(word in name or word.encode() in data for word in words):
            found.append(name)
    return found


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home") / USER


def test_a_campaign_goes_on_elsewhere_and_tells_no_place(home: Path) -> None:
    command = Command(home)
    file, first, second = home / "settings.toml", home / "first", home / "second"
    document = CONFIG.model_dump(mode="json")
    file.write_text(as_toml(document))
    stopped_amid(command, first, "run", "--config", file, "--out", first)
    committed = {path.name for path in (first / "store" / "shards").iterdir() if not path.name.startswith(".")}
    # Copied as `cp -r` does, to where the old folder is gone; and the software is another by now.
    shutil.copytree(first, second, copy_function=shutil.copy)
    shutil.rmtree(first)
    begun = json.loads((second / "config.json").read_text())
    begun["software"] |= {"numpy": "0.0.1", "sapien": "0.0.2"}
    (second / "config.json").write_text(json.dumps(begun))

    said = command("resume", second)
    assert "begun with other software: numpy 0.0.1 (now " in said and "sapien 0.0.2 (now " in said
    summary = json.loads((second / "summary.json").read_text())
    assert summary["earlier_software"][0]["numpy"] == "0.0.1" != summary["software"]["numpy"]
    assert committed <= {path.name for path in (second / "store" / "shards").iterdir()}
    assert verify(Store.open(second / "store")) == []

    second.rename(home / "third")
    (home / "link").symlink_to(home / "third")
    assert "no problems" in command("store", "verify", home / "link" / "store")
    command("report", home / "link", "--no-experiments")
    command("evaluate", "--run", home / "link", "--workers", 0, "--trials", 1, "--queries", 2, "--budgets", 1)
    command("export-policy", home / "link", "--out", home / "policy")
    command("store", "export", home / "link" / "store", "--out", home / "data")
    command("compare", home / "link", "--out", home / "comparison")
    for folder in ("third", "policy", "data", "comparison"):
        words = (HOST, str(home.parent), SECRET)
        found = [name for name in telling(home / folder, *words) if not any(each in name for each in ALLOWED)]
        assert found == [], folder
    machines = list((home / "third" / "store" / "status").glob("machine-*.json"))
    assert [json.loads(path.read_text()) for path in machines] == [{"host": HOST}]
    manifest = json.loads(next((home / "third" / "store" / "shards").glob("*/manifest.json")).read_text())
    assert manifest["provenance"]["machine"] == machines[0].stem.removeprefix("machine-")
