"""The adaptation curve: what critics know of stored rollouts after 0, 1, 2, ... interactions.

Where2Act and the oracle are its bounds. Curves of several trainings are pooled over their seeds.

Offline: half of a rollout's own rows are candidates for interactions, the other half are the questions. The questions
are the same for all critics and after every number of interactions, so that two figures differ by critic and
interactions alone.

Shapes: R rollouts times draws, n rows of each (padded), c candidates of each, K the most interactions, Q questions in
all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures, FrozenPrior
from learner.data.sampling import OrderedRows, order_rows
from learner.metrics import THRESHOLD, correlation, cross_entropies, discrimination, f_score_interval, ratio_interval
from learner.stages.oracle import OracleCritic, Teacher
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
            scores[Asked(critic, number)] = _scores(ordered.rows, frozen, latents[:, number])[asked]
    if oracle is not None:
        scores[Asked("oracle", 0)] = Teacher.of(oracle, known).scores[index]
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

    def gains(made: Tensor, latents: Tensor) -> Tensor:
        believed = torch.sigmoid(frozen.logits(candidates, latents))
        return aip.action_scores(features, xyz, frames, latents, believed)

    return _one_by_one(candidates, frozen, most, gains)


def _one_by_one(candidates: Tensor, frozen: FrozenAap, most: int, worth: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """The candidates, each once, that are worth most after those before, by their rows and z; [R, most]."""
    free, made = torch.ones(candidates.shape, dtype=torch.bool), candidates[:, :0]
    for _ in range(most):
        found = worth(made, frozen.latents(made)[:, -1:])
        best = torch.where(free, found, -torch.inf).argmax(dim=1, keepdim=True)
        free.scatter_(1, best, False)
        made = torch.cat([made, candidates.gather(1, best)], dim=1)
    return made


@torch.no_grad()
def _scores(index: Tensor, frozen: FrozenAap, latents: Tensor) -> Tensor:
    """AAP's scores of rows, [R, n], after z, [R, latent_width]; in chunks, to bound memory."""
    chunks = (slice(start, start + _CHUNK) for start in range(0, len(index), _CHUNK))
    return torch.cat([torch.sigmoid(frozen.logits(index[here], latents[here, None])) for here in chunks])


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
    losses = action_scoring_losses(frozen.logits(questions, latents[:, None]), data.success[questions]).mean(dim=1)
    believed = torch.sigmoid(frozen.logits(candidates, latent))
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

    def expected(made: Tensor, latents: Tensor) -> Tensor:
        return frozen.expected_divergence(candidates, made, latents, imagined)[1].mean(dim=-1)

    return _one_by_one(candidates, frozen, most, expected)


_PRIOR, _NO_TRIES, _ORACLE = Asked("where2act", 0), Asked("random", 0), Asked("oracle", 0)


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One critic after some interactions; NaN where a figure is not defined.

    Attributes:
        name: of the training.
        run: the place of its run among those of the name, from "1"; "" for all of them together.
        critic: whose answers, and how its interactions were chosen.
        tries: how many.
        f_score: at the threshold 0.5, with its 95% interval over objects.
        best_f_score: at the threshold best in hindsight.
        bce: binary cross entropy, nats.
        auc: area under the ROC curve.
        calibration_error: ECE.
        base_rate: share of successes among the questions.
        questions: how many; a run's draws of interactions and questions from one rollout all count.
        objects: how many they are about.
        closed: share of the gap in cross entropy between Where2Act and the oracle, with its 95% interval over objects.
        closed_from_none: the same of the gap between AAP without interactions, a second prior, and the oracle.
    """

    name: str
    run: str
    critic: CriticKind
    tries: int
    f_score: float
    f_score_low: float
    f_score_high: float
    best_f_score: float
    bce: float
    auc: float
    calibration_error: float
    base_rate: float
    questions: int
    objects: int
    closed: float
    closed_low: float
    closed_high: float
    closed_from_none: float


def curve_rows(name: str, runs: Sequence[tuple[str, Answers]]) -> list[CurveRow]:
    """Rows of a training: those of all its runs together first, then of each.

    Args:
        name: of the training.
        runs: each run's name and what its critics answered; all to the same critics and numbers of interactions.
    """
    pooled = rows_of(name, "", [answers for _, answers in runs])
    return pooled + [row for run, answers in runs for row in rows_of(name, run, [answers])]


def rows_of(name: str, run: str, answers: Sequence[Answers]) -> list[CurveRow]:
    """A row for each critic and number of interactions."""
    labels = np.concatenate([found.labels for found in answers])
    _, groups = np.unique(np.concatenate([found.objects for found in answers]), return_inverse=True)
    scores = {
        asked: np.concatenate([found.scores[asked] for found in answers]).astype(np.float64)
        for asked in answers[0].scores
    }
    losses = {asked: cross_entropies(found, labels) for asked, found in scores.items()}
    return [_row(name, run, asked, scores[asked], losses, labels, groups) for asked in scores]


def _row(
    name: str,
    run: str,
    asked: Asked,
    scores: NDArray[np.float64],
    losses: dict[Asked, NDArray[np.float64]],
    labels: NDArray[np.bool_],
    groups: NDArray[np.int64],
) -> CurveRow:
    found = discrimination(scores, labels)
    f_low, f_high = f_score_interval(scores >= THRESHOLD, labels, groups)
    closed, closed_low, closed_high, from_none = (float("nan"),) * 4
    if _ORACLE in losses:
        gained, whole = losses[_PRIOR] - losses[asked], losses[_PRIOR] - losses[_ORACLE]
        closed = share(gained, whole)
        closed_low, closed_high = ratio_interval(gained, whole, groups)
        from_none = share(losses[_NO_TRIES] - losses[asked], losses[_NO_TRIES] - losses[_ORACLE])
    return CurveRow(
        name=name,
        run=run,
        critic=asked.critic,
        tries=asked.tries,
        f_score=found.f_score,
        f_score_low=f_low,
        f_score_high=f_high,
        best_f_score=found.best_f_score,
        bce=found.bce,
        auc=found.auc,
        calibration_error=found.calibration_error,
        base_rate=found.base_rate,
        questions=found.rows,
        objects=len(np.unique(groups)),
        closed=closed,
        closed_low=closed_low,
        closed_high=closed_high,
        closed_from_none=from_none,
    )


def share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    """Sum of a part over the sum of the whole; NaN where there is no gap to close."""
    gap = float(whole.sum())
    return float(part.sum()) / gap if gap > 0 else float("nan")
