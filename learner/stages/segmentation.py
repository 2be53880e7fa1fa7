"""The segmentation network, trained on labelled scenes (`adaafford objects scenes`)."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from learner.settings import METRICS_FILE, SegmentationConfig
from learner.training.checkpoint import refuse_foreign
from learner.training.loop import CHECKPOINT_FILE, ParameterGroup, StepResult, TrainingResult, train
from learner.training.trackers import EVENTS_FOLDER
from shared import seeds
from shared.errors import UsageError
from shared.io.files import make_folder, write_atomically
from shared.networks.pointnet2 import CloudBatch, group_cloud
from shared.policies.policy import WEIGHTS_FILE
from shared.segmentation.scenes import MOVABLE, Kind, Scene, read_scene, read_scenes_document, scene_path
from shared.segmentation.segmenter import SEGMENTATION_FILE, SEGMENTATION_NETWORK, SegmentationNetwork, Segmenter, begun

VALIDATION_SHARE = 8
"""One object in so many is used for validation."""
VALIDATION_SCENES = 48
"""Of each folder, at most."""
LEAVES = "|".join(map(re.escape, (METRICS_FILE, CHECKPOINT_FILE, EVENTS_FOLDER, SEGMENTATION_FILE)))
"""Names in the folder of a training; one of them is there as soon as it trains."""
OFFSET_WEIGHT = 4.0
"""Of the mean error of the offsets, m, beside the cross entropy."""
KIND_WEIGHTS = (0.5, 1.0, 1.5, 1.5)


@dataclass(frozen=True, slots=True)
class Scenes:
    """Scenes as tensors.

    Attributes:
        clouds: of S scenes.
        kinds: [S, N].
        centres: [S, N, 3].
    """

    clouds: CloudBatch
    kinds: Tensor
    centres: Tensor

    @classmethod
    def of(cls, scenes: list[Scene]) -> "Scenes":
        """Scenes stacked, with the neighbours of their points."""
        points = [scene.points for scene in scenes]
        groupings = (group_cloud(each, SEGMENTATION_NETWORK) for each in points)
        return cls(
            CloudBatch.of(points, groupings, [scene.extra for scene in scenes]),
            torch.from_numpy(np.stack([scene.kinds for scene in scenes])),
            torch.from_numpy(np.stack([scene.centres for scene in scenes])),
        )

    def select(self, numbers: Tensor) -> "Scenes":
        """The scenes of some numbers."""
        return Scenes(self.clouds.select(numbers), self.kinds[numbers], self.centres[numbers])

    def mirrored(self, flips: Tensor) -> "Scenes":
        """The scenes with those that are marked, [S], reflected at the plane y = 0."""
        signs = torch.ones(len(flips), 1, 3)
        signs[flips, :, 1] = -1.0
        clouds = self.clouds
        assert clouds.extra is not None, "scenes have further inputs"
        # The first three further inputs are the normal.
        extra = torch.cat([clouds.extra[..., :3] * signs, clouds.extra[..., 3:]], dim=-1)
        return Scenes(replace(clouds, points=clouds.points * signs, extra=extra), self.kinds, self.centres * signs)


class SegmentationStage:
    """Trains `SegmentationNetwork`: cross entropy of the kinds, and the distance of the voted from the true middles."""

    name = "segmentation"

    def __init__(self, network: SegmentationNetwork, learnt: Scenes, held_out: Scenes, config: SegmentationConfig):
        self.module: nn.Module = network
        self._network, self._learnt, self._held_out, self._config = network, learnt, held_out, config

    def parameter_groups(self) -> list[ParameterGroup]:
        """All weights, at one rate."""
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The losses of a few scenes."""
        count = min(self._config.batch_scenes, len(self._learnt.kinds))
        scenes = self._learnt.select(torch.from_numpy(rng.permutation(len(self._learnt.kinds))[:count]))
        if self._config.mirror:
            scenes = scenes.mirrored(torch.from_numpy(rng.random(count) < 0.5))
        kinds, offsets = self._losses(scenes, *self._network(scenes.clouds))
        return StepResult({"kinds": kinds, "offsets": offsets}, count)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """The losses on scenes of other objects, and the intersection over union of each kind; "score" is their sum."""
        logits, offsets = [], []
        for number in range(len(self._held_out.kinds)):
            one_logits, one_offsets = self._network(self._held_out.select(torch.tensor([number])).clouds)
            logits.append(one_logits)
            offsets.append(one_offsets)
        all_logits = torch.cat(logits)
        kinds, distance = self._losses(self._held_out, all_logits, torch.cat(offsets))
        guessed, figures = all_logits.argmax(dim=-1), {"score": float(kinds + distance)}
        for kind in Kind:
            both = ((guessed == kind) & (self._held_out.kinds == kind)).sum()
            either = ((guessed == kind) | (self._held_out.kinds == kind)).sum()
            figures[f"iou_{kind.name.lower()}"] = float(both / either.clamp_min(1))
        figures["offset_m"] = float(distance / OFFSET_WEIGHT)
        return figures

    def _losses(self, scenes: Scenes, logits: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        kinds = functional.cross_entropy(logits.flatten(0, 1), scenes.kinds.flatten(), torch.tensor(KIND_WEIGHTS))
        moves = torch.isin(scenes.kinds, torch.tensor(MOVABLE))
        off = torch.linalg.vector_norm(scenes.clouds.points + offsets - scenes.centres, dim=-1)[moves]
        return kinds, OFFSET_WEIGHT * (off.sum() / max(len(off), 1))


def train_segmentation(
    folders: Sequence[Path], out: Path, config: SegmentationConfig, seed: int, init: Segmenter | None = None
) -> tuple[Segmenter, TrainingResult]:
    """Train a segmentation network from scenes, or go on with it; its files are written to `out`.

    Args:
        folders: of scenes; of each, one object in eight validates.
        out: folder for the network, its metrics and its checkpoint.
        config: how long, how fast.
        seed: of all randomness.
        init: whose weights are the start; random ones where there is none.

    Raises:
        UsageError: there are no scenes, or too few objects to hold one out; or `out` is of another training.
        StoreError: a scene is damaged.
    """
    refuse_foreign(out, LEAVES)
    network = begun(seed)
    told = ""
    learnt: list[Path] = []
    held_out: list[Path] = []
    for folder in folders:
        document = read_scenes_document(folder)
        told += document.model_dump_json()
        objects = len(document.objects)
        order = seeds.generator(seed, "segmentation/validation").permutation(objects)
        if (few := -(-objects // VALIDATION_SHARE)) == objects:
            raise UsageError(f"{folder}: has scenes of one object; validation needs another")
        numbers = np.arange(document.count)
        validates = np.isin(numbers % objects, order[:few])
        if validates.all() or not validates.any():
            raise UsageError(f"{folder}: has too few scenes; make more of them")
        learnt += [scene_path(folder, int(number)) for number in numbers[~validates]]
        held_out += [scene_path(folder, int(number)) for number in numbers[validates][:VALIDATION_SCENES]]
    told += f"{config.model_dump_json()}{seed}{SEGMENTATION_NETWORK.model_dump_json()}"
    if init is not None:
        network.load_state_dict(init.network.state_dict())
        told += hashlib.sha256(init.to_files()[WEIGHTS_FILE]).hexdigest()
    known, others = (Scenes.of([read_scene(path) for path in paths]) for paths in (learnt, held_out))
    stage = SegmentationStage(network, known, others, config)
    make_folder(out)
    result = train(stage, config, seed, out, hashlib.sha256(told.encode()).hexdigest())
    if init is not None:
        start = init.network.state_dict()
        learned = network.state_dict().items()
        network.load_state_dict({name: torch.lerp(start[name], weights, config.blend) for name, weights in learned})
    segmenter = Segmenter(network)
    for name, data in segmenter.to_files().items():
        write_atomically(out / name, data)
    return segmenter, result
