"""The affordance networks D: each learns what its frozen critic makes of the prior's proposals at a point.

They are trained when their critic is done. Beside it, they would chase a critic that moves, and their loss would have a
say in which critic is kept. A step needs no point encoder, since features under frozen weights are computed once.

Shapes: B rollouts, K the longest context, Q questions (a point and a z), S proposals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learner.configuration import AffordanceConfig
from learner.data import Dataset, Split
from learner.frozen import FrozenAap
from learner.losses import actionability_loss, mean_score, top_score
from learner.metrics import rank_correlation
from learner.sampling import OrderedRows, ProposalPool, draw_numbers, order_rows, spread
from learner.sharing import share
from learner.training import ParameterGroup, StepResult
from shared.networks.aip import Aip
from shared.networks.prior import Prior

RowOrder = Callable[[Sequence[int], int, np.random.Generator], OrderedRows]
"""Orders rows of rollouts, at most so many of each."""
VALIDATION_ROLLOUTS = 32
_VALIDATION_SEED = 22
_VALIDATION_BATCHES = 8


@dataclass(frozen=True, slots=True)
class Questions:
    """Points that a D network is asked about.

    Attributes:
        cloud: [Q], index of the cloud.
        slot: [Q], which of the pool's points.
        point: p less the middle of what may be moved, [Q, 3].
        frames: proposals there, [Q, S, 6].
        latents: z, [Q, latent_width]; of no tries where there is no AAP yet.
    """

    cloud: Tensor
    slot: Tensor
    point: Tensor
    frames: Tensor
    latents: Tensor

    def select(self, places: slice) -> "Questions":
        """Some of them."""
        return Questions(
            self.cloud[places], self.slot[places], self.point[places], self.frames[places], self.latents[places]
        )


class Answer(Protocol):
    """A D network and the critic that supervises it."""

    module: nn.Module
    """All that is trained, and nothing else."""

    def __call__(self, questions: Questions) -> tuple[Tensor, Tensor]:
        """Actionability as D predicts it, and what the critic makes of it, [Q] each."""
        ...


class AffordanceStage:
    """Trains one D network: L1 to its critic (Where2Act; AdaAfford, AAP and AIP Actionability Scoring Loss)."""

    def __init__(
        self,
        name: str,
        answer: Answer,
        dataset: Dataset,
        parts: Split,
        config: AffordanceConfig,
        pool: ProposalPool,
        frozen: FrozenAap | None = None,
        order: RowOrder | None = None,
        shortest: int = 0,
    ) -> None:
        """Collect what a stage needs.

        Args:
            name: of the stage.
            answer: D, and its critic.
            dataset: the interactions.
            parts: which of them to learn from.
            config: how.
            pool: points and proposals.
            frozen: whose z is asked about; None for Where2Act, which has none.
            order: draws the tries; at random where it is not given.
            shortest: the fewest tries whose z is asked about, where a rollout has as many.
        """
        self.name = name
        self.module = answer.module.requires_grad_(True)
        self.answer = answer
        self.dataset = dataset
        self.parts = parts
        self.config = config
        self.pool = pool
        self.frozen = frozen
        self.order = order or partial(order_rows, dataset)
        self.shortest = shortest

    def parameter_groups(self) -> list[ParameterGroup]:
        """D alone."""
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The loss at some points of a few rollouts' clouds."""
        train = self.parts.train
        chosen = draw_numbers(len(train), min(self.config.batch_rollouts, len(train)), rng)
        questions = self._questions([train[number] for number in chosen], rng)
        predicted, target = self.answer(questions.select(share(len(questions.cloud))))
        return StepResult({"affordance": actionability_loss(predicted, target)}, len(questions.cloud))

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """L1 and rank correlation with the critic on objects not trained on; "of_median" is a constant's L1."""
        rng = np.random.default_rng(_VALIDATION_SEED)
        rollouts = spread(self.parts.validation, VALIDATION_ROLLOUTS)
        pairs = [self.answer(self._questions(rollouts, rng)) for _ in range(_VALIDATION_BATCHES)]
        predicted, target = (torch.cat(column) for column in zip(*pairs, strict=True))
        score = float(actionability_loss(predicted, target))
        return {
            "score": score,
            "affordance": score,
            "affordance_of_median": float((target - target.median()).abs().mean()),
            "affordance_rank_correlation": rank_correlation(predicted.numpy(force=True), target.numpy(force=True)),
        }

    def _questions(self, rollouts: Sequence[int], rng: np.random.Generator) -> Questions:
        config, count = self.config, self.config.points
        ordered = self.order(rollouts, config.context + 1, rng)
        drawn = rng.integers(0, len(rollouts), count)
        which = torch.as_tensor(drawn)
        row = torch.as_tensor(_below(ordered.valid.sum(dim=1).numpy(force=True)[drawn], rng))
        cloud = ordered.clouds[ordered.cloud[which, row]]
        slot = torch.as_tensor(rng.integers(0, self.pool.point.shape[1], count))
        latents = torch.zeros(count, 0)
        if self.frozen is not None:
            context = ordered.longest_context(config.context)
            prefixes = self.frozen.latents(ordered.rows[:, :context])
            latents = prefixes[which, torch.as_tensor(rng.integers(min(self.shortest, context), context + 1, count))]
        frames = self.pool.draw(cloud, slot, config.proposals, rng)
        place = self.dataset.clouds.points[cloud, self.pool.point[cloud, slot]] - self.dataset.middles[cloud]
        return Questions(cloud, slot, place, frames, latents)


