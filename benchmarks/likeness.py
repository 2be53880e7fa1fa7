"""How alike are generated and real objects to a gripper? Pinch profiles of random actions on both, compared.

A profile (`shared.pinch`) says which surface lies between and beside the fingers, in steps of a centimetre: whether a
door's edge is free or meets another, what stands out, and how far the next surface is.

Shapes: A actions.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from torch import nn

from benchmarks.script import main
from cluster.cli.commands.bench import BenchSettings
from collector.random_proposer import RandomProposer
from collector.simulated_objects import SimulatedObjects
from learner.metrics import area_under_roc
from shared.config import CameraConfig, CollectionConfig
from shared.errors import UsageError
from shared.geometry import points_in_view
from shared.pinch import pinch_profiles
from shared.policies.adaptation import dense_in_view, frames_in_view
from shared.seeds import generator
from shared.tasks import task_named
from shared.types import Float32

FOLDS = 5
STEPS = 300


class LikenessSettings(BenchSettings):
    """Compare what grippers meet on generated objects with what they meet on real ones."""

    generated: Path | None = None
    """A folder of generated objects (`adaafford objects generate`); those of `--objects` are the real ones."""
    task: str = "pull-closed-door"
    """Gives objects, start states and where random actions are."""
    views: int = Field(120, ge=10, le=10_000)
    """Rollouts of each folder, one view of each; objects take turns."""
    actions: int = Field(16, ge=1, le=1_000)
    """Random actions in each view."""
    seed: int = Field(0, ge=0, lt=2**63)
    """Of views, actions and the classifier."""


def profiles(folder: Path, settings: LikenessSettings) -> tuple[Float32, NDArray[np.int64]]:
    """Profiles, [A, PROFILE_WIDTH], and the number of the object that each is of, [A]."""
    task = task_named(settings.task)
    objects = SimulatedObjects(folder, task, CollectionConfig(camera=CameraConfig(keep_depth=True)))
    plan = objects.plan(settings.seed)
    found, owners, first = [], [], 0
    for _ in range(settings.views):
        start = objects.start(plan, first)
        first = start.draw.index + 1
        observation = start.environment.observe()
        rng = generator(settings.seed, "likeness", start.draw.index)
        proposer = RandomProposer(rng, task.edge_share)
        actions = [action for _ in range(settings.actions) if (action := proposer.propose(observation, []))]
        dense, points = dense_in_view(observation), points_in_view(observation)
        for action, frame in zip(actions, frames_in_view(observation, actions).numpy(), strict=True):
            found.append(pinch_profiles(dense, points[action.point_index], frame[None]))
            owners.append(start.draw.index % len(objects.refs))
    return np.concatenate(found), np.array(owners)


def measure(settings: LikenessSettings) -> dict[str, Any]:
    """The figures of both folders."""
    if settings.objects is None or settings.generated is None:
        raise UsageError("name both folders: --objects REAL --generated FOLDER")
    real, real_objects = profiles(settings.objects, settings)
    made, made_objects = profiles(settings.generated, settings)
    return {
        "real_objects": len(np.unique(real_objects)),
        "generated_objects": len(np.unique(made_objects)),
        "nearest_generated_over_nearest_real": nearest_ratio(real, real_objects, made),
        "classifier_auc": told_apart(real, real_objects, made, made_objects, settings.seed),
    }


def nearest_ratio(real: Float32, objects: NDArray[np.int64], made: Float32) -> float:
    """The mean distance of real profiles to the nearest generated one, over that to the nearest of other real objects.

    One would say that generated objects cover the real ones as well as these cover each other.
    """
    to_made = np.asarray(cKDTree(made).query(real)[0])
    to_real = np.empty(len(real))
    for each in np.unique(objects):
        to_real[objects == each] = cKDTree(real[objects != each]).query(real[objects == each])[0]
    return float(to_made.mean() / to_real.mean())


def told_apart(
    real: Float32, real_objects: NDArray[np.int64], made: Float32, made_objects: NDArray[np.int64], seed: int
) -> float:
    """AUC of a small network that tells real from generated profiles, on objects that it has not seen."""
    inputs = torch.from_numpy(np.concatenate([real, made]))
    labels = np.concatenate([np.ones(len(real)), np.zeros(len(made))])
    folds = np.concatenate([_folds(real_objects, seed), _folds(made_objects, seed)])
    scores = np.empty(len(labels))
    torch.manual_seed(seed)
    for fold in range(FOLDS):
        known, asked = np.flatnonzero(folds != fold), np.flatnonzero(folds == fold)
        scores[asked] = _classified(inputs[known], labels[known], inputs[asked])
    return area_under_roc(scores, labels > 0)


def _folds(objects: NDArray[np.int64], seed: int) -> NDArray[np.int64]:
    """Which fold each row is in, by its object."""
    names, rows = np.unique(objects, return_inverse=True)
    return (np.random.default_rng(seed).permutation(len(names)) % FOLDS)[rows]


def _classified(inputs: torch.Tensor, labels: NDArray[np.float64], asked: torch.Tensor) -> Sequence[float]:
    network = nn.Sequential(nn.Linear(inputs.shape[1], 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1))
    optimizer = torch.optim.Adam(network.parameters(), 2e-3, weight_decay=1e-3)
    target = torch.from_numpy(labels).float()
    weight = torch.tensor([(target == 0).sum() / (target == 1).sum()])
    for _ in range(STEPS):
        optimizer.zero_grad()
        loss = nn.functional.binary_cross_entropy_with_logits(network(inputs)[:, 0], target, pos_weight=weight)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.inference_mode():
        return network(asked)[:, 0].numpy()  # type: ignore[no-any-return]


if __name__ == "__main__":
    main("likeness", LikenessSettings, measure)
