"""Pictures of objects and hands on white ground: frames of a playback, with outlines and the shadows of one light.

A contact sheet shows many objects in one picture, each movable part in another colour.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject, Body
from collector.sim.camera import DepthImage, EmbreeCamera
from collector.viz.playback import Playback
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.io.files import write_atomically, writing
from shared.types import Float, Float32

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


Picture = NDArray[np.uint8]
"""[height, width, 3]."""
SAMPLES = 2
"""Rays along an edge of a pixel, for smooth edges."""
LIGHT = np.array(LIGHT_FROM)
ACROSS_LIGHT = np.linalg.svd(LIGHT[None])[2][1:].T
"""[3, 2], two axes across the direction of the light."""
SHADOW, GROUND_SHADOW = 0.45, 0.8
"""What is left of the light on a body, and the grey of the ground, which is white otherwise."""
OUTLINE, CREASE = 0.4, 0.75
"""What is left of a colour where bodies meet, and where a surface bends."""
CREASE_COSINE = 0.8
LIFT = 2e-3
"""Rays to the light begin this far above a surface, m."""
MARGIN = 1.1
"""Of a view into which everything fits."""
GROUND = -1
"""Label of pixels that see no body."""


@dataclass(frozen=True, slots=True)
class View:
    """What a camera sees.

    Attributes:
        world_from_camera: [4, 4].
        width: of the pictures, pixels.
        height: likewise.
        field_of_view_deg: horizontal.
    """

    world_from_camera: Float
    width: int
    height: int
    field_of_view_deg: float


class Renderer:
    """Draws the frames of a playback from one place.

    What does not move is drawn once; each frame adds the bodies that do, and their shadows.
    """

    def __init__(self, playback: Playback, view: View) -> None:
        scenery = playback.scenery()
        self._poses = np.stack([playback.poses(frame) for frame in range(len(playback.times))])
        moves = (np.ptp(self._poses, axis=0) > 0).any(axis=(1, 2))
        self._moving, still = np.flatnonzero(moves), np.flatnonzero(~moves)
        self._vertices = [_vertices(scenery.bodies[number]) for number in self._moving]
        self._colours = body_colours(len(playback.target.parts), len(playback.hand)).astype(np.float32)
        self._shape = view.height * SAMPLES, view.width * SAMPLES
        config = CameraConfig(image_size=view.width * SAMPLES, field_of_view_deg=view.field_of_view_deg)
        self._back, self._front = (
            EmbreeCamera(_only(scenery, numbers), view.world_from_camera, config, view.height * SAMPLES)
            for numbers in (still, self._moving)
        )
        self._still_poses = self._poses[0, still]
        bodies = playback.target.bodies
        heights = _placed([_vertices(body) for body in bodies], self._poses[0, : len(bodies)])[:, 2]
        self._draw_back(still, float(heights.min()) if len(heights) else 0.0)

    def picture(self, frame: int) -> Picture:
        """The picture of a frame."""
        poses = self._poses[frame, self._moving]
        picture = self._picture.copy()
        # What is in the light without the bodies that move may be in their shadow.
        cast = _placed(self._vertices, poses) @ ACROSS_LIGHT
        near = np.flatnonzero(
            ((self._lit_places >= cast.min(axis=0)) & (self._lit_places <= cast.max(axis=0))).all(axis=1)
        )
        shadow = near[self._front.in_shadow(self._lit_points[near], LIGHT, poses)]
        picture[self._lit_pixels[shadow]] = self._dark[shadow]

        image = self._front.capture_bodies(poses)
        seen = image.depths < self._depths[image.pixels]
        pixels, normals, labels = image.pixels[seen], image.normals[seen], self._moving[image.bodies[seen]]
        facing = np.clip(normals @ LIGHT, 0.0, 1.0)
        starts = image.points[seen] + LIFT * normals
        dark = self._front.in_shadow(starts, LIGHT, poses) | self._back.in_shadow(starts, LIGHT, self._still_poses)
        picture[pixels] = self._colours[labels] * _shades(np.where(dark, SHADOW * facing, facing))[:, None]
        return self._finished(picture, pixels, labels, normals)

    def _draw_back(self, still: NDArray[np.int64], ground: float) -> None:
        """Draw what does not move, and the ground at this height."""
        count = self._shape[0] * self._shape[1]
        image = self._back.capture_bodies(self._still_poses)
        self._depths, self._labels = np.full(count, np.inf), np.full(count, GROUND)
        self._normals, self._picture = np.zeros((count, 3), np.float32), np.ones((count, 3), np.float32)
        self._depths[image.pixels], self._labels[image.pixels] = image.depths, still[image.bodies]
        self._normals[image.pixels] = image.normals

        free = np.flatnonzero(self._labels == GROUND).astype(np.uint32)
        place = self._back.world_from_camera
        directions = self._back.directions(free) @ place[:3, :3].T
        free, directions = free[directions[:, 2] < -0.01], directions[directions[:, 2] < -0.01]
        hits = place[:3, 3] + directions * ((ground - place[2, 3]) / directions[:, 2])[:, None]

        pixels = np.concatenate([image.pixels, free])
        points = np.concatenate([image.points + LIFT * image.normals, hits])
        facing = np.clip(image.normals @ LIGHT, 0.0, 1.0)
        own, white = self._colours[still[image.bodies]], np.ones((len(free), 3), np.float32)
        self._picture[pixels] = np.concatenate([own * _shades(facing)[:, None], white])
        dark = np.concatenate([own * _shades(SHADOW * facing)[:, None], GROUND_SHADOW * white])
        lit = np.concatenate([facing > 0, np.ones(len(free), np.bool_)])
        pixels, points, dark = pixels[lit], points[lit], dark[lit]
        shadow = self._back.in_shadow(points, LIGHT, self._still_poses)
        self._picture[pixels[shadow]] = dark[shadow]
        self._lit_pixels, self._lit_points, self._dark = pixels[~shadow], points[~shadow], dark[~shadow]
        self._lit_places = self._lit_points @ ACROSS_LIGHT
        self._lines = _lines(self._labels.reshape(self._shape), self._normals.reshape(*self._shape, 3))

    def _finished(
        self, picture: Float32, pixels: NDArray[np.uint32], labels: NDArray[np.int64], normals: Float
    ) -> Picture:
        """A picture, [pixels, 3], with the lines around what moves, at its final size."""
        lines = self._lines
        if len(pixels):
            rows, columns = np.divmod(pixels.astype(np.int64), self._shape[1])
            top, left = max(int(rows.min()) - 1, 0), max(int(columns.min()) - 1, 0)
            part = np.s_[top : rows.max() + 2, left : columns.max() + 2]
            labelled, bent = (
                self._labels.reshape(self._shape)[part].copy(),
                self._normals.reshape(*self._shape, 3)[part],
            )
            bent = bent.copy()
            labelled[rows - top, columns - left], bent[rows - top, columns - left] = labels, normals
            lines = lines.copy()
            lines[part][1:, 1:] = _lines(labelled, bent)[1:, 1:]
        fine = picture.reshape(*self._shape, 3) * lines[:, :, None]
        steps = range(SAMPLES)
        mean = sum((fine[row::SAMPLES, column::SAMPLES] for row in steps for column in steps), np.float32(0.0))
        return np.asarray(np.round(mean * (255 / SAMPLES**2)), dtype=np.uint8)


def fitted(playback: Playback, view: View) -> View:
    """A view in the same direction, from where object and hand are in the picture throughout."""
    pose = view.world_from_camera
    vertices = [_vertices(body) for body in playback.scenery().bodies]
    world = np.concatenate([_placed(vertices, playback.poses(frame)) for frame in playback.moments.values()])
    seen = world @ pose[:3, :3]
    reach = np.tan(np.deg2rad(view.field_of_view_deg) / 2) / MARGIN * np.array([1.0, view.height / view.width])
    # A camera at `back` along its axis sees a point if |across - centre| <= reach * (forward - back), on both axes.
    low, high = (seen[:, 1:] + reach * seen[:, :1]).min(axis=0), (seen[:, 1:] - reach * seen[:, :1]).max(axis=0)
    back = ((low - high) / (2 * reach)).min()
    place = pose.copy()
    place[:3, 3] = pose[:3, :3] @ np.array([back, *(low + high) / 2])
    return replace(view, world_from_camera=place)


def with_most_of_the_hand(playback: Playback, places: Iterable[Float], field_of_view_deg: float) -> Float:
    """The one of these poses of a camera, [4, 4] each, that sees most of the hand."""
    scenery, config = playback.scenery(), CameraConfig(image_size=128, field_of_view_deg=field_of_view_deg)
    poses = [playback.poses(frame) for frame in playback.moments.values()]

    def hand_pixels(place: Float) -> int:
        camera = EmbreeCamera(scenery, place, config)
        return sum(int((camera.capture_bodies(p).bodies >= len(playback.target.bodies)).sum()) for p in poses)

    return max(places, key=hand_pixels)


def _only(scenery: ArticulatedObject, numbers: NDArray[np.int64]) -> ArticulatedObject:
    return ArticulatedObject(scenery.ref, tuple(scenery.bodies[number] for number in numbers))


def _vertices(body: Body) -> Float:
    return np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in body.visuals)])


def _placed(vertices: Sequence[Float], poses: Float) -> Float:
    """The vertices of bodies, [V, 3], world."""
    placed = (each @ pose[:3, :3].T + pose[:3, 3] for each, pose in zip(vertices, poses, strict=True))
    return np.concatenate([np.zeros((0, 3)), *placed])


def _shades(facing: Float) -> Float32:
    """What is seen of a colour."""
    return (AMBIENT + (1 - AMBIENT) * facing).astype(np.float32)


def _lines(labels: NDArray[np.int64], normals: Float32) -> Float32:
    """What is left of each pixel's colour, [H, W]: less on the outlines of bodies, and where a surface bends."""
    left = np.ones(labels.shape, np.float32)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        meets = labels[first] != labels[second]
        bends = ~meets & (labels[first] != GROUND) & ((normals[first] * normals[second]).sum(axis=-1) < CREASE_COSINE)
        left[second][bends] *= CREASE
        left[second][meets] = OUTLINE
    return left
