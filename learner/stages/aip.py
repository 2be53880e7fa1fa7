"""Stage 3: Adaptive Interaction Proposal, supervised by a frozen AAP.

Shapes: B ordered sets of interactions, n rows of each, K the longest context, Q points, S proposals.
"""

from dataclasses import InitVar, dataclass

import numpy as np
import torch
from torch import Tensor

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
    """Targets of the AIP critic, and what it is told: of C interactions that may come next after each context.

    Attributes:
        candidates: rows, [B, K, C].
        gains: what each is worth, nats, [B, K, C].
        latents: z of the contexts, [B, K, latent_width].
        scores: s^AAP_u|z of each, [B, K, C].
        mask: which count, [B, K, C].
    """

    candidates: Tensor
    gains: Tensor
    latents: Tensor
    scores: Tensor
    mask: Tensor


@dataclass(eq=False)
class AipStage:
    """Trains all of `Aip` but D (AdaAfford, AIP Action Scoring Loss); AAP stays as it is.

    The drop of the AAP loss is measured on rows of the same rollout that are no context at all, the same for every
    prefix, so that two losses differ by one interaction alone. Privileged: with a teacher, the loss is against what the
    oracle expects instead of single successes, which are ten coins a rollout that would drown the drop.

    With `config.target` "beliefs" no outcome is asked at all: an interaction is worth how far AAP expects its beliefs
    in these rows to move, by both outcomes that it may have. That depends on nothing that AIP cannot know, so it is
    learned with far less noise.
    """

    name = "aip"

    module: Aip
    dataset: Dataset
    parts: Split
    config: AipConfig
    frozen: FrozenAap
    teacher: InitVar[Teacher | None] = None

    def __post_init__(self, teacher: Teacher | None) -> None:
        self._inherits = self.config.training == "inherited"
        self._answers = teacher.scores if self._inherits and teacher is not None else self.dataset.rows.success
        if self._inherits:
            self.module.encoder.load_state_dict(self.frozen.aap.encoder.state_dict())

    def parameter_groups(self) -> list[ParameterGroup]:
        """All of AIP but D and what is inherited, at one rate; nothing of AAP."""
        others = [self.module.affordance_network(), *([self.module.encoder] if self._inherits else [])]
        left = {id(p) for module in others for p in module.parameters()}
        return [ParameterGroup(tuple(p for p in self.module.parameters() if id(p) not in left))]

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
        """What interactions are worth after each context, by the rows outside of all contexts."""
        context = ordered.longest_context(self.config.context)
        latents = self.frozen.latents(ordered.rows[:, :context])
        asked = ordered.asked(context)[:, -1]
        gains = self._happened if self.config.target == "loss" else self._expected
        return gains(ordered, latents, asked)

    def _happened(self, ordered: OrderedRows, latents: Tensor, asked: Tensor) -> Gains:
        """How much the interaction that came next lowered the AAP loss on the rows that are asked about."""
        context = latents.shape[1] - 1
        logits = self.frozen.logits(ordered.rows[:, None], latents[:, :, None])
        losses = action_scoring_losses(logits, self._answers[ordered.rows][:, None])
        counts = asked[:, None].to(losses.dtype)
        per_prefix = (losses * counts).sum(dim=-1) / counts.sum(dim=-1).clamp_min(1.0)
        own = torch.arange(context)
        mask = ordered.valid[:, :context] & asked.any(dim=1)[:, None]
        return Gains(
            ordered.rows[:, :context, None],
            information_gains(per_prefix)[..., None],
            latents[:, :-1],
            torch.sigmoid(logits[:, own, own])[..., None],
            mask[..., None],
        )

    def _expected(self, ordered: OrderedRows, latents: Tensor, asked: Tensor) -> Gains:
        """How far each interaction that may come next is expected to move AAP's beliefs in what is asked about."""
        rows, context, frozen = ordered.rows, latents.shape[1] - 1, self.frozen
        imagined = [frozen.imagined(rows, success) for success in (False, True)]
        # A candidate is not asked about itself.
        others = (asked[:, None] & ~torch.eye(rows.shape[1], dtype=torch.bool)).to(latents.dtype)
        gains, scores = [], []
        for k in range(context):
            believed, moved = frozen.expected_divergence(rows, rows[:, :k], latents[:, k, None], imagined)
            gains.append((moved * others).sum(dim=-1) / others.sum(dim=-1).clamp_min(1.0))
            scores.append(believed)
        mask = ordered.asked(context)[:, :-1] & (others > 0).any(dim=-1)[:, None]
        candidates = rows[:, None].expand(-1, context, -1)
        return Gains(candidates, torch.stack(gains, dim=1), latents[:, :-1], torch.stack(scores, dim=1), mask)

    def _order(self, rollouts: list[int], rng: np.random.Generator) -> OrderedRows:
        repeated = [number for number in rollouts for _ in range(self.config.draws)]
        return order_rows(self.dataset, repeated, self.config.rows_per_rollout, rng, self.config.continued_first)

    def _loss(self, predicted: Tensor, gains: Tensor, mask: Tensor) -> Tensor:
        return (mean_information_loss if self._inherits else information_loss)(predicted, gains, mask)

    def _predict(self, ordered: OrderedRows, found: Gains) -> Tensor:
        """AIP scores of the candidates, [B, K, C]."""
        data, candidates = self.dataset.rows, found.candidates
        if self._inherits:
            features = self.frozen.features[candidates]
        else:
            encoded = self.module.encoder(self.dataset.clouds.select(ordered.clouds))
            places = torch.searchsorted(ordered.clouds, data.cloud[candidates])
            flat = self.module.encoder.at(encoded, places.flatten(), data.point[candidates].flatten())
            features = flat.reshape(*candidates.shape, -1)
        told = (data.xyz[candidates], data.frame[candidates])
        return self.module.action_scores(features, *told, found.latents[:, :, None], found.scores)


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
