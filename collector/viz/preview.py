"""Contact sheets: many objects in one picture, each movable part in another colour."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject
from collector.sim.camera import DepthImage, EmbreeCamera
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.io.files import write_atomically, writing
from shared.types import Float

BODY_COLOUR = (0.62, 0.62, 0.62)
PALM_COLOUR, FINGER_COLOUR = (0.2, 0.2, 0.25), (1.0, 0.8, 0.0)
AMBIENT = 0.5
"""Share of a colour that shows where no light falls."""
AZIMUTH_DEG = 205.0
"""Of the camera; objects face 180."""
LIGHT_FROM = (-0.6, 0.45, 0.66)
"""Unit direction towards the light, world."""


def contact_sheet(
    objects: Sequence[ArticulatedObject], out_png: Path, image_size: int = 240, titles: Sequence[str] = ()
) -> None:
    """Write a grid of pictures, id and category below each: the body grey, every movable part coloured.

    Args:
        objects: in reading order.
        out_png: file to write.
        image_size: pixels along an edge of one picture.
        titles: what is below each picture instead.

    Raises:
        UsageError: there is nothing to show, or the file cannot be written.
    """
    if not objects:
        raise UsageError("there is no usable object to preview")
    columns = int(np.ceil(np.sqrt(1.4 * len(objects))))
    rows = int(np.ceil(len(objects) / columns))
    figure = Figure(figsize=(columns * 2.4, rows * 2.7), dpi=image_size / 2.4)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    texts = titles or [f"{target.ref.id}\n{target.ref.category}" for target in objects]
    for axes, target, text in zip(grid, objects, texts, strict=False):
        axes.imshow(picture(target, image_size))
        axes.set_title(text, fontsize=7, y=-0.12)
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.04, top=1.0, wspace=0.02, hspace=0.16)
    save(figure, out_png)


def save(figure: Figure, out_png: Path) -> None:
    """Write a figure as a PNG file; a missing folder is created.

    Raises:
        UsageError: the file cannot be written.
    """
    image = BytesIO()
    figure.savefig(image, format="png")
    with writing(out_png, "name a .png file that can"):
        out_png.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out_png, image.getvalue())


def picture(target: ArticulatedObject, size: int) -> Float:
    """One object, every joint half open, [size, size, 3], colours in [0, 1], on white."""
    config = CameraConfig(image_size=size)
    camera = EmbreeCamera(target, camera_pose(AZIMUTH_DEG, 30.0, config.distance), config)
    return shaded(camera.capture(target.limits().mean(axis=1)), part_colours(len(target.parts)), size)


def shaded(image: DepthImage, colours: Float, size: int) -> Float:
    """A picture, [size, size, 3], in [0, 1], of what a camera saw, on white; `colours`, [bodies, 3], of each body."""
    light = AMBIENT + (1 - AMBIENT) * np.clip(image.normals @ np.array(LIGHT_FROM), 0.0, 1.0)
    picture = np.ones((size * size, 3))
    picture[image.pixels] = colours[image.bodies] * light[:, None]
    return picture.reshape(size, size, 3)


def part_colours(parts: int) -> Float:
    """[1 + parts, 3]: the body's grey, then a colour a part; they repeat after nine."""
    palette: NDArray[np.float64] = matplotlib.colormaps["tab10"](np.arange(10))[:, :3]
    # The palette's own grey would be taken for the body.
    palette = np.delete(palette, 7, axis=0)
    return np.concatenate([[BODY_COLOUR], palette[np.arange(parts) % len(palette)]])


def body_colours(parts: int, links: int) -> Float:
    """[1 + parts + links, 3]: `part_colours`, then those of the links of a hand, the palm first."""
    return np.concatenate([part_colours(parts), [PALM_COLOUR, *[FINGER_COLOUR] * (links - 1)]])
