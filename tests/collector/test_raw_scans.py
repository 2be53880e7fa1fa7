"""Raw scans: objects among other things, and the scenes that the segmentation network learns from."""

from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run as adaafford
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load, scan
from collector.objects.procedural.catalogue import generate
from collector.scenes import draw_surroundings, extent, make_scenes, random_scan, raw_scan
from collector.sim.camera import SURROUNDINGS, EmbreeCamera
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.seeds import generator
from shared.segmentation.inputs import POINTS, floor_and_walls, network_input
from shared.segmentation.scenes import MOVABLE, Kind, read_scene, scene_path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("objects")
    generate(made, {"StorageFurniture": 1, "Faucet": 1}, 1)
    return made


@pytest.fixture(scope="module")
def cabinet(folder: Path) -> ArticulatedObject:
    return next(load(entry) for entry in scan(folder).usable if entry.ref.category == "StorageFurniture")


def test_surroundings_stand_beside_the_object_and_hide_it(cabinet: ArticulatedObject) -> None:
    pose, state = camera_pose(200.0, 40.0, 5.0), cabinet.limits()[:, 0]
    alone = EmbreeCamera(cabinet, pose, CameraConfig()).capture(state)
    low, high = extent(cabinet, state[None])
    for seed in range(4):
        around = draw_surroundings(low, high, pose[:3, 3], generator(seed, "test"))
        for mesh in around.visuals:
            least, most = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            assert ((most <= low + 1e-9) | (least >= high - 1e-9)).any(), "beside it, in front of it or under it"
        seen = raw_scan(cabinet, state, pose, around, 0.0, generator(seed, "noise"))
        of_object = seen.image.bodies != SURROUNDINGS
        assert set(seen.image.pixels[of_object]) <= set(alone.pixels)
        assert (seen.kinds[~of_object] == Kind.BACKGROUND).all() and (seen.kinds[of_object] != Kind.BACKGROUND).all()
        assert np.isin(seen.kinds, MOVABLE).any()


@pytest.mark.slow
def test_floor_and_walls_go_and_the_object_stays(cabinet: ArticulatedObject) -> None:
    for seed in range(3):
        seen = random_scan(cabinet, (1.0, 1.0), generator(seed, "test"))
        camera = seen.world_from_camera[:3, 3]
        gone, floor = floor_and_walls(seen.image.points, camera, generator(seed, "planes"))
        of_object = seen.kinds != Kind.BACKGROUND
        assert (gone & of_object).sum() < 0.05 * of_object.sum()
        assert (gone & ~of_object).sum() > 0.7 * (~of_object).sum()
        low, _ = extent(cabinet, cabinet.limits()[:, 0][None])
        assert floor == pytest.approx(low[2], abs=0.02)


def test_an_object_without_floor_loses_nothing(cabinet: ArticulatedObject) -> None:
    pose = camera_pose(200.0, 40.0, 5.0)
    alone = EmbreeCamera(cabinet, pose, CameraConfig()).capture(cabinet.limits()[:, 0])
    gone, _ = floor_and_walls(alone.points, pose[:3, 3], generator(1, "planes"))
    assert not gone.any()


@pytest.mark.slow
def test_the_input_of_the_network_does_not_depend_on_where_the_scan_lies(cabinet: ArticulatedObject) -> None:
    seen = random_scan(cabinet, (0.5, 0.5), generator(1, "test"))
    points, camera = seen.image.points, seen.world_from_camera[:3, 3]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one, _ = network_input(points, camera)
    other, _ = network_input(points @ turn.T + 3.0, camera @ turn.T + 3.0)
    assert one.points.shape == (POINTS, 3)
    np.testing.assert_allclose(one.points, other.points, atol=1e-4)


def test_only_floor_is_refused() -> None:
    rng = np.random.default_rng(1)
    floor = np.concatenate([rng.uniform(-2, 2, (5000, 2)), np.zeros((5000, 1))], axis=1)
    with pytest.raises(UsageError, match="points beside floor and walls"):
        network_input(floor, np.array([-3.0, 0.0, 2.0]))


@pytest.mark.slow
def test_scenes_are_made_once_and_go_on(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scenes"
    assert adaafford(["objects", "scenes", str(folder), str(out), "--count", "2"]) == 0
    assert "2 scenes of 2 objects" in capsys.readouterr().out
    whole = scene_path(out, 1).read_bytes()
    scene_path(out, 1).unlink()
    make_scenes(folder, out, 2, 1, (0.3, 1.5), lambda done: None)
    assert scene_path(out, 1).read_bytes() == whole
    scene = read_scene(scene_path(out, 0))
    assert scene.points.shape == (POINTS, 3) and set(np.unique(scene.kinds)) <= set(Kind)
    with pytest.raises(UsageError, match="other settings"):
        make_scenes(folder, out, 2, 2, (0.3, 1.5), lambda done: None)
    assert adaafford(["objects", "scenes", str(folder), str(out), "--noise", "2", "1"]) == 2
    assert "least strength first" in capsys.readouterr().err
