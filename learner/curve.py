"""The adaptation curve: what the critics know of stored rollouts after 0, 1, 2, ... tries, between prior and oracle.

Offline: a rollout's own rows are its tries and its questions. The questions are the same after every number of tries,
so that two figures differ by the tries alone.

Shapes: R rollouts times draws, n rows of each, K the longest context, Q questions in all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.critics import OracleScores
from learner.data import Dataset
from learner.frozen import FrozenAap, FrozenPrior
from learner.losses import action_scoring_losses
from learner.metrics import Discrimination, correlation, discrimination
from learner.oracle import OracleCritic
from learner.sampling import OrderedRows, frozen_features, order_rows
from shared.networks.aip import Aip
from shared.networks.prior import Prior

_CHUNK = 16


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One critic after some tries.

    Attributes:
        method: "prior", "aap" or "oracle".
        tries: how many random tries it knows.
        figures: on all questions.
    """

    method: str
    tries: int
    figures: Discrimination

    def closed(self, prior: "CurvePoint", oracle: "CurvePoint") -> float:
        """The share of the gap in cross entropy between two others that this one closes."""
        gap = prior.figures.bce - oracle.figures.bce
        return (prior.figures.bce - self.figures.bce) / gap if gap > 0 else float("nan")


def adaptation_curve(
    dataset: Dataset,
    rollouts: Sequence[int],
    frozen: FrozenAap,
    prior: Prior | None = None,
    oracle: OracleCritic | None = None,
    tries: Sequence[int] = (0, 1, 2, 4),
    draws: int = 4,
    seed: int = 0,
) -> list[CurvePoint]:
    """Judge critics on rollouts, each `draws` times with other tries.

    Args:
        dataset: the interactions.
        rollouts: which ones; of objects that nothing was trained on.
        frozen: the AAP.
        prior: Where2Act, to judge beside it.
        oracle: a critic that is told the hidden facts, to judge beside it.
        tries: numbers of tries.
        draws: how often tries are drawn from each rollout.
        seed: of the draws.
    """
    context = max(tries)
    ordered = order_rows(dataset, [r for r in rollouts for _ in range(draws)], 1 << 16, np.random.default_rng(seed))
    asked = ordered.valid.clone()
    asked[:, :context] = False
    labels = dataset.rows.success[ordered.rows][asked].numpy(force=True)
    found = []
    if prior is not None:
        scores = FrozenPrior.of(prior, dataset).scores[ordered.rows[asked]].numpy(force=True)
        found.append(CurvePoint("prior", 0, discrimination(scores, labels)))
    logits = after_tries(dataset, frozen, ordered, list(tries))
    for place, number in enumerate(tries):
        scores = torch.sigmoid(logits[:, place][asked]).numpy(force=True)
        found.append(CurvePoint("aap", number, discrimination(scores, labels)))
    if oracle is not None:
        scores = OracleScores(oracle, dataset)(ordered.rows[asked], torch.zeros(0, dtype=torch.long)).numpy(force=True)
        found.append(CurvePoint("oracle", 0, discrimination(scores, labels)))
    return found


@torch.no_grad()
def after_tries(dataset: Dataset, frozen: FrozenAap, ordered: OrderedRows, tries: Sequence[int]) -> Tensor:
    """Logits of all ordered rows after some of the prefixes, [R, len(tries), n]."""
    rows, chunks = dataset.rows, []
    for start in range(0, len(ordered.rows), _CHUNK):
        index = ordered.rows[start : start + _CHUNK]
        latents = frozen.latents(index[:, : max(tries)])[:, torch.tensor(list(tries))]
        xyz, frames = rows.xyz[index][:, None], rows.frame[index][:, None]
        chunks.append(frozen.aap.action_logits(frozen.features[index][:, None], xyz, frames, latents[:, :, None]))
    return torch.cat(chunks)


@dataclass(frozen=True, slots=True)
class ProposalGain:
    """How much the loss on the questions drops by the next try, nats, on the mean over rollouts and contexts.

    Attributes:
        before: tries that were made at random before.
        random: by a random row of the rollout.
        aip: by the row with the highest AIP score.
        greedy: by the row that lowers it most, which only hindsight knows.
        loss: on the questions before the try.
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
    dataset: Dataset,
    rollouts: Sequence[int],
    frozen: FrozenAap,
    aip: Aip,
    before: Sequence[int] = (0, 1, 2),
    draws: int = 4,
    seed: int = 0,
) -> list[ProposalGain]:
    """Whether the AIP critic picks better tries than chance among the rows that a rollout happens to have.

    Half of the rows are questions; the others are candidates for the next try.
    """
    ordered = order_rows(dataset, [r for r in rollouts for _ in range(draws)], 1 << 16, np.random.default_rng(seed))
    features = frozen_features(aip.encoder, dataset.clouds, dataset.rows.cloud, dataset.rows.point)
    found = []
    for number in before:
        parts = [
            _gains_of(dataset, frozen, aip, features, ordered.rows[place][ordered.valid[place]], number)
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
    dataset: Dataset, frozen: FrozenAap, aip: Aip, features: Tensor, rows: Tensor, before: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Drops of the loss and AIP scores of a rollout's candidates, and the loss before."""
    half = len(rows) // 2
    made, candidates, questions = rows[:before], rows[before:half], rows[half:]
    several = torch.cat([made.expand(len(candidates), before), candidates[:, None]], dim=1)
    latent = frozen.latents(made[None])[0, -1]
    latents = torch.cat([latent[None], frozen.latents(several)[:, -1]])
    data = dataset.rows
    logits = frozen.aap.action_logits(
        frozen.features[questions], data.xyz[questions], data.frame[questions], latents[:, None]
    )
    losses = action_scoring_losses(logits, data.success[questions]).mean(dim=1)
    tried = candidates
    believed = torch.sigmoid(
        frozen.aap.action_logits(frozen.features[tried], data.xyz[tried], data.frame[tried], latent)
    )
    scores = aip.action_scores(features[tried], data.xyz[tried], data.frame[tried], latent, believed)
    return (losses[0] - losses[1:]).numpy(force=True), scores.numpy(force=True), float(losses[0])
