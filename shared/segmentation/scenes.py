"""A folder of labelled scans for the training of the segmentation network.

scenes.json                   of which objects, and how they were made
scene-000000.safetensors      one scan as the network is given it, with labels; object number i % objects
"""

from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from safetensors.torch import save

from shared.config import StrictModel
from shared.errors import UsageError
from shared.io.documents import parse_document
from shared.io.files import read_bounded, write_atomically
from shared.policies.policy import read_tensors
from shared.segmentation.inputs import EXTRA, POINTS
from shared.types import Float32


class Kind(IntEnum):
    """The classes of the segmentation network."""

    BACKGROUND = 0
    """Floor, walls and other things."""
    BODY = 1
    """The static body of the object."""
    TURNING = 2
    """A part that turns: a door, a lid, a switch."""
    SLIDING = 3
    """A part that slides: a drawer, a button."""


MOVABLE = (Kind.TURNING, Kind.SLIDING)


SCENES_FILE = "scenes.json"
MAX_SCENES = 100_000
MAX_DOCUMENT_BYTES, MAX_SCENE_BYTES = 1 << 24, 1 << 20
COLUMNS = 3 + EXTRA + 1 + 3
"""Place, further inputs, kind, and the middle of the part."""


class SceneObject(StrictModel):
    """One of the objects."""

    id: str = Field(max_length=200)
    category: str = Field(max_length=200)


class ScenesDocument(StrictModel):
    """The contents of scenes.json."""

    format: Literal["adaafford-scenes"] = "adaafford-scenes"
    schema_version: Literal[1] = 1
    seed: int = Field(ge=0)
    noise: tuple[float, float]
    count: int = Field(ge=1, le=MAX_SCENES)
    objects: Annotated[tuple[SceneObject, ...], Field(min_length=1, max_length=MAX_SCENES)]


@dataclass(frozen=True, slots=True)
class Scene:
    """One labelled scan, in the frame of the network (see `shared.segmentation.inputs`).

    Attributes:
        points: [N, 3].
        extra: [N, EXTRA].
        kinds: [N], see `Kind`.
        centres: [N, 3], the middle of the part that the point is of.
    """

    points: Float32
    extra: Float32
    kinds: NDArray[np.int64]
    centres: Float32


def scene_path(folder: Path, number: int) -> Path:
    """The file of a scene."""
    return folder / f"scene-{number:06d}.safetensors"


def write_scene(path: Path, scene: Scene) -> None:
    """Write a scene atomically, in half precision."""
    columns = np.concatenate([scene.points, scene.extra, scene.kinds[:, None], scene.centres], axis=1)
    write_atomically(path, save({"scene": torch.from_numpy(columns.astype(np.float16))}))


def read_scene(path: Path) -> Scene:
    """Read a scene; raises StoreError where the file is missing, damaged or foreign."""
    expected = {"scene": torch.empty(POINTS, COLUMNS, device="meta")}
    columns = read_tensors(read_bounded(path, MAX_SCENE_BYTES), expected, str(path))["scene"].numpy()
    points, extra, kinds, centres = np.split(columns, [3, 3 + EXTRA, 4 + EXTRA], axis=1)
    return Scene(points, extra, kinds[:, 0].astype(np.int64), centres)


def read_scenes_document(folder: Path) -> ScenesDocument:
    """What the scenes of a folder are of.

    Raises:
        UsageError: the folder has no scenes.
        StoreError: the document is damaged.
    """
    path = folder / SCENES_FILE
    if not path.is_file():
        raise UsageError(f"{folder}: has no {SCENES_FILE}; make scenes by `adaafford objects scenes`")
    return parse_document(ScenesDocument, read_bounded(path, MAX_DOCUMENT_BYTES), str(path), "make the scenes again")
