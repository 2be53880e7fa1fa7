"""The example scripts run as their first lines say."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from collector.objects.procedural import generate
from tests.support.small_trainings import make_store

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a folder `objects`."""
    folder = tmp_path_factory.mktemp("examples")
    generate(folder / "objects", {"Faucet": 3}, seed=4)
    return folder


def example(place: Path, name: str, *args: str) -> str:
    """What a script prints."""
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(EXAMPLES.parent)}
    command = [sys.executable, "-W", "error", str(EXAMPLES / name), *args]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_collected_interactions_are_opened_and_trained_from(place: Path) -> None:
    printed = example(place, "collect.py", "objects", "store")
    assert "64 interactions" in printed
    assert "8 rollouts" in printed
    assert "a policy for 'push-faucet' with aap, aip, prior" in example(place, "retrain.py", "store", "run")
    assert (place / "run" / "aip" / "policy.json").is_file()


def test_a_scan_is_adapted_to(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """In this process, where all that it imports is there already; warnings are errors here, too."""
    points = np.random.default_rng(0).uniform([0.9, -0.3, -0.4], [0.92, 0.3, 0.4], (3000, 3))
    np.savez(place / "scan.npz", points=points)
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "argv", ["adapt.py", "scan.npz", "heatmap.npz"])
    runpy.run_path(str(EXAMPLES / "adapt.py"), run_name="__main__")
    assert "push at" in capsys.readouterr().out
    with np.load(place / "heatmap.npz") as found:
        assert found["affordance"].shape == (2048,)


@pytest.mark.slow
def test_a_store_is_looked_at_and_trained_from_by_a_network_of_ones_own(place: Path) -> None:
    make_store(place / "made")
    printed = example(place, "look.py", "made", "look.png")
    assert "8 rollouts" in printed
    assert "of 96 interactions moved something" in printed
    assert (place / "look.png").read_bytes().startswith(b"\x89PNG")
    assert "epoch 1: 6 batches" in example(place, "pytorch.py", "made", "net.pt")
    assert example(place, "pytorch.py", "made", "net.pt") == "goes on in epoch 1\n", "nothing is left"


@pytest.mark.slow
def test_a_program_carries_lines_between_a_session_and_a_robot_and_can_be_run_again(place: Path) -> None:
    *interactions, action = example(place, "robot.py", "robot").splitlines()
    assert 1 <= len(interactions) <= 2, "AIP may stop before its budget"
    assert all(line.startswith(f"interaction {k}: ") for k, line in enumerate(interactions, 1))
    assert action.startswith("the action that should succeed")
    assert example(place, "robot.py", "robot").splitlines() == [action]


@pytest.mark.slow
def test_an_object_is_written_and_collected_on(place: Path) -> None:
    printed = example(place, "own_object.py", "mine", "on-mine")
    assert printed.count("my-turnstile, bar: ") == 16
    assert "moved by 0.0" in printed


@pytest.mark.slow
def test_an_ablation_is_trained_and_a_policy_exported(place: Path) -> None:
    make_store(place / "small")
    printed = example(place, "ablation.py", "small", "ablation")
    assert "with augmentation: best" in printed
    assert "without augmentation: best" in printed
    printed = example(place, "export.py", "small", "ablation/without-augmentation", "exported")
    assert "96 interactions; the column `observation` counts the 24 clouds of 64 points" in printed
    assert "weights in" in printed


@pytest.mark.slow
def test_two_methods_are_compared(place: Path) -> None:
    printed = example(place, "evaluate.py", "objects", "2")
    assert "where2act: " in printed
    assert "ours-final: " in printed
    assert printed.count("rad") == 2


@pytest.mark.slow
def test_two_agents_act_through_gymnasium(place: Path) -> None:
    printed = example(place, "agents.py", "objects", "2")
    assert printed.count("of 4 succeed") == 2
    assert printed.count("interactions it moves by") == 2


@pytest.mark.slow
def test_an_affordance_is_drawn(place: Path) -> None:
    example(place, "heatmap.py", "objects", "heatmap.png")
    assert (place / "heatmap.png").read_bytes().startswith(b"\x89PNG")
    assert (place / "heatmap.ply").read_bytes().startswith(b"ply")
