"""Stage 2: Adaptive Affordance Prediction, as in the paper or taught by an oracle that is given the hidden facts.

Shapes: I interactions, B rollouts, n rows of each, K the longest context.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from safetensors.torch import save
from torch import Tensor, nn

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures
from learner.data.sampling import (
    Batch,
    OrderedRows,
    Split,
    draw,
    draw_flips,
    draw_turns,
    flip_frames,
    order_rows,
    spread,
)
from learner.metrics import discrimination, discrimination_in_chunks
from learner.settings import AapConfig
from learner.stages.affordance import AapCritic
from learner.stages.oracle import OracleCritic, Teacher
from learner.stages.trainers import ORACLE_FILE, ORACLE_FOLDER, StageTrainer
from learner.training.data_parallel import rank, share
from learner.training.loop import ParameterGroup, StepResult, TrainingResult
from learner.training.losses import action_scoring_loss, distillation_loss
from shared.io.files import write_atomically
from shared.networks.aap import Aap
from shared.networks.actions import without_details
from shared.networks.pointnet2 import PointNet2
from shared.seeds import torch_seed

VALIDATION_ROLLOUTS = 32
FROZEN_VALIDATION_ROLLOUTS = 192
"""Where no cloud needs to be encoded, more cost next to nothing, and what is best is better known."""
_VALIDATION_SEED = 20
CURVE = (0, 1, 2, 4, 8)
"""Numbers of interactions after which a validation says how well AAP does, as far as its context reaches."""
CURVE_FIGURES = ("bce", "f_score", "auc", "calibration_error")
_CHUNK = 4
"""Rollouts validated at once."""


@dataclass(frozen=True, slots=True)
class SeenRows:
    """Ordered rows as AAP sees them: interactions and questions alike.

    Attributes:
        features: of the points, [B, n, point_width].
        xyz: p less the middle of what may be moved, [B, n, 3].
        frame: approach and forward, and the pinch profile where networks are told it, [B, n, 6 or more].
        motion: m, [B, n].
        success: r as 0 or 1, [B, n].
        details: of the outcomes, [B, n, DETAIL_WIDTH].
    """

    features: Tensor
    xyz: Tensor
    frame: Tensor
    motion: Tensor
    success: Tensor
    details: Tensor

    @classmethod
    def of(cls, batch: Batch, encoder: PointNet2) -> "SeenRows":
        """With their clouds encoded anew, so that the encoder learns."""
        features = batch.features(encoder)
        return cls(features, batch.xyz, batch.frame, batch.motion, batch.success, batch.details)


class AapStage:
    """Trains all of `Aap` but D (AdaAfford, AAP Action Scoring Loss).

    A random subset of a rollout's interactions is the context; all rows that are not in it are predicted, after each of
    its prefixes and after none.

    Privileged training leaves the point encoder as it is, so that a step may see five times the rollouts: what is to be
    learnt is how rollouts differ, and with few of them a step AAP learnt their clouds by heart instead (27% of the gap
    to the oracle closed with four interactions; 44% with the encoder left alone, in a tenth of the time). From an
    oracle, scores and z are drawn to the oracle's as well.
    """

    name = "aap"

    def __init__(
        self,
        aap: Aap,
        known: FrozenFeatures,
        parts: Split,
        config: AapConfig,
        teacher: Teacher | None = None,
        *,
        trained: bool = False,
    ) -> None:
        """Prepare a training.

        Args:
            aap: what is trained.
            known: the interactions, and features of them for privileged training, which leaves the encoder as it is.
            parts: which to learn from, and which to judge by.
            config: how.
            teacher: what an oracle says of the rows; privileged training only.
            trained: whether `aap` is fine-tuned.
        """
        self.module: nn.Module = aap
        self.aap = aap
        self.dataset = known.dataset
        self.parts = parts
        self.config = config
        self._features = self._teacher = None
        self._trained = trained
        if config.training == "privileged":
            self._features = known.rows(aap.encoder)
            self._teacher = teacher

    def parameter_groups(self) -> list[ParameterGroup]:
        """All of AAP but D, and its encoder where that stays as it is; what was trained before moves more slowly."""
        left = [self.aap.affordance_network(), *([] if self._features is None else [self.aap.encoder])]
        fixed = {id(p) for part in left for p in part.parameters()}
        trained = [p for p in self.aap.parameters() if id(p) not in fixed]
        if self._features is None:
            return [ParameterGroup(tuple(trained))]
        if self._trained:
            return [ParameterGroup(tuple(trained), self.config.inherited_rate)]
        inherited = {id(p) for part in (self.aap.action_encoder, self.aap.critic_head) for p in part.parameters()}
        old = tuple(p for p in trained if id(p) in inherited)
        new = tuple(p for p in trained if id(p) not in inherited)
        return [ParameterGroup(new), ParameterGroup(old, self.config.inherited_rate)]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The losses on a few rollouts."""
        config = self.config
        rollouts = draw(self.parts.train, config.batch_rollouts, rng)
        ordered = order_rows(self.dataset, rollouts, config.rows_per_rollout, rng, config.continued_first)
        context = ordered.longest_context(config.context)
        turns = draw_turns(len(rollouts), config.augmentation, rng)
        flips = draw_flips(len(rollouts), config.augmentation, rng)
        mine = share(len(rollouts))
        total, ordered = int(ordered.valid.sum()), ordered.select(mine)
        seen = self._see(ordered, turns[mine], flips[mine])
        if self.aap.config.outcome_details:
            # Drawn for all rollouts of the step, so that several processes draw alike.
            unknown = torch.as_tensor(rng.random((2, len(rollouts), 1)) < config.unknown_details)[:, mine]
            seen = replace(seen, details=without_details(seen.details, *unknown))
        logits, latents = predict(self.aap, seen, context)
        asked = ordered.asked(context)
        losses = {"critic": action_scoring_loss(logits, seen.success[:, None], asked)}
        if self._teacher is not None:
            surer = self._teacher.scores[ordered.rows][:, None]
            # Interactions are on one part, so that what is hidden, and its z, differ between states at the most.
            told = self._teacher.latents[ordered.rows[:, 0]]
            losses["imitation"] = config.imitation * action_scoring_loss(logits, surer, asked)
            losses["distillation"] = config.distillation * distillation_loss(latents, told, asked.any(-1))
        return StepResult(losses, total)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on after each number of interactions; "score" is over all prefixes."""
        rng = np.random.default_rng(_VALIDATION_SEED)
        count = VALIDATION_ROLLOUTS if self._features is None else FROZEN_VALIDATION_ROLLOUTS
        rollouts = spread(self.parts.validation, count)
        scores: dict[int, list[Tensor]] = {tries: [] for tries in CURVE if tries <= self.config.context}
        labels, losses = [], []
        for start in range(0, len(rollouts), _CHUNK):
            chunk, config = rollouts[start : start + _CHUNK], self.config
            ordered = order_rows(self.dataset, chunk, config.rows_per_rollout, rng, config.continued_first)
            context = ordered.longest_context(self.config.context)
            seen = self._see(ordered)
            logits, _ = predict(self.aap, seen, context)
            success, asked = seen.success, ordered.asked(context)
            losses.append(action_scoring_loss(logits, success[:, None], asked))
            asked_last = asked[:, -1]
            for tries, kept in scores.items():
                kept.append(torch.sigmoid(logits[:, min(tries, context)][asked_last]))
            labels.append(success[asked_last])
        known = torch.cat(labels).numpy(force=True)
        figures = {"score": float(torch.stack(losses).mean()), "base_rate": float(known.mean())}
        for tries, kept in scores.items():
            found = discrimination(torch.cat(kept).numpy(force=True), known)
            figures |= {f"{name}_after_{tries}": getattr(found, name) for name in CURVE_FIGURES}
        return figures

    def _see(self, ordered: OrderedRows, turns: Tensor | None = None, flips: Tensor | None = None) -> SeenRows:
        """The rows, flipped, and turned where their clouds are encoded anew."""
        if self._features is None:
            return SeenRows.of(Batch.of(self.dataset, ordered, turns, flips), self.aap.encoder)
        index, rows = ordered.rows, self.dataset.rows
        frame = rows.frame[index] if flips is None else flip_frames(flips, rows.frame[index])
        told = (rows.motion, rows.success, rows.details)
        return SeenRows(self._features[index], rows.xyz[index], frame, *(column[index] for column in told))


@dataclass(eq=False)
class OracleStage:
    """Trains the oracle critic, told the hidden facts outright, on the AAP action scoring loss; not in the paper."""

    name = "oracle"

    module: OracleCritic
    dataset: Dataset
    parts: Split
    config: AapConfig

    def parameter_groups(self) -> list[ParameterGroup]:
        """The oracle and the critic."""
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The critic's loss on a few rollouts."""
        chosen = draw(self.parts.train, self.config.oracle_batch_rollouts, rng)
        ordered = order_rows(self.dataset, chosen, self.config.rows_per_rollout, rng)
        turns = draw_turns(len(chosen), self.config.augmentation, rng)
        flips = draw_flips(len(chosen), self.config.augmentation, rng)
        mine = share(len(chosen))
        total, ordered = int(ordered.valid.sum()), ordered.select(mine)
        batch = Batch.of(self.dataset, ordered, turns[mine], flips[mine])
        loss = action_scoring_loss(self.module.logits(batch), batch.success, ordered.valid)
        return StepResult({"critic": loss}, total)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """The oracle critic's figures on objects not trained on: a bound for what adaptation can reach."""
        rng = np.random.default_rng(_VALIDATION_SEED)
        rollouts = spread(self.parts.validation, VALIDATION_ROLLOUTS)

        def judge(chunk: Sequence[int]) -> tuple[ArrayLike, ArrayLike]:
            ordered = order_rows(self.dataset, chunk, self.config.rows_per_rollout, rng)
            batch = Batch.of(self.dataset, ordered)
            scores = torch.sigmoid(self.module.logits(batch))[ordered.valid]
            return scores.numpy(force=True), batch.success[ordered.valid].numpy(force=True)

        found = discrimination_in_chunks(rollouts, _CHUNK, judge)
        figures = {name: getattr(found, name) for name in CURVE_FIGURES}
        return {"score": found.bce, "base_rate": found.base_rate} | figures


