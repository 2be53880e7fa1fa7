"""The example scripts run as their first lines say."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from collector.objects.procedural import generate

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


def test_a_scan_is_adapted_to(place: Path) -> None:
    points = np.random.default_rng(0).uniform([0.9, -0.3, -0.4], [0.92, 0.3, 0.4], (3000, 3))
    np.savez(place / "scan.npz", points=points)
    printed = example(place, "adapt.py", "scan.npz", "heatmap.npz")
    assert "push at" in printed
    with np.load(place / "heatmap.npz") as found:
        assert found["affordance"].shape == (2048,)


@pytest.mark.slow
def test_two_methods_are_compared(place: Path) -> None:
    printed = example(place, "evaluate.py", "objects", "2")
    assert "where2act: " in printed
    assert "ours-final: " in printed
    assert printed.count("rad") == 2


@pytest.mark.slow
def test_an_affordance_is_drawn(place: Path) -> None:
    example(place, "heatmap.py", "objects", "heatmap.png")
    assert (place / "heatmap.png").read_bytes().startswith(b"\x89PNG")
    assert (place / "heatmap.ply").read_bytes().startswith(b"ply")
