"""Critics of a policy, asked about rows of a data set instead of a camera's view (compare `shared.policies.critics`).

What does not depend on the interactions is computed once for all rows. Shapes: Q rows asked about, K interactions.
"""

import torch
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures, FrozenPrior
from learner.stages.oracle import OracleCritic, Teacher
from learner.stages.trainers import RowCritic, training_of
from shared.policies.methods import CriticName
from shared.policies.policy import Policy


def row_critic(name: CriticName, policy: Policy, known: FrozenFeatures) -> RowCritic:
    """The critic of a policy that is called `name`.

    Raises:
        UsageError: its network is not trained.
    """
    if name == "where2act":
        return PriorScores(FrozenPrior.of(policy.prior, known))
    if name == "aap":
        return AdaptiveScores(FrozenAap.of(policy.aap, known), known.dataset)
    policy.require(name)
    return training_of(name).row_critic(policy, known)


class PriorScores:
    """Where2Act, which knows nothing of interactions."""

    def __init__(self, prior: FrozenPrior) -> None:
        self._prior = prior

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """Where2Act's scores."""
        return self._prior.scores[asked]


class AdaptiveScores:
    """AAP, or a baseline whose network has its form."""

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


class OracleScores:
    """The oracle critic, which is told the hidden facts and needs no interactions."""

    def __init__(self, oracle: OracleCritic, known: FrozenFeatures) -> None:
        self._teacher = Teacher.of(oracle, known)

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """s_u with z = h(hidden facts)."""
        return self._teacher.scores[asked]
