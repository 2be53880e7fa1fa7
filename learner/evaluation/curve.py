"""The adaptation curve: what critics know of stored rollouts after 0, 1, 2, ... interactions.

Where2Act and the oracle are its bounds.

Offline: half of a rollout's own rows are candidates for interactions, the other half are the questions. The questions
are the same for all critics and after every number of interactions, so that two figures differ by critic and
interactions alone.

Shapes: R rollouts times draws, n rows of each (padded), c candidates of each, K the most interactions, Q questions in
all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures, FrozenPrior
from learner.data.sampling import OrderedRows, order_rows
from learner.evaluation.critics import OracleScores
from learner.metrics import correlation
from learner.stages.oracle import OracleCritic
from learner.training.losses import action_scoring_losses
from shared.networks.aip import Aip
from shared.networks.prior import Prior

_CHUNK = 16

CriticKind = Literal["where2act", "random", "aip", "information", "oracle"]
"""Where2Act, which knows no interactions; AAP after interactions taken from the candidates at random, by AIP, or by
what AAP expects to learn from them; the oracle, which is told the hidden facts."""


@dataclass(frozen=True, slots=True)
class Asked:
    """Whose answer it is, and after how many interactions."""

    critic: CriticKind
    tries: int


@dataclass(frozen=True, slots=True)
class Answers:
    """What critics say to the same questions.

    Attributes:
        labels: whether the interaction succeeded, [Q].
        objects: whose interaction it was, [Q].
        scores: probabilities, [Q] each.
    """

    labels: NDArray[np.bool_]
    objects: NDArray[np.str_]
    scores: Mapping[Asked, NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Candidates:
    """Rollouts cut into what may be tried and what is asked.

    Attributes:
        ordered: R rollouts in random orders.
        rollouts: number of the rollout, [R].
        count: c; the rows from there on are questions.
    """

    ordered: OrderedRows
    rollouts: tuple[int, ...]
    count: int

    @classmethod
    def of(cls, dataset: Dataset, rollouts: Sequence[int], draws: int, seed: int) -> "Candidates":
        """Each rollout `draws` times in other orders; those shorter than half of the longest are left out."""
        longest = max(len(dataset.rollouts[number]) for number in rollouts)
        enough = [number for number in rollouts if 2 * len(dataset.rollouts[number]) > longest]
        chosen = tuple(number for number in enough for _ in range(draws))
        ordered = order_rows(dataset, chosen, longest, np.random.default_rng(seed))
        return cls(ordered, chosen, longest // 2)

    @property
    def rows(self) -> Tensor:
        """Of the data set, [R, c]; all are there, since no kept rollout is shorter."""
        return self.ordered.rows[:, : self.count]

    @property
    def questions(self) -> Tensor:
        """Which ordered rows are asked about, [R, n]."""
        asked = self.ordered.valid.clone()
        asked[:, : self.count] = False
        return asked


def answer(
    known: FrozenFeatures,
    candidates: Candidates,
    frozen: FrozenAap,
    prior: Prior,
    aip: Aip | None = None,
    oracle: OracleCritic | None = None,
    tries: Sequence[int] = (0, 1, 2, 4),
) -> Answers:
    """Ask critics about the questions.

    Args:
        known: of the interactions.
        candidates: of rollouts whose objects nothing was trained on.
        frozen: the AAP.
        prior: Where2Act.
        aip: to choose interactions; None: random interactions alone.
        oracle: a critic that is told the hidden facts.
        tries: numbers of interactions.
    """
    dataset, ordered, asked = known.dataset, candidates.ordered, candidates.questions
    index = ordered.rows[asked]
    owner = np.array([dataset.objects[number] for number in candidates.rollouts])
    scores = {Asked("where2act", 0): FrozenPrior.of(prior, known).scores[index]}
    most = max(tries)
    chosen: dict[CriticKind, Tensor] = {"random": candidates.rows[:, :most]}
    if aip is not None:
        chosen["aip"] = tries_by_aip(known, candidates.rows, frozen, aip, most)
    chosen["information"] = tries_by_information(candidates.rows, frozen, most)
    for critic, made in chosen.items():
        latents = frozen.latents(made)
        for number in tries:
            scores[Asked(critic, number)] = _scores(dataset, ordered.rows, frozen, latents[:, number])[asked]
    if oracle is not None:
        scores[Asked("oracle", 0)] = OracleScores(oracle, known)(index, torch.zeros(0, dtype=torch.long))
    return Answers(
        labels=dataset.rows.success[index].numpy(force=True) > 0.5,
        objects=owner.repeat(asked.sum(dim=1).numpy()),
        scores={whose: found.numpy(force=True) for whose, found in scores.items()},
    )


@torch.no_grad()
def tries_by_aip(known: FrozenFeatures, candidates: Tensor, frozen: FrozenAap, aip: Aip, most: int) -> Tensor:
    """The rows that AIP would try one after the other, each the best by its critic after those before, [R, most].

    Args:
        known: of the interactions.
        candidates: rows to choose from, [R, c].
        frozen: the AAP, whose z the choice depends on.
        aip: the chooser.
        most: how many interactions.
    """
    rows, features = known.dataset.rows, known.rows(aip.encoder)[candidates]
    xyz, frames = rows.xyz[candidates], rows.frame[candidates]
    made = candidates[:, :0]
    free = torch.ones(candidates.shape, dtype=torch.bool)
    for _ in range(most):
        latents = frozen.latents(made)[:, -1:]
        believed = torch.sigmoid(frozen.aap.action_logits(frozen.features[candidates], xyz, frames, latents))
        gains = aip.action_scores(features, xyz, frames, latents, believed)
        best = torch.where(free, gains, -torch.inf).argmax(dim=1, keepdim=True)
        free.scatter_(1, best, False)
        made = torch.cat([made, candidates.gather(1, best)], dim=1)
    return made


@torch.no_grad()
def _scores(dataset: Dataset, index: Tensor, frozen: FrozenAap, latents: Tensor) -> Tensor:
    """AAP's scores of rows, [R, n], after z, [R, latent_width]; in chunks, to bound memory."""
    chunks = []
    for start in range(0, len(index), _CHUNK):
        part = index[start : start + _CHUNK]
        xyz, frames = dataset.rows.xyz[part], dataset.rows.frame[part]
        z = latents[start : start + _CHUNK, None]
        chunks.append(torch.sigmoid(frozen.aap.action_logits(frozen.features[part], xyz, frames, z)))
    return torch.cat(chunks)


