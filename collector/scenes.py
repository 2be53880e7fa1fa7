"""Labelled scenes for the training of the segmentation network: raw scans of simulated objects among other things.

A raw scan is all that a depth camera measures of an object among its surroundings, with what each point is of. The
surroundings are a floor, walls, boxes, and small objects of other kinds. They are seen and hide the object, but nothing
collides with them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject, Body, Mesh
from collector.objects.catalogue import CatalogueEntry, ObjectCache, scan
from collector.objects.procedural.catalogue import build
from collector.objects.procedural.shapes import block, moved, rod
from collector.sim.camera import SURROUNDINGS, DepthImage, EmbreeCamera, noisy
from collector.sim.environment import draw_state
from shared import seeds
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.geometry import camera_pose, rotation_about_z
from shared.io.files import make_folder, write_atomically
from shared.segmentation.inputs import network_input
from shared.segmentation.scenes import (
    SCENES_FILE,
    Kind,
    Scene,
    SceneObject,
    ScenesDocument,
    read_scenes_document,
    scene_path,
    write_scene,
)
from shared.types import Float

SMALL_OBJECTS = ("Box", "Bucket", "Kettle", "KitchenPot", "TrashCan")
FLOOR_M = (1.5, 3.5)
"""How far the floor reaches from the object."""
WALL_BEHIND, WALL_BESIDE, AGAINST_WALL = 0.5, 0.3, 0.5
"""Shares of the scenes with a wall behind and with one beside the object, and of those where it touches the first."""
MOST_CLUTTER = 6
ON_THE_SIDES = 0.6
"""Share of the clutter beside the object; the rest stands in front of it."""


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
        noise: strength of the errors (see `noisy`).
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


def extent(target: ArticulatedObject, states: Float) -> tuple[Float, Float]:
    """The corners of the box, [3] each, that holds an object in all of some states, [states, parts]."""
    boxes = np.concatenate([target.visible_boxes(state) for state in states])
    return np.nanmin(boxes[:, 0], axis=0), np.nanmax(boxes[:, 1], axis=0)


def draw_surroundings(low: Float, high: Float, camera: Float, rng: np.random.Generator) -> Body:
    """Surroundings of an object that faces -x.

    Args:
        low: [3], the least corner of the box that is the object's, world.
        high: [3], its greatest corner.
        camera: [3], which no wall hides the object from.
        rng: draws everything.
    """
    centre, floor, reach = (low + high) / 2, low[2], rng.uniform(*FLOOR_M)
    end = np.maximum(high - centre, centre - low) + reach
    (x_least, y_least, _), (x_most, y_most, _) = centre - end, centre + end
    pieces = [_block((x_least, x_most), (y_least, y_most), (floor - 0.05, floor))]
    top = floor + rng.uniform(1.0, 3.0)
    if rng.random() < WALL_BEHIND:
        x = high[0] + (0.005 if rng.random() < AGAINST_WALL else rng.uniform(0.05, 0.6))
        pieces.append(_block((x, x + 0.1), (y_least, y_most), (floor, top)))
    if rng.random() < WALL_BESIDE:
        gap = rng.uniform(0.05, 0.8)
        y = high[1] + gap if camera[1] < centre[1] else low[1] - gap - 0.1
        pieces.append(_block((x_least, x_most), (y, y + 0.1), (floor, top)))
    for _ in range(int(rng.integers(MOST_CLUTTER + 1))):
        pieces += _placed(_thing(rng), low, high, rng)
    return Body("surroundings", "surroundings", None, tuple(pieces), ())


def _thing(rng: np.random.Generator) -> tuple[Mesh, ...]:
    """A box, a cylinder or a small object, around the z axis, upon z = 0."""
    kind, size = int(rng.integers(3)), rng.uniform(0.08, 0.45, size=3)
    if kind == 0:
        x, y, z = size
        pieces: tuple[Mesh, ...] = (_block((-x / 2, x / 2), (-y / 2, y / 2), (0.0, z)),)
    elif kind == 1:
        pieces = (rod((0.0, 0.0, 0.0), _point(0.0, 0.0, size[2]), size[0] / 2),)
    else:
        model = build(SMALL_OBJECTS[int(rng.integers(len(SMALL_OBJECTS)))], int(rng.integers(1 << 30)), 0)
        every = (*model.body, *(piece for part in model.parts for piece in part.pieces))
        scale = rng.uniform(0.15, 0.35)
        pieces = tuple(Mesh(scale * piece.vertices, piece.faces) for piece in every)
    rotation = rotation_about_z(rng.uniform(-np.pi, np.pi))
    turned = tuple(Mesh(piece.vertices @ rotation.T, piece.faces) for piece in pieces)
    lowest = min(float(piece.vertices[:, 2].min()) for piece in turned)
    return moved(turned, (0.0, 0.0, -lowest))


def _placed(thing: tuple[Mesh, ...], low: Float, high: Float, rng: np.random.Generator) -> tuple[Mesh, ...]:
    """A thing beside or in front of a box, on its floor, without touching it."""
    points = np.concatenate([piece.vertices for piece in thing])
    least, most = points.min(axis=0), points.max(axis=0)
    gap, along = rng.uniform(0.02, 0.6), rng.random()
    if rng.random() < ON_THE_SIDES:
        y = high[1] + gap - least[1] if rng.random() < 0.5 else low[1] - gap - most[1]
        return moved(thing, _point(low[0] - 0.3 + along * (high[0] - low[0] + 0.3), y, low[2]))
    return moved(thing, _point(low[0] - gap - most[0], low[1] + along * (high[1] - low[1]), low[2]))


def _block(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    return block(_point(x[0], y[0], z[0]), _point(x[1], y[1], z[1]))


def _point(x: float, y: float, z: float) -> tuple[float, float, float]:
    return float(x), float(y), float(z)


DRAWS = 20
"""Draws of a scene, after which no draw has shown the object."""
LEAST_SHARE = 0.05
"""The smallest share of the network's points that are on an object that counts as seen."""


