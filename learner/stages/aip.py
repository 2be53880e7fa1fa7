"""Stage 3: Adaptive Interaction Proposal, supervised by a frozen AAP.

Shapes: B ordered sets of interactions, n rows of each, K the longest context, Q points, S proposals.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap
from learner.data.sampling import OrderedRows, Split, draw, order_rows, spread
from learner.metrics import correlation
from learner.settings import AipConfig
from learner.stages.affordance import AipCritic
from learner.stages.oracle import Teacher
from learner.stages.trainers import StageTrainer
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import action_scoring_losses, information_gains, information_loss, mean_information_loss
from shared.networks.aip import Aip

VALIDATION_ROLLOUTS = 32
_VALIDATION_SEED = 21
_CHUNK = 4
"""Rollouts validated at once."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Targets of the AIP critic, and what it is told.

    Attributes:
        gains: drop of the AAP loss by each interaction, [B, K].
        latents: z before each interaction, [B, K, latent_width].
        scores: s^AAP_u|z of each interaction before it, [B, K].
        mask: interactions that have a target, [B, K].
    """

    gains: Tensor
    latents: Tensor
    scores: Tensor
    mask: Tensor


class AipStage:
    """Trains all of `Aip` but D (AdaAfford, AIP Action Scoring Loss); AAP stays as it is.

    The drop of the AAP loss is measured on rows of the same rollout that are no context at all, the same for every
    prefix, so that two losses differ by one interaction alone. Privileged: with a teacher, the loss is against what the
    oracle expects instead of single successes, which are ten coins a rollout that would drown the drop.
    """

    name = "aip"

    def __init__(
        self,
        aip: Aip,
        dataset: Dataset,
        parts: Split,
        config: AipConfig,
        frozen: FrozenAap,
        teacher: Teacher | None = None,
    ) -> None:
        self.module: nn.Module = aip
        self.aip = aip
        self.dataset = dataset
        self.parts = parts
        self.config = config
        self.frozen = frozen
        self._inherits = config.training == "inherited"
        self._answers = teacher.scores if self._inherits and teacher is not None else dataset.rows.success
        if self._inherits:
            aip.encoder.load_state_dict(frozen.aap.encoder.state_dict())

    def parameter_groups(self) -> list[ParameterGroup]:
        """All of AIP but D and what is inherited, at one rate; nothing of AAP."""
        others = [self.aip.affordance_network(), *([self.aip.encoder] if self._inherits else [])]
        left = {id(p) for module in others for p in module.parameters()}
        return [ParameterGroup(tuple(p for p in self.aip.parameters() if id(p) not in left))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The critic's loss on a few rollouts, several ordered subsets of each."""
        ordered = self._order(draw(self.parts.train, self.config.batch_rollouts, rng), rng)
        total, ordered = int(ordered.valid.sum()), ordered.select(share(len(ordered.rows)))
        found = self.gains(ordered)
        predicted = self._predict(ordered, found)
        return StepResult({"critic": self._loss(predicted, found.gains, found.mask)}, total)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on.

        "critic", which is the score, is to be compared with "critic_of_constant", the loss of the best constant.
        """
        rng = np.random.default_rng(_VALIDATION_SEED)
        rollouts = spread(self.parts.validation, VALIDATION_ROLLOUTS)
        kept_gains, kept_guesses = [], []
        for start in range(0, len(rollouts), _CHUNK):
            ordered = self._order(rollouts[start : start + _CHUNK], rng)
            found = self.gains(ordered)
            kept_guesses.append(self._predict(ordered, found)[found.mask])
            kept_gains.append(found.gains[found.mask])
        gains, guesses = torch.cat(kept_gains), torch.cat(kept_guesses)
        everything = torch.ones_like(gains, dtype=torch.bool)
        critic = float(self._loss(guesses, gains, everything))
        constant = gains.mean() if self._inherits else gains.median()
        return {
            "score": critic,
            "critic": critic,
            "critic_of_constant": float(self._loss(constant.expand_as(gains), gains, everything)),
            "mean_gain": float(gains.mean()),
            "correlation": correlation(guesses.numpy(force=True), gains.numpy(force=True)),
        }

    @torch.no_grad()
    def gains(self, ordered: OrderedRows) -> Gains:
        """How much each interaction lowers the AAP loss on the rows outside of the context."""
        frozen, rows = self.frozen, self.dataset.rows
        context = ordered.longest_context(self.config.context)
        tries = ordered.rows[:, :context]
        latents = frozen.latents(tries)
        features = frozen.features[ordered.rows][:, None]
        xyz, frames = rows.xyz[ordered.rows][:, None], rows.frame[ordered.rows][:, None]
        logits = frozen.aap.action_logits(features, xyz, frames, latents[:, :, None])
        held_out = ordered.asked(context)[:, -1]
        losses = action_scoring_losses(logits, self._answers[ordered.rows][:, None])
        counts = held_out[:, None].to(losses.dtype)
        per_prefix = (losses * counts).sum(dim=-1) / counts.sum(dim=-1).clamp_min(1.0)
        own = torch.arange(context)
        mask = ordered.valid[:, :context] & held_out.any(dim=1)[:, None]
        return Gains(information_gains(per_prefix), latents[:, :-1], torch.sigmoid(logits[:, own, own]), mask)

    def _order(self, rollouts: list[int], rng: np.random.Generator) -> OrderedRows:
        repeated = [number for number in rollouts for _ in range(self.config.draws)]
        return order_rows(self.dataset, repeated, self.config.rows_per_rollout, rng, self.config.continued_first)

    def _loss(self, predicted: Tensor, gains: Tensor, mask: Tensor) -> Tensor:
        return (mean_information_loss if self._inherits else information_loss)(predicted, gains, mask)

    def _predict(self, ordered: OrderedRows, found: Gains) -> Tensor:
        """AIP scores of the interactions of the context, [B, K]."""
        rows, tries = self.dataset.rows, ordered.rows[:, : found.gains.shape[1]]
        if self._inherits:
            features = self.frozen.features[tries]
        else:
            encoded = self.aip.encoder(self.dataset.clouds.select(ordered.clouds))
            cloud = ordered.cloud[:, : tries.shape[1]]
            flat = self.aip.encoder.at(encoded, cloud.flatten(), rows.point[tries].flatten())
            features = flat.reshape(*tries.shape, -1)
        return self.aip.action_scores(features, rows.xyz[tries], rows.frame[tries], found.latents, found.scores)


def train_aip(recipe: StageTrainer) -> TrainingResult:
    """Train AIP's critic, then its D; AAP stays as it is."""
    aip, config, pool = recipe.policy.aip.requires_grad_(True), recipe.config.aip, recipe.pool()
    frozen = FrozenAap.of(recipe.policy.aap, recipe.known)
    teacher = recipe.teacher(recipe.oracle if config.training == "inherited" else None)
    stage = AipStage(aip, recipe.dataset, recipe.parts, config, frozen, teacher)
    result = recipe.runner.train(stage, config, "aip")
    aip.eval().requires_grad_(False)
    critic = AipCritic(aip, recipe.known.pool(aip.encoder), frozen, config.top)
    affordance = recipe.affordance("aip", critic, config.affordance, pool, frozen)
    return recipe.runner.train_affordance(affordance, config.affordance, result)
