"""Stage 1: the Where2Act prior.

Its proposal network learns from successful orientations, its critic from all rows; its affordance network follows them
(see `learner.stages.affordance`).
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learner.data.dataset import Dataset
from learner.data.features import frozen_features
from learner.data.sampling import Split, draw, draw_flips, draw_turns, flip_frames, spread, turn_frames, turn_vectors
from learner.metrics import discrimination
from learner.settings import PriorConfig
from learner.stages.affordance import PriorCritic
from learner.stages.trainers import StageTrainer
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import action_scoring_loss, proposal_loss
from shared.networks.prior import Prior

VALIDATION_ROWS = 256
"""Rows of the validation objects that both losses are measured on."""
_VALIDATION_SEED = 19


class PriorStage:
    """Trains `Prior` (Where2Act): two losses in one pass, each with its own supervision."""

    name = "prior"

    def __init__(self, prior: Prior, dataset: Dataset, parts: Split, config: PriorConfig) -> None:
        self.module: nn.Module = prior
        self.prior = prior
        self.dataset = dataset
        self.config = config
        self._rows_of_cloud = _rows_of_clouds(dataset, parts.train)
        self._succeeded = dataset.rows.success.numpy(force=True) > 0
        self._validation = torch.cat([dataset.rollouts[number] for number in parts.validation])

    def parameter_groups(self) -> list[ParameterGroup]:
        """All of the prior but D, at one rate."""
        left = {id(p) for p in self.prior.affordance_network().parameters()}
        return [ParameterGroup(tuple(p for p in self.prior.parameters() if id(p) not in left))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """Both losses on the rows of a few clouds."""
        chosen = sorted(draw(range(len(self._rows_of_cloud)), self.config.batch_clouds, rng))
        most = self.config.actions_per_cloud
        picked = [rng.permutation(self._rows_of_cloud[number])[:most] for number in chosen]
        turns = draw_turns(len(chosen), self.config.augmentation, rng)
        flips = draw_flips(len(chosen), self.config.augmentation, rng)
        rows = np.concatenate(picked)
        noise = self._noise(rows, rng)
        mine = share(len(chosen))
        taken = np.isin(np.repeat(np.arange(len(picked)), [len(rows) for rows in picked]), np.arange(len(picked))[mine])
        noise = noise[torch.as_tensor(taken[self._succeeded[rows]])]
        losses = self._losses(torch.as_tensor(rows[taken]), noise, turns[mine], flips[mine])
        return StepResult(losses, len(rows))

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on; "score" is the sum of both losses on some of their rows."""
        scores, success = self.scores(self._validation), self.dataset.rows.success[self._validation]
        judged = np.array(spread(self._validation.tolist(), VALIDATION_ROWS))
        noise = self._noise(judged, np.random.default_rng(_VALIDATION_SEED))
        losses = self._losses(torch.as_tensor(judged), noise)
        found = discrimination(scores.numpy(force=True), success.numpy(force=True))
        return {
            "score": float(torch.stack(list(losses.values())).sum()),
            "bce": found.bce,
            "f_score": found.f_score,
            "auc": found.auc,
            "calibration_error": found.calibration_error,
            "base_rate": found.base_rate,
            "proposal": float(losses["proposal"]),
        }

    def _noise(self, rows: NDArray[np.int64], rng: np.random.Generator) -> Tensor:
        """What the proposals at each success among the rows are drawn from, [successes, S, noise_width]."""
        shape = (int(self._succeeded[rows].sum()), self.config.proposals, self.prior.config.noise_width)
        return torch.as_tensor(rng.standard_normal(shape).astype(np.float32))

    def _losses(
        self, index: Tensor, noise: Tensor, turns: Tensor | None = None, flips: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Both losses on rows, seen after a turn and a flip for each of their clouds, which are in order."""
        rows, prior = self.dataset.rows, self.prior
        clouds, cloud = torch.unique(rows.cloud[index], return_inverse=True)
        seen = self.dataset.clouds.select(clouds)
        xyz, frames, success = rows.xyz[index], rows.frame[index], rows.success[index]
        if turns is not None:
            seen = replace(seen, points=turn_vectors(turns, seen.points))
            xyz = turn_vectors(turns[cloud], xyz[:, None])[:, 0]
            frames = turn_frames(turns[cloud], frames[:, None])[:, 0]
        if flips is not None:
            frames = flip_frames(flips[cloud], frames[:, None])[:, 0]
        features = prior.encoder.at(prior.encoder(seen), cloud, rows.point[index])
        succeeded = success > 0
        proposals = prior.propose(features[succeeded][:, None], noise)
        return {
            "critic": action_scoring_loss(prior.action_logits(features, xyz, frames), success),
            "proposal": proposal_loss(proposals, frames[succeeded]),
        }

    @torch.no_grad()
    def scores(self, index: Tensor) -> Tensor:
        """The critic's scores of rows."""
        rows = self.dataset.rows
        features = frozen_features(self.prior.encoder, self.dataset.clouds, rows.cloud[index], rows.point[index])
        return torch.sigmoid(self.prior.action_logits(features, rows.xyz[index], rows.frame[index]))


def train_prior(recipe: StageTrainer) -> TrainingResult:
    """Train the prior's proposals and critic, then its D."""
    prior, config = recipe.policy.prior.requires_grad_(True), recipe.config.prior
    result = recipe.runner.train(PriorStage(prior, recipe.dataset, recipe.parts, config), config, "prior")
    prior.eval().requires_grad_(False)
    pool = recipe.pool()
    affordance = recipe.affordance("prior", PriorCritic(prior, pool), config.affordance, pool)
    return recipe.runner.train_affordance(affordance, config.affordance, result)


def _rows_of_clouds(dataset: Dataset, rollouts: tuple[int, ...]) -> list[np.ndarray]:
    """The rows of each cloud that the rollouts have."""
    rows = torch.cat([dataset.rollouts[number] for number in rollouts])
    cloud = dataset.rows.cloud[rows].numpy(force=True)
    order = np.argsort(cloud, kind="stable")
    return np.split(rows.numpy()[order], np.flatnonzero(np.diff(cloud[order])) + 1)