@dataclass(frozen=True, slots=True)
class ProposalGain:
    """How much the loss on the questions drops by the next interaction, nats, on the mean over rollouts.

    Attributes:
        before: interactions that were made at random before.
        random: by a random candidate.
        aip: by the candidate with the highest AIP score.
        greedy: by the candidate that lowers it most, which only hindsight knows.
        loss: on the questions before the interaction.
        correlation: of AIP scores with drops.
    """

    before: int
    random: float
    aip: float
    greedy: float
    loss: float
    correlation: float


@torch.no_grad()
def proposal_gains(
    known: FrozenFeatures, candidates: Candidates, frozen: FrozenAap, aip: Aip, most: int = 3
) -> list[ProposalGain]:
    """Whether the AIP critic picks better interactions than chance among the candidates that a rollout happens to have.

    For the first interactions, of which there are `most`, as far as the candidates go.
    """
    dataset, features = known.dataset, known.rows(aip.encoder)
    ordered, found = candidates.ordered, []
    for number in range(min(most, candidates.count)):
        parts = [
            _gains_of(
                dataset, frozen, aip, features, ordered.rows[place][ordered.valid[place]], candidates.count, number
            )
            for place in range(len(ordered.rows))
        ]
        drops, scores = [part[0] for part in parts], [part[1] for part in parts]
        found.append(
            ProposalGain(
                before=number,
                random=float(np.mean([drop.mean() for drop in drops])),
                aip=float(np.mean([drop[score.argmax()] for drop, score in zip(drops, scores, strict=True)])),
                greedy=float(np.mean([drop.max() for drop in drops])),
                loss=float(np.mean([part[2] for part in parts])),
                correlation=correlation(np.concatenate(scores), np.concatenate(drops)),
            )
        )
    return found


def _gains_of(
    dataset: Dataset, frozen: FrozenAap, aip: Aip, features: Tensor, rows: Tensor, count: int, before: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Drops of the loss and AIP scores of a rollout's candidates, and the loss before."""
    made, candidates, questions = rows[:before], rows[before:count], rows[count:]
    several = torch.cat([made.expand(len(candidates), before), candidates[:, None]], dim=1)
    latent = frozen.latents(made[None])[0, -1]
    latents = torch.cat([latent[None], frozen.latents(several)[:, -1]])
    data = dataset.rows
    logits = frozen.aap.action_logits(
        frozen.features[questions], data.xyz[questions], data.frame[questions], latents[:, None]
    )
    losses = action_scoring_losses(logits, data.success[questions]).mean(dim=1)
    believed = torch.sigmoid(
        frozen.aap.action_logits(frozen.features[candidates], data.xyz[candidates], data.frame[candidates], latent)
    )
    scores = aip.action_scores(features[candidates], data.xyz[candidates], data.frame[candidates], latent, believed)
    return (losses[0] - losses[1:]).numpy(force=True), scores.numpy(force=True), float(losses[0])


_INFORMATION_CHUNK = 32
"""Rollouts at once; bounds memory."""


@torch.no_grad()
def tries_by_information(candidates: Tensor, frozen: FrozenAap, most: int) -> Tensor:
    """The rows that an information-seeking chooser would try one after the other, [R, most]; a reference for AIP.

    For each candidate AAP imagines both outcomes, reads them as if they had happened, and is asked how far its beliefs
    in all candidates would then have moved (see `shared.policies.imagined_outcomes`). It costs two readings of every
    candidate and c^2 scores a step. Not in the paper.

    Args:
        candidates: rows to choose from, [R, c].
        frozen: the AAP, by whose beliefs they are chosen.
        most: how many interactions.
    """
    starts = range(0, len(candidates), _INFORMATION_CHUNK)
    return torch.cat([_choose(candidates[start : start + _INFORMATION_CHUNK], frozen, most) for start in starts])


def _choose(candidates: Tensor, frozen: FrozenAap, most: int) -> Tensor:
    imagined = [frozen.imagined(candidates, success) for success in (False, True)]
    free = torch.ones(candidates.shape, dtype=torch.bool)
    made = candidates[:, :0]
    for _ in range(most):
        latents = frozen.latents(made)[:, -1:]
        expected = frozen.expected_divergence(candidates, made, latents, imagined)[1].mean(dim=-1)
        best = torch.where(free, expected, -torch.inf).argmax(dim=1, keepdim=True)
        free.scatter_(1, best, False)
        made = torch.cat([made, candidates.gather(1, best)], dim=1)
    return made
