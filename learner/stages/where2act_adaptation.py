"""Baseline Where2Act-adaptation: which points are so similar that an interaction at one corrects the other's score?

Shapes: B ordered sets of interactions, n rows of each, K the longest context.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenFeatures, FrozenPrior
from learner.data.sampling import OrderedRows, Split, draw, order_rows, spread
from learner.metrics import discrimination
from learner.settings import AdaptationConfig
from learner.stages.trainers import BaselineTraining, Load, RowCritic, StageTrainer
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import correction_loss
from shared.policies.policy import Policy
from shared.policies.where2act_adaptation import NAME, Where2ActAdaptation, influences

VALIDATION_ROLLOUTS = 32
_VALIDATION_SEED = 24


@dataclass(eq=False)
class AdaptationStage:
    """Trains the similarities, over a Where2Act that stays as it is (AdaAfford, supplement, Details of Baselines).

    A random subset of a rollout's interactions is the context; all rows that are not in it are predicted, after each
    of its prefixes. Everything that Where2Act says is computed once, so that a step costs a small perceptron.
    """

    name = NAME

    module: Where2ActAdaptation
    dataset: Dataset
    parts: Split
    config: AdaptationConfig
    prior: FrozenPrior

    def parameter_groups(self) -> list[ParameterGroup]:
        """The similarity network, at one rate."""
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The squared error of corrected scores on a few rollouts."""
        chosen = draw(self.parts.train, self.config.batch_rollouts, rng)
        ordered = order_rows(self.dataset, chosen, self.config.rows_per_rollout, rng)
        total, ordered = int(ordered.valid.sum()), ordered.select(share(len(chosen)))
        return StepResult({"correction": self._loss(ordered)}, total)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on; "score" is the loss."""
        rng = np.random.default_rng(_VALIDATION_SEED)
        rollouts = spread(self.parts.validation, VALIDATION_ROLLOUTS)
        ordered = order_rows(self.dataset, rollouts, self.config.rows_per_rollout, rng)
        context = ordered.longest_context(self.config.context)
        asked = ordered.asked(context)[:, -1]
        corrected = corrected_scores(self.module, self.dataset, self.prior, ordered.rows, ordered.rows[:, :context])
        success = self.dataset.rows.success[ordered.rows][asked].numpy(force=True)
        before, after = (
            discrimination(corrected[:, :, prefix][asked].clamp(0.0, 1.0).numpy(force=True), success)
            for prefix in (0, -1)
        )
        return {
            "score": float(self._loss(ordered)),
            "bce_without_tries": before.bce,
            "bce_with_tries": after.bce,
            "f_without_tries": before.f_score,
            "f_with_tries": after.f_score,
            "base_rate": after.base_rate,
        }

    def _loss(self, ordered: OrderedRows) -> Tensor:
        context = ordered.longest_context(self.config.context)
        corrected = corrected_scores(self.module, self.dataset, self.prior, ordered.rows, ordered.rows[:, :context])
        success = self.dataset.rows.success[ordered.rows]
        # Without an interaction nothing is corrected, and nothing could be learnt.
        return correction_loss(corrected[..., 1:], success[..., None], ordered.asked(context)[:, 1:].transpose(1, 2))


def corrected_scores(
    network: Where2ActAdaptation, dataset: Dataset, prior: FrozenPrior, asked: Tensor, tries: Tensor
) -> Tensor:
    """Where2Act's scores of rows, corrected by every prefix of ordered interactions; beyond [0, 1] where these add up.

    Args:
        network: the similarities.
        dataset: the rows.
        prior: what Where2Act makes of them.
        asked: rows, [B, n].
        tries: rows, [B, K].

    Returns:
        [B, n, K + 1], from no interactions to all of them.
    """
    rows = dataset.rows
    distances = (rows.xyz[asked][:, :, None] - rows.xyz[tries][:, None]).norm(dim=-1)
    similarities = network.similarities(prior.features[tries][:, None], prior.features[asked][:, :, None], distances)
    added = influences(similarities, rows.success[tries], prior.scores[tries]).cumsum(dim=-1)
    before = prior.scores[asked][..., None]
    return torch.cat([before, before + added], dim=-1)


def _train(recipe: StageTrainer, config: AdaptationConfig) -> TrainingResult:
    network = recipe.policy.baseline(NAME, Where2ActAdaptation).requires_grad_(True)
    prior = FrozenPrior.of(recipe.policy.prior, recipe.known)
    return recipe.runner.train(AdaptationStage(network, recipe.dataset, recipe.parts, config, prior), config, NAME)


def _row_critic(policy: Policy, known: FrozenFeatures) -> RowCritic:
    network, prior = policy.baseline(NAME, Where2ActAdaptation), FrozenPrior.of(policy.prior, known)

    @torch.no_grad()
    def scores(asked: Tensor, tries: Tensor) -> Tensor:
        """s_u + sum (r - s) sim_pq, cut to [0, 1]."""
        if not len(tries):
            return prior.scores[asked]
        corrected = corrected_scores(network, known.dataset, prior, asked[None], tries[None])
        return corrected[0, :, -1].clamp(0.0, 1.0)

    return scores


TRAINING = BaselineTraining(
    AdaptationConfig,
    _train,
    _row_critic,
    lambda config: Load(0, config.batch_rollouts * config.rows_per_rollout * config.context, 0),
    table="adaptation",
)