class PriorAnswer:
    """Where2Act: the mean score of all proposals."""

    def __init__(self, prior: Prior, pool: ProposalPool) -> None:
        self.module: nn.Module = prior.affordance_head
        self.prior = prior
        self.pool = pool

    def __call__(self, questions: Questions) -> tuple[Tensor, Tensor]:
        """Predicted and target, [Q] each."""
        features = self.pool.features[questions.cloud, questions.slot]
        with torch.no_grad():
            logits = self.prior.action_logits(features[:, None], questions.point[:, None], questions.frames)
        return self.prior.actionability(features), mean_score(torch.sigmoid(logits))


class AapAnswer:
    """AAP: the mean of the best scores that the critic gives under z."""

    def __init__(self, frozen: FrozenAap, top: int) -> None:
        self.module: nn.Module = frozen.aap.affordance_network()
        self.frozen = frozen
        self.top = top

    def __call__(self, questions: Questions) -> tuple[Tensor, Tensor]:
        """Predicted and target, [Q] each."""
        features, scores = aap_scores(self.frozen, questions)
        return self.frozen.aap.actionability(features, questions.point, questions.latents), top_score(scores, self.top)


class AipAnswer:
    """AIP: the mean of the best AIP scores under z."""

    def __init__(self, aip: Aip, features: Tensor, frozen: FrozenAap, top: int) -> None:
        self.module: nn.Module = nn.ModuleDict({"encoder": aip.actionability_encoder, "head": aip.affordance_head})
        self.aip = aip
        self.features = features
        self.frozen = frozen
        self.top = top

    def __call__(self, questions: Questions) -> tuple[Tensor, Tensor]:
        """Predicted and target, [Q] each."""
        aap_features, scores = aap_scores(self.frozen, questions)
        features, latents = self.features[questions.cloud, questions.slot], questions.latents
        with torch.no_grad():
            believed = self.frozen.aap.actionability(aap_features, questions.point, latents)
            gains = self.aip.action_scores(
                features[:, None], questions.point[:, None], questions.frames, latents[:, None], scores
            )
        return self.aip.actionability(features, latents, believed), top_score(gains, self.top)


@torch.no_grad()
def aap_scores(frozen: FrozenAap, questions: Questions) -> tuple[Tensor, Tensor]:
    """AAP's features of the points, [Q, feature_width], and its scores of the proposals there, [Q, S]."""
    assert frozen.pool_features is not None, "the points asked about are those of a pool"
    features = frozen.pool_features[questions.cloud, questions.slot]
    logits = frozen.aap.action_logits(
        features[:, None], questions.point[:, None], questions.frames, questions.latents[:, None]
    )
    return features, torch.sigmoid(logits)


def _below(limits: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.integers(0, limits)
