"""Collectors and a learner as processes of their own, which share a store and nothing else, and are killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from learner.settings import AlternationConfig
from shared.store import Store, verify
from tests.support.as_toml import as_toml
from tests.support.small_trainings import FAST

ROOT = Path(__file__).parents[2]
RANDOM, ROUND = 8, 4
COLLECT = (
    *("collect", "--task", "push-faucet", "--procedural-per-category", "4", "--workers", "0", "--per-shard", "2"),
    *("--collection.camera.points", "256", "--collection.rollout.interactions", "8"),
)
PATIENCE_S = 200


def adaafford(folder: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    program = "import sys; from cluster.cli.main import main; main()"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    with (folder / f"{arguments[0]}.log").open("a") as log:
        command = [sys.executable, "-c", program, *arguments]
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment)


def learn(folder: Path) -> "subprocess.Popen[bytes]":
    config = FAST.model_copy(update={"alternation": AlternationConfig(rounds=2, patience=2), "threads": 1})
    (folder / "learner.toml").write_text(as_toml(config.model_dump(mode="json")))
    where = ["--store", str(folder / "store"), "--out", str(folder / "out"), "--config", str(folder / "learner.toml")]
    pace = ["--follow", "--first-rollouts", str(RANDOM), "--more-rollouts", str(ROUND), "--poll-s", "0.2"]
    return adaafford(folder, "learn", *where, *pace)


def propose(folder: Path) -> "subprocess.Popen[bytes]":
    rounds = ["--proposer", "aip", "--policy", "latest", "--per-version", str(ROUND), "--rollouts", str(2 * ROUND)]
    return adaafford(folder, *COLLECT, "--store", str(folder / "store"), *rounds)


def collect_at_random(folder: Path) -> None:
    folder.mkdir()
    arguments = [*COLLECT, "--store", str(folder / "store"), "--rollouts", str(RANDOM)]
    assert adaafford(folder, *arguments).wait(PATIENCE_S) == 0, (folder / "collect.log").read_text()


def kill_when(process: "subprocess.Popen[bytes]", moment: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not moment():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()


def both_end(folder: Path, *processes: "subprocess.Popen[bytes]") -> Store:
    for process in processes:
        logs = [file.read_text() for file in folder.glob("*.log")]
        assert process.wait(PATIENCE_S) == 0, logs
    store = Store.open(folder / "store")
    assert verify(store) == []
    return store


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_rounds_of_killed_processes_end_as_those_of_unkilled_ones(tmp_path: Path) -> None:
    """Collectors and learner start before there is anything to do, and each is killed twice; the digest is the same."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        collect_at_random(folder)
    undisturbed = both_end(whole, learn(whole), propose(whole))

    def proposed() -> int:
        return len(list((killed / "store" / "shards").glob("aip-*")))

    collector, learner = propose(killed), learn(killed)
    kill_when(learner, lambda: (killed / "out" / "prior" / "done.json").exists())
    learner = learn(killed)
    kill_when(collector, lambda: proposed() >= 1)
    collector = propose(killed)
    kill_when(learner, lambda: (killed / "out" / "data-2.json").exists())
    learner = learn(killed)
    kill_when(collector, lambda: proposed() >= 2)
    disturbed = both_end(killed, learner, propose(killed))

    assert disturbed.policy_versions() == undisturbed.policy_versions() == (1, 2)
    assert disturbed.digest() == undisturbed.digest()
    held = {(shard.plan_key, shard.start, shard.stop) for shard in disturbed.committed()}
    assert held >= {("aip-v1", 0, 2), ("aip-v1", 2, 4), ("aip-v2", 4, 6), ("aip-v2", 6, 8)}
    for shard in disturbed.committed("aip-v1"):
        assert shard.provenance["newest_policy"] == "1"
