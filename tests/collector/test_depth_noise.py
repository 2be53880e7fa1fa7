"""Collection with the errors of a depth camera: they are of the camera's model, and change nothing but what is seen."""

from pathlib import Path

import numpy as np
import pytest

from collector.objects.catalogue import for_task, load_ref, scan
from collector.objects.procedural import generate
from collector.rollout import begin
from collector.sim.camera import LEVEL_M
from collector.sim.environment import SapienEnvironment
from collector.sim.simulator import StageClock
from shared.config import CameraConfig, CollectionConfig, parse
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.plan import Plan, Setting
from shared.tasks import task_named
from shared.types import HiddenDynamics, Observation
from tests.support.single_door import door

FRONT = camera_pose(180, 20, 5)
EASY = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=1.0)


def environment_with(noise: float, keep_depth: bool = False) -> SapienEnvironment:
    collection = CollectionConfig(camera=CameraConfig(noise=noise, keep_depth=keep_depth))
    rng = np.random.default_rng(5)
    return SapienEnvironment(door(), task_named("push"), collection, EASY, FRONT, rng, StageClock())


def seen_at(environment: SapienEnvironment, position: float) -> Observation:
    environment.restore(np.array([position]))
    return environment.observe()


def test_a_camera_without_errors_is_written_as_before_there_were_any() -> None:
    assert "noise" not in str(CollectionConfig().as_document())
    assert CollectionConfig(camera=CameraConfig(noise=1.0)).as_document()["camera"]["noise"] == 1.0
    assert np.random.default_rng(5).integers(1 << 62) == environment_with(0.0)._rng.integers(1 << 62)


def test_a_cloud_has_the_errors_of_the_camera_and_estimated_normals() -> None:
    slab_x = -0.32
    clean, noisy = (seen_at(environment_with(noise), 0.0) for noise in (0.0, 1.0))
    away = (clean.points[0] - FRONT[:3, 3]) / np.linalg.norm(clean.points[0] - FRONT[:3, 3])
    middles = []
    for seen in (clean, noisy):
        front = (np.abs(seen.points[:, 0] - slab_x) < 0.02) & (np.abs(seen.points[:, 1:]) < 0.25).all(axis=1)
        error = (seen.points[front, 0] - slab_x) / away[0]
        middles.append(np.subtract(*np.quantile(error, [0.75, 0.25])) / 1.349)
        towards = seen.normals[front] @ np.array([-1.0, 0.0, 0.0])
        assert np.median(towards) > (0.999 if seen is clean else 0.9)
    # Points are kept to a quarter of a millimetre.
    assert middles[0] < 3e-4
    assert 0.8 * LEVEL_M < middles[1] < 1.4 * LEVEL_M
    lengths = np.linalg.norm(noisy.normals, axis=1)
    assert np.abs(lengths - 1).max() < 0.02
    assert ((FRONT[:3, 3] - noisy.points) * noisy.normals).sum(axis=1).min() > -0.05


def test_a_kept_depth_image_is_that_of_the_cloud() -> None:
    seen = seen_at(environment_with(1.0, keep_depth=True), 0.0)
    assert seen.dense is not None
    dense = seen.dense.points()
    nearest = np.linalg.norm(dense[:, None] - seen.points[None, ::64], axis=2).min(axis=0)
    assert nearest.max() < 2e-3
    clean = seen_at(environment_with(0.0, keep_depth=True), 0.0)
    assert clean.dense is not None
    assert len(dense) < len(clean.dense.points())


def test_a_state_that_is_seen_again_gives_the_same_cloud_and_another_state_other_errors() -> None:
    environment, again = environment_with(1.0), environment_with(1.0)
    first, other = seen_at(environment, 0.0), seen_at(environment, 0.5)
    assert seen_at(environment, 0.0) is first
    for position, seen in ((0.0, first), (0.5, other)):
        assert seen_at(again, position).points.tobytes() == seen.points.tobytes()


def test_errors_shift_no_other_draw_of_a_rollout(tmp_path: Path) -> None:
    generate(tmp_path, {"StorageFurniture": 1}, seed=5)
    refs = tuple(entry.ref for entry in for_task(scan(tmp_path), task_named("push")).usable)
    states = []
    for noise in (0.0, 1.0):
        camera = CameraConfig(image_size=128, points=256, candidates=1000, noise=noise)
        setting = Setting(task="push", seed=3, objects=refs, collection=CollectionConfig(camera=camera))
        start = begin(Plan(setting=setting), 1, load_ref(tmp_path, refs[0]), StageClock())
        assert not isinstance(start, str)
        states.append((start.draw, start.environment.state().tobytes(), start.states.random()))
    assert states[0] == states[1]


def test_more_than_ten_times_the_errors_of_a_camera_are_refused() -> None:
    with pytest.raises(UsageError, match=r"setting 'noise'.*less than or equal to 10"):
        parse(CameraConfig, {"noise": 11}, "collection.camera")
