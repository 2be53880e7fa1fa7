"""Raw scans: all that a depth camera measures of an object among its surroundings, with what each point is of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject, Body
from collector.sim.camera import SURROUNDINGS, DepthImage, EmbreeCamera
from collector.sim.depth_noise import noisy
from collector.sim.environment import draw_state
from collector.sim.surroundings import draw_surroundings, extent
from shared.config import CameraConfig
from shared.geometry import camera_pose
from shared.segmentation.scenes import Kind
from shared.types import Float


@dataclass(frozen=True, slots=True)
class RawScan:
    """What a depth camera measured.

    Attributes:
        image: with errors, world frame.
        kinds: [H], the `Kind` of each pixel.
        centres: [bodies, 3], the middle of the box that holds each body, world; 0 0 0 where nothing of it is visible.
        world_from_camera: [4, 4].
    """

    image: DepthImage
    kinds: NDArray[np.uint8]
    centres: Float
    world_from_camera: Float


def raw_scan(
    target: ArticulatedObject,
    state: Float,
    world_from_camera: Float,
    surroundings: Body,
    noise: float,
    rng: np.random.Generator,
) -> RawScan:
    """Scan an object.

    Args:
        target: the object.
        state: joint positions, [parts].
        world_from_camera: [4, 4].
        surroundings: what stands around it.
        noise: strength of the errors (see `collector.sim.depth_noise`).
        rng: draws the errors.
    """
    config = CameraConfig()
    camera = EmbreeCamera(target, world_from_camera, config, surroundings=surroundings)
    image = noisy(camera.capture(state), config.image_size, world_from_camera[:3, 3], noise, rng)
    kind_of = np.full(SURROUNDINGS + 1, Kind.BODY, dtype=np.uint8)
    kind_of[SURROUNDINGS] = Kind.BACKGROUND
    for number, part in enumerate(target.summaries(), start=1):
        kind_of[number] = Kind.TURNING if part.kind == "revolute" else Kind.SLIDING
    boxes = target.visible_boxes(state)
    return RawScan(image, kind_of[image.bodies], np.nan_to_num(boxes.mean(axis=1)), world_from_camera)


def random_scan(target: ArticulatedObject, noise: tuple[float, float], rng: np.random.Generator) -> RawScan:
    """A scan of an object in a random state, among random surroundings, from a random place in front of it.

    Args:
        target: the object.
        noise: between which strengths that of the errors is drawn.
        rng: draws everything.
    """
    config = CameraConfig()
    state = draw_state(target.limits(), False, rng)
    azimuth, elevation = (rng.uniform(r.low, r.high) for r in (config.azimuth_deg, config.elevation_deg))
    pose = camera_pose(azimuth, elevation, config.distance)
    surroundings = draw_surroundings(*extent(target, state[None]), pose[:3, 3], rng)
    return raw_scan(target, state, pose, surroundings, rng.uniform(*noise), rng)
