"""Critics of a policy, asked about rows of a data set instead of what a camera sees (compare `shared.critics`).

What does not depend on the tries is computed once for all rows. Shapes: Q rows asked about, K tries.
"""

from typing import Protocol

import torch
from torch import Tensor

from learner.data import Dataset
from learner.features import FrozenFeatures
from learner.frozen import FrozenAap, FrozenPrior
from learner.oracle import OracleCritic, Teacher
from learner.where2act_adaptation import corrected_scores
from shared.methods import CriticName
from shared.networks.where2act_adaptation import Where2ActAdaptation
from shared.policy import Policy


class RowCritic(Protocol):
    """What a method believes of rows after tries of the same rollout."""

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """Scores in [0, 1] of rows, [Q], after the rows `tries`, [K], of which there may be none; [Q]."""
        ...


def row_critic(name: CriticName, policy: Policy, known: FrozenFeatures) -> RowCritic:
    """The critic of a policy that is called `name`.

    Raises:
        UsageError: its network is not trained.
    """
    match name:
        case "where2act":
            return PriorScores(FrozenPrior.of(policy.prior, known))
        case "aap":
            return AdaptiveScores(FrozenAap.of(policy.aap, known), known.dataset)
        case "where2act-interaction":
            policy.require(name)
            assert policy.where2act_interaction is not None, "a trained module is there"
            return AdaptiveScores(FrozenAap.of(policy.where2act_interaction, known), known.dataset)
        case "where2act-adaptation":
            policy.require(name)
            assert policy.where2act_adaptation is not None, "a trained module is there"
            return CorrectedScores(policy.where2act_adaptation, FrozenPrior.of(policy.prior, known), known.dataset)


class PriorScores:
    """Where2Act, which knows nothing of tries."""

    def __init__(self, prior: FrozenPrior) -> None:
        self._prior = prior

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """Where2Act's scores."""
        return self._prior.scores[asked]


class AdaptiveScores:
    """AAP, or Where2Act-interaction, which shares its form."""

    @torch.no_grad()
    def __init__(self, frozen: FrozenAap, dataset: Dataset) -> None:
        self._frozen, self._rows = frozen, dataset.rows

    @torch.no_grad()
    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """s_u|z."""
        frozen, rows = self._frozen, self._rows
        latent = frozen.latents(tries)[-1]
        return torch.sigmoid(
            frozen.aap.action_logits(frozen.features[asked], rows.xyz[asked], rows.frame[asked], latent)
        )


class CorrectedScores:
    """Where2Act-adaptation."""

    def __init__(self, network: Where2ActAdaptation, prior: FrozenPrior, dataset: Dataset) -> None:
        self._network, self._prior, self._dataset = network, prior, dataset

    @torch.no_grad()
    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """s_u + sum (r - s) sim_pq, cut to [0, 1]."""
        if not len(tries):
            return self._prior.scores[asked]
        corrected = corrected_scores(self._network, self._dataset, self._prior, asked[None], tries[None])
        return corrected[0, :, -1].clamp(0.0, 1.0)


class OracleScores:
    """The oracle critic, which is told the hidden facts and needs no tries."""

    def __init__(self, oracle: OracleCritic, known: FrozenFeatures) -> None:
        self._teacher = Teacher.of(oracle, known)

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """s_u with z = h(hidden facts)."""
        return self._teacher.scores[asked]
