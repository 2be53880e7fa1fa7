"""What tells generated objects from real ones: nothing if they are alike, and much if they are not."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import likeness
from benchmarks.likeness import nearest_ratio, told_apart
from benchmarks.script import run_script
from collector.objects import procedural

OBJECTS = np.repeat(np.arange(30), 16)


def drawn(seed: int, shift: float) -> np.ndarray:
    return (np.random.default_rng(seed).normal(size=(len(OBJECTS), 5)) + shift).astype(np.float32)


def test_profiles_of_one_kind_cannot_be_told_apart_and_others_can(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(likeness, "STEPS", 60)
    real = drawn(0, 0.0)
    assert told_apart(real, OBJECTS, drawn(1, 0.0), OBJECTS, seed=0) == pytest.approx(0.5, abs=0.08)
    assert told_apart(real, OBJECTS, drawn(1, 2.0), OBJECTS, seed=0) > 0.95
    assert nearest_ratio(real, OBJECTS, drawn(1, 0.0)) == pytest.approx(1.0, abs=0.1)
    assert nearest_ratio(real, OBJECTS, drawn(1, 2.0)) > 1.5


@pytest.mark.slow
def test_the_benchmark_compares_two_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(likeness, "STEPS", 60)
    for name, seed in (("real", 1), ("made", 2)):
        procedural.generate(tmp_path / name, {"Faucet": 5}, seed)

    def run(*flags: str) -> int:
        return run_script("likeness", likeness.LikenessSettings, likeness.measure, list(flags))

    assert run("--objects", str(tmp_path / "real")) == 2
    assert "name both folders" in capsys.readouterr().err.splitlines()[-1]
    folders = "--objects", str(tmp_path / "real"), "--generated", str(tmp_path / "made")
    assert run(*folders, "--task", "push-faucet", "--views", "10", "--actions", "4", "--json") == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["real_objects"] == found["generated_objects"] == 5
    assert 0 <= found["classifier_auc"] <= 1
