"""Benchmarks of learning and adapting: the yardstick is what it claims, and taking a step apart changes nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import adapting, learning, straightforward
from benchmarks.adapting import SIZES, AdaptSettings, resized
from benchmarks.learning import PARTS, LearningSettings, StepApart
from benchmarks.script import run_script
from benchmarks.straightforward import PublishedEncoder, PublishedStep, ball_neighbours, furthest_points
from cluster.cli.benchmarks.learning import NETWORKS as CRITICS
from cluster.cli.benchmarks.learning import stages_of
from cluster.cli.main import run
from learner import settings
from learner.data.dataset import load_dataset
from learner.data.sampling import split
from learner.settings import AapConfig, AipConfig, LearnerConfig, PriorConfig
from shared.networks.network_config import NETWORKS
from shared.networks.pointnet2 import PointNet2
from shared.store.store import Store
from tests.support.small_networks import TINY
from tests.support.small_trainings import make_store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return make_store(tmp_path_factory.mktemp("bench") / "store")


@pytest.mark.parametrize(
    "config",
    [
        LearnerConfig(network=TINY),
        LearnerConfig(network=TINY, aap=AapConfig(training="paper"), aip=AipConfig(training="paper")),
    ],
)
def test_a_step_taken_apart_sends_the_same_gradients(store: Store, config: LearnerConfig) -> None:
    dataset = load_dataset(store, TINY)
    for _, stage, _ in stages_of(dataset, split(dataset, None, None), config):
        torch.stack(list(stage.loss(np.random.default_rng(3)).losses.values())).sum().backward()
        whole = {name: p.grad for name, p in stage.module.named_parameters() if p.grad is not None}
        stage.module.zero_grad(set_to_none=True)
        apart = StepApart(stage)
        for group in apart.optimiser.param_groups:
            group["lr"] = 0.0
        apart.take(np.random.default_rng(3))
        assert "forward" not in getattr(stage.module, "aap", stage.module).encoder.__dict__
        found = {name: p.grad for name, p in stage.module.named_parameters() if p.grad is not None}
        assert found.keys() == whole.keys()
        for name, gradient in whole.items():
            torch.testing.assert_close(found[name], gradient)
        assert all(seconds >= 0 for seconds in apart.seconds.values())
        assert apart.seconds["sample"] > 0 < apart.seconds["heads"]


def test_furthest_points_cover_the_cloud_and_a_ball_holds_what_is_near() -> None:
    points = torch.from_numpy(np.random.default_rng(0).random((2, 300, 3), dtype=np.float32))
    chosen = furthest_points(points, 60)
    assert all(len(set(row)) == 60 for row in chosen.tolist())
    centres = torch.stack([cloud[row] for cloud, row in zip(points, chosen, strict=True)])
    reach = torch.cdist(points, centres).amin(dim=2).amax(dim=1)
    apart = torch.cdist(centres, centres) + 10 * torch.eye(60)
    assert (apart.amin(dim=(1, 2)) >= reach - 1e-6).all()
    found = ball_neighbours(points, centres, 0.2, 8)
    for cloud, around, rows in zip(points, centres, found, strict=True):
        distances = (cloud[rows] - around[:, None]).norm(dim=-1)
        assert distances.max() <= 0.2 + 1e-5


@pytest.mark.slow
def test_the_port_has_the_published_network_and_learns() -> None:
    config = NETWORKS["published"]
    ours = sum(p.numel() for name, p in PointNet2(config).named_parameters() if "from_feature" not in name)
    port = PublishedEncoder(config)
    # Ours also tells the first level each neighbour's own place, and keeps a bias before its normalisation.
    assert sum(p.numel() for p in port.parameters()) == pytest.approx(ours, rel=0.2)
    rng = np.random.default_rng(0)
    clouds = torch.from_numpy(rng.random((2, 1100, 3), dtype=np.float32))
    frames = torch.from_numpy(rng.random((2, 6), dtype=np.float32))
    batch = clouds, torch.tensor([3, 4]), frames, torch.tensor([0.0, 0.3]), torch.tensor([0.0, 1.0])
    step = PublishedStep(0)
    for group in step.optimiser.param_groups:
        group["lr"] = 1e-3
    losses = [step(*batch) for _ in range(5)]
    assert losses[-1] < losses[0]


@pytest.mark.slow
def test_the_benches_end_in_one_object(
    store: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(learning, "POINTS", 1100)
    monkeypatch.setattr(straightforward, "POINTS", 1100)
    small = LearnerConfig(network=TINY, prior=PriorConfig(proposals=4))
    for module in (learning, settings):
        monkeypatch.setattr(module, "LearnerConfig", lambda **settings: small.model_copy(update=settings))
    told = ["--store", str(store.path), "--repeats", "1", "--json", "--out", str(tmp_path)]
    assert run(["bench", "learner", *told, "--steps", "2", "--batch-rollouts", "3"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert all(found[f"{name.replace('-', '_')}_interactions_per_second"] > 0 for name in CRITICS)
    assert found["batch_rollouts"] == 3
    steps = ["--steps", "2", "--port-interactions", "2"]
    assert run_script("learning", LearningSettings, learning.measure, [*told, *steps]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["aap_interactions_per_second"] > 0
    assert found["times_straightforward_port"] > 0
    assert {tuple(parts) for parts in found["step_seconds"].values()} == {PARTS}
    assert run_script("adapting", AdaptSettings, adapting.measure, told) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(found["milliseconds"]) == [str(size) for size in SIZES]
    assert found["step_ms"] > 0
    assert len(list(tmp_path.glob("*.json"))) == 3


def test_a_resized_observation_keeps_its_first_points(store: Store) -> None:
    observation = store.read_rollouts(store.committed()[0].shard_id)[0].observations[0]
    there = len(observation.points)
    for size in (there // 2, there, 3 * there):
        other = resized(observation, size)
        assert {len(getattr(other, name)) for name in ("points", "normals", "part_ids", "movable", "pixels")} == {size}
        np.testing.assert_array_equal(other.points[: min(size, there)], observation.points[:size])
