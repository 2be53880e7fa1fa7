"""The affordance networks D: each learns what its frozen critic makes of the prior's proposals at a point.

They are trained when their critic is done. Beside it, they would chase a critic that moves, and their loss would have a
say in which critic is kept. The critic answers all questions before the first step: a hundred scores a question cost
far more than a step of D, which may then meet a question several times.

Shapes: B rollouts, K the longest context, Q questions (a point and a z), S proposals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, ProposalPool
from learner.data.sampling import OrderedRows, Split, draw, order_rows
from learner.metrics import rank_correlation
from learner.settings import AffordanceConfig
from learner.training.data_parallel import share
from learner.training.loop import ParameterGroup, StepResult
from learner.training.losses import (
    actionability_loss,
    mean_actionability_loss,
    mean_information_loss,
    mean_score,
    top_score,
)
from shared.networks.aip import Aip
from shared.networks.prior import Prior

RowOrder = Callable[[Sequence[int], int, np.random.Generator], OrderedRows]
"""Orders rows of rollouts, at most so many of each."""
VALIDATION_QUESTIONS = 1_024
_VALIDATION_SEED = 22
_CHUNK = 64
"""Questions whose proposals are scored at once; bounds memory, and what is scored stays in the processor's cache."""


@dataclass(frozen=True, slots=True)
class Questions:
    """Points that a D network is asked about.

    Attributes:
        cloud: [Q], index of the cloud.
        slot: [Q], which of the pool's points.
        point: p less the middle of what may be moved, [Q, 3].
        frames: proposals there, [Q, S, 6].
        latents: z, [Q, latent_width]; of no interactions where there is no AAP yet.
    """

    cloud: Tensor
    slot: Tensor
    point: Tensor
    frames: Tensor
    latents: Tensor


@dataclass(frozen=True, slots=True)
class Answered:
    """What a critic made of questions, and what D is told of them.

    Attributes:
        told: D's inputs, [Q, ...] each.
        target: what D is to say, [Q].
    """

    told: tuple[Tensor, ...]
    target: Tensor

    def select(self, numbers: Tensor) -> "Answered":
        """Some of them."""
        return Answered(tuple(each[numbers] for each in self.told), self.target[numbers])


class Critic(Protocol):
    """A D network and the critic that supervises it."""

    module: nn.Module
    """All that is trained, and nothing else."""

    def answer(self, questions: Questions) -> Answered:
        """What D is told of the questions, and what the critic makes of them."""
        ...

    def predict(self, *told: Tensor) -> Tensor:
        """Actionability as D predicts it, [Q]."""
        ...

    def mean_loss(self, predicted: Tensor, target: Tensor) -> Tensor:
        """A loss that is least at the mean."""
        ...


class AffordanceStage:
    """Trains one D network on its critic's answers (Where2Act; AdaAfford, AAP and AIP Actionability Scoring Loss)."""

    def __init__(
        self,
        name: str,
        critic: Critic,
        dataset: Dataset,
        parts: Split,
        config: AffordanceConfig,
        pool: ProposalPool,
        rng: np.random.Generator,
        frozen: FrozenAap | None = None,
        order: RowOrder | None = None,
        shortest: int = 0,
    ) -> None:
        """Have the critic answer all questions.

        Args:
            name: of the stage.
            critic: D, and its critic.
            dataset: the interactions.
            parts: which of them to learn from.
            config: how.
            pool: points and proposals.
            rng: draws the questions to learn from.
            frozen: whose z is asked about; None for Where2Act, which has none.
            order: draws the interactions; at random where it is not given.
            shortest: the fewest interactions whose z is asked about, where a rollout has as many.
        """
        self.name = name
        self.module = critic.module.requires_grad_(True)
        self.critic = critic
        self.dataset = dataset
        self.config = config
        self.pool = pool
        self.frozen = frozen
        self.order = order or partial(order_rows, dataset)
        self.shortest = shortest
        self._loss = actionability_loss if config.loss == "published" else critic.mean_loss
        self._train = self._ask(parts.train, config.questions, rng)
        self._validation = self._ask(parts.validation, VALIDATION_QUESTIONS, np.random.default_rng(_VALIDATION_SEED))

    def parameter_groups(self) -> list[ParameterGroup]:
        """D alone."""
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The loss on some of the questions."""
        drawn = draw(range(self.config.questions), self.config.points, rng)
        asked = self._train.select(torch.as_tensor(drawn[share(len(drawn))]))
        return StepResult({"affordance": self._loss(self.critic.predict(*asked.told), asked.target)}, len(drawn))

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Loss and rank correlation with the critic on objects not trained on, and the loss of the best constant."""
        target = self._validation.target
        predicted = self.critic.predict(*self._validation.told)
        constant = target.median() if self.config.loss == "published" else target.mean()
        score = float(self._loss(predicted, target))
        return {
            "score": score,
            "affordance": score,
            "affordance_of_constant": float(self._loss(constant.expand_as(target), target)),
            "affordance_rank_correlation": rank_correlation(predicted.numpy(force=True), target.numpy(force=True)),
        }

    @torch.no_grad()
    def _ask(self, rollouts: Sequence[int], count: int, rng: np.random.Generator) -> Answered:
        """Draw questions about rollouts, each with a z of some of its interactions, and have them answered."""
        ordered = self.order(rollouts, self.config.context + 1, rng)
        drawn = rng.integers(0, len(rollouts), count)
        which = torch.as_tensor(drawn)
        row = torch.as_tensor(rng.integers(0, ordered.valid.sum(dim=1).numpy(force=True)[drawn]))
        cloud = ordered.clouds[ordered.cloud[which, row]]
        slot = torch.as_tensor(rng.integers(0, self.pool.point.shape[1], count))
        place = self.dataset.clouds.points[cloud, self.pool.point[cloud, slot]] - self.dataset.middles[cloud]
        latents = self._latents(ordered, which, rng)
        chunks = []
        for start in range(0, count, _CHUNK):
            here = slice(start, start + _CHUNK)
            frames = self.pool.draw(cloud[here], slot[here], self.config.proposals, rng)
            chunks.append(self.critic.answer(Questions(cloud[here], slot[here], place[here], frames, latents[here])))
        told = zip(*(chunk.told for chunk in chunks), strict=True)
        return Answered(tuple(torch.cat(each) for each in told), torch.cat([chunk.target for chunk in chunks]))

    def _latents(self, ordered: OrderedRows, which: Tensor, rng: np.random.Generator) -> Tensor:
        """The z of the first interactions of some of the rollouts, of which there may be none, [Q, latent_width]."""
        if self.frozen is None:
            return torch.zeros(len(which), 0)
        context = ordered.longest_context(self.config.context)
        prefixes = self.frozen.latents(ordered.rows[:, :context])
        lengths = rng.integers(min(self.shortest, context), context + 1, len(which))
        return prefixes[which, torch.as_tensor(lengths)]


