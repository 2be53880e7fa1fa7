"""Labelled scenes for the training of the segmentation network: scans of simulated objects among other things."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import CatalogueEntry, ObjectCache, scan
from collector.sim.raw_scan import random_scan
from shared import seeds
from shared.errors import UsageError
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
