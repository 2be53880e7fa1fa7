"""What frozen networks make of a data set: computed once, since neither weights nor rows change any more."""

from dataclasses import dataclass

import torch
from torch import Tensor

from learner.data.features import FrozenFeatures
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
    def of(cls, prior: Prior, known: FrozenFeatures) -> "FrozenPrior":
        """Ask it about everything."""
        rows, features = known.dataset.rows, known.rows(prior.encoder)
        scores = torch.sigmoid(prior.action_logits(features, rows.xyz, rows.frame))
        return cls(features, scores, prior.actionability(features, rows.xyz))


@dataclass(frozen=True, slots=True)
class FrozenAap:
    """What a frozen AAP makes of every row and pool point.

    Attributes:
        aap: frozen.
        features: of the rows' points, [I, point_width].
        pool_features: of the pool's points, [O, P, point_width].
        codes: z_I of the rows, [I, latent_width].
        weights: w_I of the rows, [I].
    """

    aap: Aap
    features: Tensor
    pool_features: Tensor
    codes: Tensor
    weights: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, aap: Aap, known: FrozenFeatures) -> "FrozenAap":
        """Ask it about everything."""
        aap.eval().requires_grad_(False)
        rows, features = known.dataset.rows, known.rows(aap.encoder)
        tries = (features, rows.xyz, rows.frame, rows.motion, rows.success, rows.details)
        codes, weights = aap.interaction_codes(*tries)
        return cls(aap, features, known.pool(aap.encoder), codes, weights)

    def latents(self, tries: Tensor) -> Tensor:
        """The z of every prefix of ordered rows `tries`, [..., K]; [..., K + 1, latent_width]."""
        return self.aap.prefix_latents(self.codes[tries], self.weights[tries])
