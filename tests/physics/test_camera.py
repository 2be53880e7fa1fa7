"""What the camera sees of objects whose right answers are known by hand."""

from dataclasses import replace

import numpy as np
import pytest

from collector.sim.camera import DepthImage, EmbreeCamera, observation_from
from shared.config import CameraConfig
from shared.geometry import camera_pose
from shared.types import round_normals, round_points
from tests.support.single_door import door, drawer

CONFIG = CameraConfig(points=512, candidates=4000)
FRONT = camera_pose(180, 30, 5)


def look(positions: float = 0.0) -> DepthImage:
    return EmbreeCamera(door(), FRONT, CONFIG).capture(np.array([positions]))


def test_every_point_lies_on_the_object_and_on_its_pixels_ray() -> None:
    image = look()
    slab = image.points[(image.bodies == 1) & (image.normals[:, 0] < -0.99)]
    assert len(slab) > 1000
    assert slab[:, 0] == pytest.approx(-0.32, abs=1e-5)
    assert np.abs(slab[:, 1:]).max() <= 0.3 + 1e-5
    seen = (image.points - FRONT[:3, 3]) @ FRONT[:3, :3]
    assert seen[:, 0] == pytest.approx(image.depths, rel=1e-6)
    rows, columns = np.divmod(image.pixels.astype(int), CONFIG.image_size)
    focal = CONFIG.image_size / 2 / np.tan(np.deg2rad(17.5))
    assert CONFIG.image_size / 2 - focal * seen[:, 1] / seen[:, 0] == pytest.approx(columns + 0.5, abs=1e-3)
    assert CONFIG.image_size / 2 - focal * seen[:, 2] / seen[:, 0] == pytest.approx(rows + 0.5, abs=1e-3)


def test_normals_are_unit_and_face_the_camera() -> None:
    image = look(0.6)
    assert np.linalg.norm(image.normals, axis=1) == pytest.approx(np.ones(len(image.normals)))
    assert ((image.points - FRONT[:3, 3]) * image.normals).sum(axis=1).max() < 0


def test_an_opened_door_moves_and_the_body_does_not() -> None:
    closed, opened = look(0.0), look(1.2)
    assert closed.points[closed.bodies == 1][:, 0].min() == pytest.approx(-0.32, abs=1e-4)
    assert opened.points[opened.bodies == 1][:, 0].min() < -0.7
    carcass = [image.points[image.bodies == 0] for image in (closed, opened)]
    assert carcass[0][:, 2].max() == pytest.approx(carcass[1][:, 2].max(), abs=5e-3)


def test_a_cloud_keeps_points_that_the_store_can_express_in_furthest_point_order() -> None:
    cloud = observation_from(look(), FRONT, (1,), CONFIG, np.random.default_rng(0))
    assert cloud is not None
    assert cloud.points.shape == (512, 3)
    assert np.array_equal(round_points(cloud.points), cloud.points)
    assert np.array_equal(round_normals(cloud.normals), cloud.normals)
    assert np.array_equal(cloud.movable, cloud.part_ids == 1)
    # Any prefix covers the object: the gaps shrink, and no point is far from the first few.
    covering = [
        np.linalg.norm(cloud.points[:, None] - cloud.points[None, :n], axis=2).min(axis=1).max() for n in (8, 64)
    ]
    assert covering[1] < covering[0] < 0.6
    nearest = np.linalg.norm(cloud.points[:64, None] - cloud.points[None, :64], axis=2) + 9 * np.eye(64)
    assert nearest.min() > 0.5 * covering[1]


def test_parts_that_do_not_qualify_are_not_movable() -> None:
    cloud = observation_from(look(), FRONT, (), CONFIG, np.random.default_rng(0))
    assert cloud is not None
    assert not cloud.movable.any()


def test_an_object_of_few_pixels_still_fills_the_cloud() -> None:
    far = camera_pose(180, 30, 60)
    image = EmbreeCamera(door(), far, CONFIG).capture(np.zeros(1))
    assert 0 < len(image.pixels) < CONFIG.points
    cloud = observation_from(image, far, (1,), CONFIG, np.random.default_rng(0))
    assert cloud is not None
    assert set(cloud.pixels) == set(image.pixels)


def test_looking_away_sees_nothing() -> None:
    away = camera_pose(180, 30, 5)
    away[:3, :2] *= -1
    image = EmbreeCamera(drawer(), away, CONFIG).capture(np.zeros(1))
    assert len(image.pixels) == 0
    assert observation_from(image, away, (1,), CONFIG, np.random.default_rng(0)) is None


def test_a_process_sees_thousands_of_bodies_at_once() -> None:
    target = door()
    cameras = [EmbreeCamera(replace(target), FRONT, CONFIG) for _ in range(1200)]
    for camera in (cameras[0], cameras[-1]):
        assert len(camera.capture(np.zeros(1)).pixels) == len(look().pixels)
