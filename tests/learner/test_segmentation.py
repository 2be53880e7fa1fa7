"""The training of the segmentation network from a folder of scenes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from adaafford.parts import read_segmenter
from cluster.cli.main import run as adaafford
from learner.settings import METRICS_FILE, SegmentationConfig
from learner.stages.segmentation import Scenes, train_segmentation
from shared.errors import UsageError
from shared.segmentation.inputs import EXTRA, POINTS
from shared.segmentation.scenes import SCENES_FILE, Scene, SceneObject, ScenesDocument, scene_path, write_scene


def fabricated(seed: int) -> Scene:
    """A door at y > 0 beside a body."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (POINTS, 3)).astype(np.float32)
    door = points[:, 1] > 0
    centres = np.where(door[:, None], [[0.0, 0.5, 0.0]], 0.0).astype(np.float32)
    return Scene(points, np.zeros((POINTS, EXTRA), np.float32), np.where(door, 2, 1), centres)


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "scenes"
    folder.mkdir()
    objects = tuple(SceneObject(id=f"object-{number}", category="Box") for number in range(3))
    document = ScenesDocument(seed=1, noise=(0.0, 1.0), count=3, objects=objects)
    (folder / SCENES_FILE).write_text(document.model_dump_json())
    for number in range(3):
        write_scene(scene_path(folder, number), fabricated(number))
    return folder


@pytest.mark.slow
def test_a_training_lowers_the_loss_and_leaves_a_network(scenes: Path, tmp_path: Path) -> None:
    config = SegmentationConfig(steps=6, validate_every=3, batch_scenes=2)
    _, result = train_segmentation([scenes], tmp_path / "out", config, 0)
    lines = [json.loads(line) for line in (tmp_path / "out" / METRICS_FILE).read_text().splitlines()]
    assert [line["step"] for line in lines] == [3, 6] and result.steps == 6
    assert lines[1]["score"] < lines[0]["score"]
    assert read_segmenter(tmp_path / "out").to_files().keys() == {"weights.safetensors", "segmentation.json"}
    _, again = train_segmentation([scenes], tmp_path / "out", config, 0)
    assert again.steps == 6 and again.metrics == result.metrics
    with pytest.raises(UsageError, match="another"):
        train_segmentation([scenes], tmp_path / "out", config, 1)


def test_a_network_is_trained_on_from_another_and_blended_with_it(scenes: Path, tmp_path: Path) -> None:
    told = ["train", "segmentation", "--scenes", str(scenes), str(scenes), "--steps", "1", "--out"]
    again = ["--init", str(tmp_path / "start"), "--learning-rate", "0.5"]
    assert adaafford([*told, str(tmp_path / "start"), "--seed", "3"]) == 0
    assert adaafford([*told, str(tmp_path / "whole"), *again]) == 0
    assert adaafford([*told, str(tmp_path / "part"), *again, "--blend", "0.25"]) == 0
    start, whole, part = (
        read_segmenter(tmp_path / name).network.state_dict()["output.weight"] for name in ("start", "whole", "part")
    )
    assert not torch.allclose(start, whole, atol=0.01)
    assert torch.allclose(part, 0.75 * start + 0.25 * whole, atol=0.001)


def test_a_mirrored_scene_has_mirrored_labels() -> None:
    scenes = Scenes.of([fabricated(1)])
    mirrored = scenes.mirrored(torch.tensor([True]))
    assert torch.equal(mirrored.clouds.points[..., 1], -scenes.clouds.points[..., 1])
    assert torch.equal(mirrored.centres[..., 1], -scenes.centres[..., 1])
    assert torch.equal(mirrored.kinds, scenes.kinds)


def test_what_cannot_be_learnt_from_is_refused(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert adaafford(["train", "segmentation", "--scenes", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "make scenes by `adaafford objects scenes`" in capsys.readouterr().err
    assert adaafford(["train", "segmentation", "--scenes", str(scenes), "--out", str(scenes)]) == 2
    assert f"{scenes}: holds '{scene_path(scenes, 0).name}' and no training" in capsys.readouterr().err
    scene_path(scenes, 1).write_bytes(b"damaged")
    assert adaafford(["train", "segmentation", "--scenes", str(scenes), "--out", str(tmp_path / "out")]) == 2
    assert "damaged or foreign" in capsys.readouterr().err
