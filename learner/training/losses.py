"""The losses of Where2Act and AdaAfford; each returns a scalar unless it says otherwise."""

import torch
from torch import Tensor
from torch.nn import functional

from learner.training.data_parallel import averaged, shared_mean
from shared.networks.actions import geodesic_distance
from shared.networks.aip import SCORE_SCALE

_SURE = 1e-6
"""Keeps the logarithm of a probability that was rounded to 0 or 1 finite."""


def action_scoring_loss(logits: Tensor, successes: Tensor, mask: Tensor | None = None) -> Tensor:
    """Binary cross entropy of action scores, nats (Where2Act; AdaAfford, AAP Action Scoring Loss).

    Args:
        logits: of the scores, [...].
        successes: r as 0 or 1, broadcast against the logits.
        mask: which entries count; None: all. Where none counts, the loss is 0.
    """
    losses = action_scoring_losses(logits, successes)
    return masked_mean(losses, torch.ones_like(losses, dtype=torch.bool) if mask is None else mask)


def action_scoring_losses(logits: Tensor, successes: Tensor) -> Tensor:
    """Binary cross entropy of each action score, nats, [...]."""
    logits = logits.float()
    return functional.binary_cross_entropy_with_logits(logits, successes.expand_as(logits), reduction="none")


def proposal_loss(proposals: Tensor, frames: Tensor) -> Tensor:
    """Geodesic distance, rad, from orientations that succeeded to the nearest of S draws (Where2Act).

    Args:
        proposals: [Q, S, 6].
        frames: approach and forward that succeeded, [Q, 6]; where there are none, the loss is 0.
    """
    if not len(frames):
        return shared_mean(proposals.sum() * 0.0, proposals.new_zeros(()))
    nearest = geodesic_distance(proposals, frames[:, None]).min(dim=1).values
    return shared_mean(nearest.sum(), nearest.new_tensor(float(len(nearest))))


def actionability_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """L1 between actionability and what a critic made of it; no gradient reaches the critic (all D networks)."""
    return (predicted - target.detach()).abs().mean()


def mean_actionability_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Cross entropy, nats, between actionability and what a critic made of it, both in [0, 1]; not in the paper.

    L1 is least at the median, and where successes are rare most points are worth next to nothing: D then says so of
    all of them. What is expected of a point is a mean, where the cross entropy is least.
    """
    predicted, target = predicted.float().clamp(_SURE, 1.0 - _SURE), target.detach().float()
    return -(target * predicted.log() + (1.0 - target) * (1.0 - predicted).log()).mean()


def mean_score(scores: Tensor) -> Tensor:
    """A point's actionability by Where2Act: the mean score of its proposals, [..., S] to [...]."""
    return scores.mean(dim=-1)


def top_score(scores: Tensor, top: int) -> Tensor:
    """A point's actionability by AdaAfford: the mean of the `top` best scores, [..., S] to [...]."""
    return scores.topk(min(top, scores.shape[-1]), dim=-1).values.mean(dim=-1)


def correction_loss(corrected: Tensor, successes: Tensor, mask: Tensor) -> Tensor:
    """Squared error of corrected scores (AdaAfford, supplement, Details of Baselines).

    "We use the ground truth result of the action as the regression target": the paper does not name the loss. A cross
    entropy would need scores within [0, 1], and L1 would find the median of what is 0 or 1.
    """
    return masked_mean((corrected - successes).square(), mask)


def information_gains(losses: Tensor) -> Tensor:
    """Targets of the AIP critic: how much each interaction lowered the AAP action scoring loss.

    gt_u_i = L_{I_(i-1)} - L_{I_i} (AdaAfford, AIP Action Scoring Loss).

    Args:
        losses: after 0, 1, ..., K interactions, [..., K + 1].

    Returns:
        [..., K].
    """
    return losses[..., :-1] - losses[..., 1:]


def information_loss(predicted: Tensor, gains: Tensor, mask: Tensor) -> Tensor:
    """L1 between AIP action scores and their targets (AdaAfford, AIP Action Scoring Loss)."""
    return masked_mean((predicted - gains.detach()).abs(), mask)


def mean_information_loss(predicted: Tensor, gains: Tensor, mask: Tensor | None = None) -> Tensor:
    """Squared error between AIP action scores and their targets, in units of `SCORE_SCALE`; not in the paper.

    L1 is least at the median, and where successes are rare most interactions tell nothing: the median gain of any of
    them is then about zero. What a proposal is worth is its mean gain, where squares are least.
    """
    losses = ((predicted - gains.detach()) / SCORE_SCALE).square()
    return masked_mean(losses, torch.ones_like(losses, dtype=torch.bool) if mask is None else mask)


def distillation_loss(latents: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Squared distance of z to the oracle's, in units of its spread; not in the paper (privileged training).

    Args:
        latents: z of every prefix, [B, K + 1, latent_width].
        target: the oracle's z of the same rollouts, [B, latent_width].
        mask: which prefixes count, [B, K + 1].
    """
    target = target.detach()
    mean = averaged(target.mean(dim=0))
    spread = averaged((target - mean).square().mean()) + 1e-2
    return masked_mean((latents - target[:, None]).square().mean(dim=-1) / spread, mask)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of the values that count, over all processes that share a batch; 0 where none does."""
    weights = mask.expand_as(values).to(values.dtype)
    return shared_mean(torch.where(weights > 0, values, torch.zeros_like(values)).sum(), weights.sum())
