"""Baseline Where2Act-interaction: Where2Act learns to read four interactions that are spread over the object.

Shapes: B rollouts, n rows of each.
"""

from collections.abc import Sequence
from dataclasses import InitVar, dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures, FrozenPrior
from learner.data.sampling import Batch, OrderedRows, Split, draw, draw_flips, draw_turns, padded, spread
from learner.metrics import discrimination_in_chunks
from learner.settings import InteractionConfig
from learner.stages.affordance import AapCritic
from learner.stages.trainers import BaselineTraining, Load, RowCritic, StageTrainer, adaptive_critic
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import action_scoring_loss
from shared.policies.policy import Policy
from shared.policies.proposers import actionable_points, distances_to
from shared.policies.where2act_interaction import NAME, TRIES, Where2ActInteraction
from shared.types import Float, Float32

LEAST_ROWS = 2 * TRIES
"""Rows of a rollout that count as actionable at least; the paper's 50 points are more than a rollout has rows."""
VALIDATION_ROLLOUTS = 32
_VALIDATION_SEED = 23
_CHUNK = 4
"""Rollouts validated at once."""


@dataclass(eq=False)
class InteractionStage:
    """Trains all of `Where2ActInteraction` but D, on the loss of Where2Act's critic.

    The interactions are rows of the rollout, spread by furthest-point sampling over those at points that Where2Act
    takes for actionable; all other rows are predicted.
    """

    name = NAME

    module: Where2ActInteraction
    dataset: Dataset
    parts: Split
    config: InteractionConfig
    prior: InitVar[FrozenPrior]

    def __post_init__(self, prior: FrozenPrior) -> None:
        self._places = self.dataset.rows.xyz.numpy(force=True).astype(np.float64)
        self._actionability: Float32 = prior.actionability.numpy(force=True)

    def parameter_groups(self) -> list[ParameterGroup]:
        """The branch and the critic; the encoder, which Where2Act has trained, more slowly."""
        network = self.module
        old = tuple(network.encoder.parameters())
        # Four interactions are always there, so that the z of none is never learnt.
        left = {id(p) for p in (*old, *network.affordance_network().parameters(), network.empty_latent)}
        new = tuple(p for p in network.parameters() if id(p) not in left)
        return [ParameterGroup(new), ParameterGroup(old, self.config.inherited_rate)]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The critic's loss on a few rollouts."""
        chosen = draw(self.parts.train, self.config.batch_rollouts, rng)
        ordered = self.order(chosen, self.config.rows_per_rollout, rng)
        turns = draw_turns(len(chosen), self.config.augmentation, rng)
        flips = draw_flips(len(chosen), self.config.augmentation, rng)
        mine = share(len(chosen))
        total, ordered = int(ordered.valid.sum()), ordered.select(mine)
        logits, success, asked = self._predict(ordered, turns[mine], flips[mine])
        return StepResult({"critic": action_scoring_loss(logits, success, asked)}, total)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on; "score" is the cross entropy."""
        rng = np.random.default_rng(_VALIDATION_SEED)
        rollouts = spread(self.parts.validation, VALIDATION_ROLLOUTS)

        def judge(chunk: Sequence[int]) -> tuple[ArrayLike, ArrayLike]:
            ordered = self.order(chunk, self.config.rows_per_rollout, rng)
            logits, success, asked = self._predict(ordered)
            return torch.sigmoid(logits)[asked].numpy(force=True), success[asked].numpy(force=True)

        found = discrimination_in_chunks(rollouts, _CHUNK, judge)
        return {"score": found.bce, "f_score": found.f_score, "auc": found.auc, "base_rate": found.base_rate}

    def order(self, rollouts: Sequence[int], size: int, rng: np.random.Generator) -> OrderedRows:
        """Rows of rollouts in random order, but for the first `TRIES`, which are spread over the object."""
        orders = []
        for number in rollouts:
            rows = rng.permutation(self.dataset.rollouts[number].numpy(force=True))
            first = spread_over(self._places[rows], self._actionability[rows], min(TRIES, len(rows)), rng)
            orders.append(np.concatenate([rows[first], np.delete(rows, first)]))
        return padded(self.dataset, orders, size)

    def _predict(
        self, ordered: OrderedRows, turns: Tensor | None = None, flips: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of all rows after the interactions, successes, and which rows are no interactions, [B, n] each."""
        batch = Batch.of(self.dataset, ordered, turns, flips)
        context = ordered.longest_context(TRIES)
        features = batch.features(self.module.encoder)
        tries = (features, batch.xyz, batch.frame, batch.motion, batch.success, batch.details)
        codes, weights = self.module.interaction_codes(*(column[:, :context] for column in tries))
        latents = self.module.prefix_latents(codes, weights)[:, -1:]
        logits = self.module.action_logits(features, batch.xyz, batch.frame, latents)
        return logits, batch.success, ordered.asked(context)[:, -1]


def spread_over(places: Float, actionability: Float32, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of `count` rows by furthest-point sampling, from a random one of the actionable rows, [count].

    Args:
        places: [n, 3].
        actionability: [n].
        count: at most n.
        rng: draws the first.
    """
    among = actionable_points(actionability, max(LEAST_ROWS, count))
    chosen = [int(rng.choice(among))]
    while len(chosen) < count:
        distances = distances_to(places[among], places[chosen])
        assert distances is not None
        # Two rows may touch one point, but no row is tried twice.
        distances[np.isin(among, chosen)] = -1.0
        chosen.append(int(among[distances.argmax()]))
    return np.array(chosen, dtype=np.int64)


def _train(recipe: StageTrainer, config: InteractionConfig) -> TrainingResult:
    network = recipe.policy.baseline(NAME, Where2ActInteraction).requires_grad_(True)
    pool, prior = recipe.pool(), FrozenPrior.of(recipe.policy.prior, recipe.known)
    stage = InteractionStage(network, recipe.dataset, recipe.parts, config, prior)
    result = recipe.runner.train(stage, config, NAME)
    frozen = FrozenAap.of(network, recipe.known)
    # The mean of all proposals' scores, as Where2Act has it, and not of the best.
    critic = AapCritic(frozen, config.affordance.proposals)
    settings = config.affordance.model_copy(update={"context": TRIES})
    affordance = recipe.affordance(NAME, critic, settings, pool, frozen, stage.order, TRIES)
    return recipe.runner.train_affordance(affordance, settings, result)


def _row_critic(policy: Policy, known: FrozenFeatures) -> RowCritic:
    return adaptive_critic(FrozenAap.of(policy.baseline(NAME, Where2ActInteraction), known))


def _load(config: InteractionConfig) -> Load:
    return Load(config.batch_rollouts, config.batch_rollouts * config.rows_per_rollout * (TRIES + 1), 1)


TRAINING = BaselineTraining(InteractionConfig, _train, _row_critic, _load, table="interaction")