class PriorCritic:
    """Where2Act: the mean score of all proposals."""

    def __init__(self, prior: Prior, pool: ProposalPool) -> None:
        self.module: nn.Module = prior.affordance_network()
        self.prior = prior
        self.pool = pool

    def answer(self, questions: Questions) -> Answered:
        """Features and places, and the mean of the scores."""
        features = self.pool.features[questions.cloud, questions.slot]
        logits = self.prior.action_logits(features[:, None], questions.point[:, None], questions.frames)
        return Answered((features, questions.point), mean_score(torch.sigmoid(logits)))

    def predict(self, *told: Tensor) -> Tensor:
        """a_p."""
        return self.prior.actionability(*told)

    mean_loss = staticmethod(mean_actionability_loss)


class AapCritic:
    """AAP: the mean of the best scores that the critic gives under z."""

    def __init__(self, frozen: FrozenAap, top: int) -> None:
        self.module: nn.Module = frozen.aap.affordance_network()
        self.frozen = frozen
        self.top = top

    def answer(self, questions: Questions) -> Answered:
        """Features, places and z, and the mean of the best scores."""
        features, scores = aap_scores(self.frozen, questions)
        return Answered((features, questions.point, questions.latents), top_score(scores, self.top))

    def predict(self, *told: Tensor) -> Tensor:
        """a_p|z."""
        return self.frozen.aap.actionability(*told)

    mean_loss = staticmethod(mean_actionability_loss)


class AipCritic:
    """AIP: the mean of the best AIP scores under z."""

    def __init__(self, aip: Aip, features: Tensor, frozen: FrozenAap, top: int) -> None:
        self.module: nn.Module = aip.affordance_network()
        self.aip = aip
        self.features = features
        self.frozen = frozen
        self.top = top

    def answer(self, questions: Questions) -> Answered:
        """Features, places, z and what AAP makes of the points, and the mean of the best scores."""
        aap_features, scores = aap_scores(self.frozen, questions)
        features, latents = self.features[questions.cloud, questions.slot], questions.latents
        believed = self.frozen.aap.actionability(aap_features, questions.point, latents)
        gains = self.aip.action_scores(
            features[:, None], questions.point[:, None], questions.frames, latents[:, None], scores
        )
        return Answered((features, questions.point, latents, believed), top_score(gains, self.top))

    def predict(self, *told: Tensor) -> Tensor:
        """a^AIP_p|z."""
        return self.aip.actionability(*told)

    mean_loss = staticmethod(mean_information_loss)


def aap_scores(frozen: FrozenAap, questions: Questions) -> tuple[Tensor, Tensor]:
    """AAP's features of the points, [Q, point_width], and its scores of the proposals there, [Q, S]."""
    features = frozen.pool_features[questions.cloud, questions.slot]
    logits = frozen.aap.action_logits(
        features[:, None], questions.point[:, None], questions.frames, questions.latents[:, None]
    )
    return features, torch.sigmoid(logits)
