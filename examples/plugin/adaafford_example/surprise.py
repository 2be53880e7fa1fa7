"""A baseline with one weight: how much the surprise of the interactions shifts Where2Act's scores everywhere.

This file is all of it: network, settings, training, critics, and the method that the table lists.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learner.data.dataset import Dataset
from learner.data.features import FrozenFeatures, FrozenPrior
from learner.data.sampling import Split, draw, order_rows, spread
from learner.settings import TrainingConfig
from learner.stages.trainers import BaselineTraining, Load, StageTrainer
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import action_scoring_loss
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import Adapter, Proposals
from shared.policies.methods import Baseline, Method
from shared.policies.policy import Policy
from shared.types import Action, Float32, Interaction, Observation

NAME = "surprise"


class SurpriseConfig(TrainingConfig):
    """The settings: a table [learner.baselines.surprise] of a campaign's file, [baselines.surprise] of a training's."""

    steps: int = 100
    batch_rollouts: int = 16
    rows_per_rollout: int = 32
    context: int = 4
    """Tries that are summed up."""


class Surprise(nn.Module):
    """s given I = sigmoid(logit(s) + w * mean(r - s of the interactions))."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def logits(self, scores: Tensor, successes: Tensor, expected: Tensor) -> Tensor:
        """Shifted logits of Where2Act's scores, [..., n], after interactions [..., K] with Where2Act's scores."""
        surprise = (successes - expected).mean(dim=-1, keepdim=True) if successes.shape[-1] else scores.new_zeros(1)
        return torch.logit(scores, eps=1e-4) + self.weight * surprise


# How it is trained


class SurpriseStage:
    """Random rows of a rollout are the context; all other rows of it are predicted."""

    name = NAME

    def __init__(self, network: Surprise, dataset: Dataset, parts: Split, config: SurpriseConfig, prior: FrozenPrior):
        self.module: nn.Module = network
        self.network, self.dataset, self.parts, self.config, self.prior = network, dataset, parts, config, prior

    def parameter_groups(self) -> list[ParameterGroup]:
        """The one weight."""
        return [ParameterGroup(tuple(self.network.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """Cross entropy on a few rollouts."""
        chosen = draw(self.parts.train, self.config.batch_rollouts, rng)
        loss, rows = self._loss(chosen, rng, share(len(chosen)))
        return StepResult({"critic": loss}, rows)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Cross entropy on objects that are not trained on."""
        loss, _ = self._loss(spread(self.parts.validation, 32), np.random.default_rng(25), slice(None))
        return {"score": float(loss)}

    def _loss(self, rollouts: Sequence[int], rng: np.random.Generator, mine: Any) -> tuple[Tensor, int]:
        ordered = order_rows(self.dataset, rollouts, self.config.rows_per_rollout, rng)
        total, ordered = int(ordered.valid.sum()), ordered.select(mine)
        context = ordered.longest_context(self.config.context)
        success, scores = self.dataset.rows.success[ordered.rows], self.prior.scores[ordered.rows]
        logits = self.network.logits(scores, success[:, :context], scores[:, :context])
        return action_scoring_loss(logits, success, ordered.asked(context)[:, -1]), total


def _train(recipe: StageTrainer, config: SurpriseConfig) -> TrainingResult:
    network = recipe.policy.baseline(NAME, Surprise).requires_grad_(True)
    prior = FrozenPrior.of(recipe.policy.prior, recipe.known)
    return recipe.runner.train(SurpriseStage(network, recipe.dataset, recipe.parts, config, prior), config, NAME)


# What it believes: of rows of a store, and of what a camera sees


class SurpriseScores:
    """Scores of rows."""

    def __init__(self, policy: Policy, known: FrozenFeatures) -> None:
        self._network = policy.baseline(NAME, Surprise)
        self._prior, self._rows = FrozenPrior.of(policy.prior, known), known.dataset.rows

    @torch.no_grad()
    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """Of rows, [Q], after other rows, [K]."""
        scores, success = self._prior.scores, self._rows.success
        return torch.sigmoid(self._network.logits(scores[asked], success[tries], scores[tries]))


class SurpriseCritic:
    """Scores before a camera or on a robot."""

    name = NAME

    def __init__(self, adapter: Adapter) -> None:
        self.adapter = adapter
        self._network = adapter.policy.baseline(NAME, Surprise)

    def affordance(
        self, observation: Observation, points: NDArray[np.int64], history: Sequence[Interaction]
    ) -> Float32:
        """Of points, [Q]."""
        return self._after(torch.from_numpy(self.adapter.prior_affordance(observation, points)), history).numpy()

    def predict(self, observation: Observation, actions: Sequence[Action], history: Sequence[Interaction]) -> Float32:
        """Of actions, [A]."""
        return self._after(torch.from_numpy(self.adapter.prior_score(observation, actions)), history).numpy()

    def predict_proposals(
        self, observation: Observation, proposals: Proposals, history: Sequence[Interaction]
    ) -> Tensor:
        """Of rotations at one point, [S]."""
        return self._after(self.adapter.prior_score_proposals(observation, proposals), history)

    @torch.inference_mode()
    def _after(self, scores: Tensor, history: Sequence[Interaction]) -> Tensor:
        successes = torch.tensor([float(interaction.outcome.success) for interaction in history])
        said = [self.adapter.prior_score(each.observation, [each.action])[0] for each in history]
        return torch.sigmoid(self._network.logits(scores, successes, torch.tensor(said)))


BASELINE = Baseline(Surprise, SurpriseCritic, training=f"{__name__}:TRAINING")
METHOD = Method("furthest", NAME)
"""This package's own proposer, with this baseline as the critic."""
TRAINING = BaselineTraining(
    SurpriseConfig,
    _train,
    SurpriseScores,
    lambda config: Load(0, config.batch_rollouts * config.rows_per_rollout, 0),
)