def predict(aap: Aap, seen: SeenRows, context: int) -> tuple[Tensor, Tensor]:
    """Logits of the scores of all rows after every prefix of the first K = `context` of them, and z of the prefixes.

    These are [B, K + 1, n] and [B, K + 1, latent_width].
    """
    tries = (seen.features, seen.xyz, seen.frame, seen.motion, seen.success, seen.details)
    latents = aap.prefix_latents(*aap.interaction_codes(*(x[:, :context] for x in tries)))
    xyz, frames = seen.xyz[:, None], seen.frame[:, None]
    return aap.action_logits(seen.features[:, None], xyz, frames, latents[:, :, None]), latents


def train_aap(recipe: StageTrainer) -> TrainingResult:
    """Train the oracle, if the settings ask for it, then AAP, then its D."""
    aap, config, pool = recipe.policy.aap.requires_grad_(True), recipe.config.aap, recipe.pool()
    # An AAP that has been trained has a z of its own, which a new oracle would only disturb; the old one may teach.
    trained, oracle = "aap" in recipe.policy.trained, recipe.oracle
    if config.training == "privileged" and not trained:
        oracle = _train_oracle(recipe)
    teacher = recipe.teacher(oracle if config.training == "privileged" else None)
    stage = AapStage(aap, recipe.known, recipe.parts, config, teacher, trained=trained)
    result = recipe.runner.train(stage, config, "aap")
    frozen = FrozenAap.of(aap, recipe.known)
    affordance = recipe.affordance("aap", AapCritic(frozen, config.top), config.affordance, pool, frozen)
    return recipe.runner.train_affordance(affordance, config.affordance, result)


def _train_oracle(recipe: StageTrainer) -> OracleCritic:
    """Train the oracle critic, save it, and start AAP from it."""
    # Drawn on the CPU, so that the first weights are the same whatever device trains them.
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        # This text is part of the seed: with another one, weights of earlier releases could not be made again.
        torch.manual_seed(torch_seed(recipe.config.seed, "learner.oracle") % 2**32)
        critic = OracleCritic(copy.deepcopy(recipe.policy.aap), recipe.dataset.rows.facts.shape[1])
    critic.to(recipe.runner.hardware.device)
    config = recipe.config.aap
    settings = config.model_copy(update={"steps": config.oracle_steps, "learning_rate": config.oracle_learning_rate})
    stage = OracleStage(critic, recipe.dataset, recipe.parts, config)
    recipe.runner.train(stage, settings, "oracle", ORACLE_FOLDER)
    if rank() == 0:
        weights = save({name: tensor.contiguous() for name, tensor in critic.state_dict().items()})
        write_atomically(recipe.runner.out / ORACLE_FILE, weights)
    for inherited in ("encoder", "action_encoder", "critic_head"):
        getattr(recipe.policy.aap, inherited).load_state_dict(getattr(critic.aap, inherited).state_dict())
    return critic
