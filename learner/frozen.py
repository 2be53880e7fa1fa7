"""What frozen networks make of a data set: computed once, since neither weights nor rows change any more."""

from dataclasses import dataclass

import torch
from torch import Tensor

from learner.data import Dataset
from learner.sampling import ProposalPool, frozen_features
from shared.networks.aap import Aap
from shared.networks.prior import Prior


@dataclass(frozen=True, slots=True)
class FrozenPrior:
    """What a frozen Where2Act makes of every row.

    Attributes:
        features: of the points, [I, point_width].
        scores: s_u, [I].
        actionability: a_p of the touched points, [I].
    """

    features: Tensor
    scores: Tensor
    actionability: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, prior: Prior, dataset: Dataset) -> "FrozenPrior":
        """Encode everything."""
        rows = dataset.rows
        features = frozen_features(prior.encoder, dataset.clouds, rows.cloud, rows.point)
        scores = torch.sigmoid(prior.action_logits(features, rows.xyz, rows.frame))
        return cls(features, scores, prior.actionability(features))


@dataclass(frozen=True, slots=True)
class FrozenAap:
    """What a frozen AAP makes of every row and pool point.

    Attributes:
        aap: frozen.
        features: of the rows' points, [I, point_width].
        pool_features: of the pool's points, [O, P, point_width]; None where no pool was given.
        codes: z_I of the rows, [I, latent_width].
        weights: w_I of the rows, [I].
    """

    aap: Aap
    features: Tensor
    pool_features: Tensor | None
    codes: Tensor
    weights: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, aap: Aap, dataset: Dataset, pool: ProposalPool | None = None) -> "FrozenAap":
        """Encode everything."""
        aap.eval().requires_grad_(False)
        rows = dataset.rows
        features = frozen_features(aap.encoder, dataset.clouds, rows.cloud, rows.point)
        pool_features = None if pool is None else pool.features_under(aap.encoder, dataset.clouds)
        codes, weights = aap.interaction_codes(features, rows.xyz, rows.frame, rows.motion, rows.success)
        return cls(aap, features, pool_features, codes, weights)

    def latents(self, tries: Tensor) -> Tensor:
        """The z of every prefix of ordered rows `tries`, [..., K]; [..., K + 1, latent_width]."""
        return self.aap.prefix_latents(self.codes[tries], self.weights[tries])
