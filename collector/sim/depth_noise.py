"""The errors of a real depth camera, added to a rendered image.

The noise along the rays is that which Nguyen et al. (3DIMPVT 2012, "Modeling Kinect sensor noise for improved 3D
reconstruction and tracking") measured at one metre: 1.9 mm, and more where the surface is seen at a slant. Such a
camera also measures nothing where rays graze a surface, and beside an edge it mixes two depths, or measures neither.
"""

from dataclasses import replace

import numpy as np

from collector.sim.camera import DepthImage
from shared.types import Float

LEVEL_M = 0.0019
SLANT_M = 0.0001
"""Standard deviation: LEVEL_M + SLANT_M a^2 / (pi/2 - a)^2 at an angle of incidence a, at a distance of one metre."""
MOST_SLANT_RAD = np.deg2rad(80.0)
GRAZING_RAD = np.deg2rad(75.0)
"""From here to a right angle, the share of rays that measure nothing grows from none to all."""
EDGE_M = 0.03
"""Neighbouring pixels whose depths differ by more are on two sides of an edge."""
EDGE_SHARE = 0.25
"""Of pixels beside an edge: so many measure nothing, and so many others a depth between the two."""


def noisy(image: DepthImage, image_size: int, camera: Float, strength: float, rng: np.random.Generator) -> DepthImage:
    """An image as a real depth camera might have taken it.

    Args:
        image: as it was rendered.
        image_size: width and height, pixels.
        camera: [3], where it stood, world.
        strength: factor of all errors; 0: none, 1: a structured-light camera at one metre.
        rng: draws the errors.

    Returns:
        The pixels that were measured. Normals remain those of the true surface.
    """
    if strength == 0 or len(image.pixels) == 0:
        return image
    rays = (image.points - camera) / image.depths[:, None]
    cosine = -(rays * image.normals).sum(axis=1) / np.linalg.norm(rays, axis=1)
    angle = np.arccos(np.clip(cosine, 0.0, 1.0))
    slant = np.minimum(angle, MOST_SLANT_RAD)
    deviation = strength * (LEVEL_M + SLANT_M * slant**2 / (np.pi / 2 - slant) ** 2)
    beyond, beside = _across_edges(image, image_size)
    drawn = rng.random(len(angle))
    share = min(EDGE_SHARE * strength, 0.5)
    lost = beside & (drawn < share)
    lost |= rng.random(len(angle)) < strength * (angle - GRAZING_RAD) / (np.pi / 2 - GRAZING_RAD)
    mixed = beside & (drawn >= share) & (drawn < 2 * share)
    depths = image.depths + np.where(mixed, rng.random(len(angle)) * (beyond - image.depths), 0.0)
    depths = np.maximum(depths + deviation * rng.standard_normal(len(angle)), 1e-3)[~lost]
    return replace(
        image,
        pixels=image.pixels[~lost],
        depths=depths,
        points=camera + rays[~lost] * depths[:, None],
        normals=image.normals[~lost],
        bodies=image.bodies[~lost],
    )


def _across_edges(image: DepthImage, size: int) -> tuple[Float, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Of each pixel the depth of the neighbour that differs the most, [H], and whether that is across an edge, [H]."""
    padded = np.full((size + 2, size + 2), np.nan)
    rows, columns = np.divmod(image.pixels.astype(np.int64), size)
    padded[rows + 1, columns + 1] = image.depths
    near = np.stack([padded[rows + 1 + dy, columns + 1 + dx] for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))])
    apart = np.nan_to_num(np.abs(near - image.depths), nan=-1.0)
    chosen = apart.argmax(axis=0)
    most = np.take_along_axis(apart, chosen[None], axis=0)[0]
    beyond = np.where(most >= 0, np.take_along_axis(near, chosen[None], axis=0)[0], image.depths)
    # Beside the silhouette there is nothing to mix with, but a ray may be lost.
    return beyond, (most > EDGE_M) | np.isnan(near).any(axis=0)
