"""An information-seeking chooser of interactions, as a reference for AIP: AAP alone says which would settle the most.

For each candidate AAP imagines both outcomes, reads them as if they had happened, and is asked how sure it would then
be of all candidates. Nothing is trained for it; it costs two readings of every candidate and c^2 scores a step.
Not in the paper (compare Lindley, 1956: the expected gain in Shannon information).

Shapes: R rollouts, c candidates of each, k interactions made.
"""

import torch
from torch import Tensor
from torch.nn import functional

from learner.data.cached_features import FrozenAap
from learner.data.features import FrozenFeatures

_CHUNK = 32
"""Rollouts at once; bounds memory."""


@torch.no_grad()
def tries_by_information(known: FrozenFeatures, candidates: Tensor, frozen: FrozenAap, most: int) -> Tensor:
    """The rows that would be tried one after the other, [R, most].

    Args:
        known: of the interactions.
        candidates: rows to choose from, [R, c].
        frozen: the AAP, by whose beliefs they are chosen.
        most: how many interactions.
    """
    starts = range(0, len(candidates), _CHUNK)
    return torch.cat([_choose(known, candidates[start : start + _CHUNK], frozen, most) for start in starts])


def _choose(known: FrozenFeatures, candidates: Tensor, frozen: FrozenAap, most: int) -> Tensor:
    imagined = [_imagined(known, candidates, frozen, success) for success in (False, True)]
    free = torch.ones(candidates.shape, dtype=torch.bool)
    made = candidates[:, :0]
    for _ in range(most):
        expected = _unsureness_after(known, candidates, frozen, made, imagined)
        best = torch.where(free, expected, torch.inf).argmin(dim=1, keepdim=True)
        free.scatter_(1, best, False)
        made = torch.cat([made, candidates.gather(1, best)], dim=1)
    return made


def _imagined(known: FrozenFeatures, candidates: Tensor, frozen: FrozenAap, success: bool) -> tuple[Tensor, Tensor]:
    """Codes and weights of the candidates had they succeeded, or failed, each with the usual motion of such a one.

    What else an outcome tells (see `shared.networks.actions.outcome_details`) is unknown.
    """
    rows = known.dataset.rows
    alike = rows.motion[(rows.success > 0) == success]
    motion = alike.median() if len(alike) else rows.motion.new_tensor(0.0)
    found = (frozen.features[candidates], rows.xyz[candidates], rows.frame[candidates])
    motions = motion.expand(candidates.shape)
    return frozen.aap.interaction_codes(*found, motions, torch.full_like(motions, float(success)))


def _unsureness_after(
    known: FrozenFeatures, candidates: Tensor, frozen: FrozenAap, made: Tensor, imagined: list[tuple[Tensor, Tensor]]
) -> Tensor:
    """Expected entropy, nats, of what AAP says of all candidates after each of them was tried as well, [R, c]."""
    rows, aap, count = known.dataset.rows, frozen.aap, candidates.shape[1]
    asked = (frozen.features[candidates], rows.xyz[candidates], rows.frame[candidates])
    believed = torch.sigmoid(aap.action_logits(*asked, frozen.latents(made)[:, -1:]))
    expected = torch.zeros_like(believed)
    for odds, (codes, weights) in zip((1.0 - believed, believed), imagined, strict=True):
        before = frozen.codes[made][:, None].expand(-1, count, -1, -1)
        before_weights = frozen.weights[made][:, None].expand(-1, count, -1)
        latents = aap.prefix_latents(
            torch.cat([before, codes[:, :, None]], dim=2), torch.cat([before_weights, weights[..., None]], dim=2)
        )[:, :, -1:]
        # One more axis, so that every candidate is asked about after every candidate.
        features, xyz, frames = (x[:, None] for x in asked)
        logits = aap.action_logits(features, xyz, frames, latents)
        entropy = functional.softplus(logits) - torch.sigmoid(logits) * logits
        expected += odds * entropy.mean(dim=-1)
    return expected