def make_scenes(
    objects: Path, out: Path, count: int, seed: int, noise: tuple[float, float], tell: Callable[[int], object]
) -> ScenesDocument:
    """Make a folder of scenes; those that are there already are kept, so an interrupted call can be repeated.

    Args:
        objects: a folder of objects.
        out: folder of the scenes.
        count: how many; each object in turn.
        seed: of everything random.
        noise: between which strengths the errors of the camera are drawn.
        tell: receives how many scenes there are.

    Raises:
        UsageError: no object is usable, or the folder has other scenes.
    """
    usable = scan(objects).usable
    if not usable:
        raise UsageError(f"{objects}: no usable object; look at `adaafford objects check`")
    order = seeds.generator(seed, "scenes/objects").permutation(len(usable))
    entries: list[CatalogueEntry] = [usable[int(number)] for number in order]
    document = ScenesDocument(
        seed=seed,
        noise=noise,
        count=count,
        objects=tuple(SceneObject(id=entry.ref.id, category=entry.ref.category) for entry in entries),
    )
    make_folder(out)
    if not (out / SCENES_FILE).exists():
        write_atomically(out / SCENES_FILE, document.model_dump_json(indent=1).encode() + b"\n")
    elif read_scenes_document(out) != document:
        raise UsageError(f"{out}: holds scenes of other settings or objects; name another folder")
    cache = ObjectCache(objects)
    for number in range(count):
        path = scene_path(out, number)
        if not path.exists():
            write_scene(path, _scene(cache.load(entries[number % len(entries)].ref, "hulls"), noise, seed, number))
        tell(number + 1)
    return document


def _scene(target: ArticulatedObject, noise: tuple[float, float], seed: int, number: int) -> Scene:
    for attempt in range(DRAWS):
        scanned = random_scan(target, noise, seeds.generator(seed, "scenes", number, attempt))
        image, camera = scanned.image, scanned.world_from_camera[:3, 3]
        try:
            given, frame = network_input(image.points, camera, seed)
        except UsageError:
            continue
        kinds = scanned.kinds[given.rows]
        if (kinds != Kind.BACKGROUND).mean() >= LEAST_SHARE:
            bodies = np.where(kinds == Kind.BACKGROUND, 0, image.bodies[given.rows])
            centres = frame.place(scanned.centres[bodies]).astype(np.float32)
            return Scene(given.points, given.extra, kinds.astype(np.int64), centres)
    raise UsageError(f"object {target.ref.id}: hardly any of it is seen in {DRAWS} draws; leave it out")
