"""What every camera must do, and that two of them see the same.

Where this machine has no Vulkan device, SAPIEN's camera is skipped. On Debian a software device that SAPIEN can use
comes with `apt-get install -t bookworm-backports mesa-vulkan-drivers libvulkan1` (Mesa 24.3 or newer); nothing else
needs it.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from collector.objects import procedural
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load, scan
from collector.sim.camera import Camera, DepthImage, EmbreeCamera
from collector.sim.environment import camera_for
from collector.sim.sapien_camera import SapienCamera, why_unavailable
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.types import Float
from tests.support.single_door import door, drawer

CONFIG = CameraConfig(image_size=256)
"""Software devices are slow."""
FRONT = camera_pose(180, 30, 5)
SILHOUETTE = 0.05
"""Depths of neighbouring pixels that differ by more are a jump."""
ALLOWED_DEPTH, ALLOWED_IDS = 1e-3, 0.995

needs_vulkan = pytest.mark.skipif(bool(why_unavailable()), reason=why_unavailable() or "available")
MakeCamera = Callable[[ArticulatedObject, Float, CameraConfig], Camera]
CAMERAS = [EmbreeCamera, pytest.param(SapienCamera, marks=needs_vulkan)]


@pytest.mark.parametrize("make", CAMERAS)
def test_what_is_seen_lies_on_its_pixels_ray(make: MakeCamera) -> None:
    image = make(door(), FRONT, CONFIG).capture(np.array([0.6]))
    seen = (image.points - FRONT[:3, 3]) @ FRONT[:3, :3]
    assert seen[:, 0] == pytest.approx(image.depths, abs=1e-5)
    rows, columns = np.divmod(image.pixels.astype(int), CONFIG.image_size)
    focal = CONFIG.image_size / 2 / np.tan(np.deg2rad(CONFIG.field_of_view_deg) / 2)
    assert CONFIG.image_size / 2 - focal * seen[:, 1] / seen[:, 0] == pytest.approx(columns + 0.5, abs=0.02)
    assert CONFIG.image_size / 2 - focal * seen[:, 2] / seen[:, 0] == pytest.approx(rows + 0.5, abs=0.02)
    assert np.all(np.diff(image.pixels.astype(int)) > 0)


@pytest.mark.parametrize("make", CAMERAS)
def test_normals_are_unit_and_face_the_camera(make: MakeCamera) -> None:
    image = make(door(), FRONT, CONFIG).capture(np.array([0.6]))
    assert np.linalg.norm(image.normals, axis=1) == pytest.approx(np.ones(len(image.normals)))
    assert ((image.points - FRONT[:3, 3]) * image.normals).sum(axis=1).max() < 0
    assert image.normals[image.bodies == 0][:, 2].max() > 0.99


@pytest.mark.parametrize("make", CAMERAS)
def test_a_part_moves_and_the_root_does_not(make: MakeCamera) -> None:
    camera = make(door(), FRONT, CONFIG)
    closed, opened = camera.capture(np.array([0.0])), camera.capture(np.array([1.2]))
    assert closed.points[closed.bodies == 1][:, 0].min() == pytest.approx(-0.32, abs=1e-4)
    assert opened.points[opened.bodies == 1][:, 0].min() < -0.7
    again = camera.capture(np.array([0.0]))
    assert np.array_equal(again.pixels, closed.pixels)
    assert np.array_equal(again.depths, closed.depths)


@pytest.mark.parametrize("make", CAMERAS)
def test_looking_away_sees_nothing(make: MakeCamera) -> None:
    away = FRONT.copy()
    away[:3, :2] *= -1
    assert len(make(drawer(), away, CONFIG).capture(np.zeros(1)).pixels) == 0


@needs_vulkan
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_both_see_the_same_of_generated_objects(tmp_path: Path) -> None:
    procedural.generate(tmp_path, dict.fromkeys(procedural.CATEGORIES, 1), seed=2)
    for entry in scan(tmp_path).usable:
        assert_agreement(load(entry))


@needs_vulkan
@pytest.mark.slow
@pytest.mark.real_objects
@pytest.mark.timeout(3600)
def test_both_see_the_same_of_real_objects(real_objects: Path) -> None:
    for entry in scan(real_objects).usable:
        assert_agreement(load(entry))


def test_the_setting_decides_which_camera_is_used() -> None:
    assert isinstance(camera_for(door(), FRONT, CONFIG), EmbreeCamera)
    wanted = CameraConfig(renderer="sapien")
    if why_unavailable():
        with pytest.raises(UsageError, match="or set it to 'embree'"):
            camera_for(door(), FRONT, wanted)
    else:
        assert isinstance(camera_for(door(), FRONT, wanted), SapienCamera)


def assert_agreement(target: ArticulatedObject) -> None:
    """Both cameras see the same depths within 1 mm off silhouettes, and the same parts on 99.5% of the pixels."""
    limits = target.limits()
    for azimuth, share in ((150.0, 0.0), (205.0, 0.6)):
        depth_off, same_ids = disagreement(target, camera_pose(azimuth, 40.0, 5.0), limits @ [1 - share, share])
        assert depth_off <= ALLOWED_DEPTH, f"{target.ref.id}: depths differ by {depth_off:.4f}"
        assert same_ids >= ALLOWED_IDS, f"{target.ref.id}: ids agree on {same_ids:.4f}"


def disagreement(target: ArticulatedObject, eye: Float, positions: Float) -> tuple[float, float]:
    """The greatest difference of depth off silhouettes, and the share of pixels where both see the same part."""
    depths, ids = zip(
        *(grid(make(target, eye, CONFIG).capture(positions)) for make in (EmbreeCamera, SapienCamera)), strict=True
    )
    inner = np.ones_like(ids[0], dtype=bool)
    for depth, part in zip(depths, ids, strict=True):
        inner &= maximum_filter(depth, 3) - minimum_filter(depth, 3) < SILHOUETTE
        inner &= maximum_filter(part, 3) == minimum_filter(part, 3)
    inner &= ids[0] >= 0
    seen = (ids[0] >= 0) | (ids[1] >= 0)
    assert inner.sum() > 0.2 * seen.sum(), "most pixels are silhouettes"
    return float(np.abs(depths[0] - depths[1])[inner].max()), float((ids[0] == ids[1])[seen].mean())


def grid(image: DepthImage) -> tuple[Float, Float]:
    """Depths and parts as images; nothing is 0 deep and part -1."""
    depth = np.zeros(CONFIG.image_size**2)
    part = np.full(CONFIG.image_size**2, -1.0)
    depth[image.pixels], part[image.pixels] = image.depths, image.bodies
    return depth.reshape(CONFIG.image_size, -1), part.reshape(CONFIG.image_size, -1)
