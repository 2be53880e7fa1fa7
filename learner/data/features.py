"""What networks that are not trained any more make of a data set: computed once.

Shapes: I rows and O clouds of a data set, P pool points a cloud, Q points, S proposals.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from learner.data.dataset import Dataset, Rows
from shared.networks.aap import Aap
from shared.networks.pointnet2 import CloudBatch, PointNet2
from shared.networks.prior import Prior
from shared.policies.imagined_outcomes import divergence

ENCODING_CHUNK = 16
"""Clouds encoded at once; bounds memory."""
POOL_POINTS = 16
"""Movable points of each cloud that proposals are drawn at."""
MOST_ENCODERS = 3
"""Whose features are remembered: the prior's, AAP's, and one that comes or goes; each takes some KB a row."""


class FrozenFeatures:
    """Features of a data set's rows, and of a pool of movable points, under whatever encoder is not trained just now.

    Encoders of equal weights share them: AAP keeps its oracle's encoder, and AIP AAP's, and most of the time that a
    stage takes beside its steps goes to encoding. What was asked for longest ago is forgotten first.

    Attributes:
        dataset: the interactions.
        point: the pool's points, indices in their clouds, [O, P]; P is 0 where there is no pool.
    """

    def __init__(self, dataset: Dataset, point: Tensor | None = None) -> None:
        self.dataset = dataset
        self.point = torch.zeros(len(dataset.movable), 0, dtype=torch.long) if point is None else point
        self._known: dict[str, tuple[Tensor, Tensor]] = {}

    @classmethod
    def with_pool(cls, dataset: Dataset, rng: np.random.Generator) -> "FrozenFeatures":
        """Draw the points of a pool once for all of a training stage."""
        chosen = []
        for movable in dataset.movable.numpy(force=True):
            candidates = np.flatnonzero(movable) if movable.any() else np.arange(len(movable))
            chosen.append(rng.choice(candidates, POOL_POINTS))
        return cls(dataset, torch.as_tensor(np.stack(chosen)))

    def rows(self, encoder: PointNet2) -> Tensor:
        """Of the rows' points, [I, point_width]."""
        return self._under(encoder)[0]

    def pool(self, encoder: PointNet2) -> Tensor:
        """Of the pool's points, [O, P, point_width]."""
        return self._under(encoder)[1]

    def _under(self, encoder: PointNet2) -> tuple[Tensor, Tensor]:
        digest = _weights_digest(encoder)
        found = self._known.pop(digest, None) or self._encoded(encoder)
        while len(self._known) >= MOST_ENCODERS:
            del self._known[next(iter(self._known))]
        self._known[digest] = found
        return found

    def _encoded(self, encoder: PointNet2) -> tuple[Tensor, Tensor]:
        rows = self.dataset.rows
        owner = torch.arange(len(self.point)).repeat_interleave(self.point.shape[1])
        cloud, point = torch.cat([rows.cloud, owner]), torch.cat([rows.point, self.point.flatten()])
        found = frozen_features(encoder, self.dataset.clouds, cloud, point)
        of_pool = found[len(rows.cloud) :].reshape(*self.point.shape, encoder.width)
        return found[: len(rows.cloud)], of_pool


@dataclass(frozen=True, slots=True)
class ProposalPool:
    """A few movable points of each cloud, to draw proposals of the frozen prior at.

    Attributes:
        point: [O, P], index in the cloud.
        features: [O, P, point_width], of the prior.
        prior: whose proposal network draws.
        dataset: of the clouds.
    """

    point: Tensor
    features: Tensor
    prior: Prior
    dataset: Dataset

    @classmethod
    def of(cls, prior: Prior, features: FrozenFeatures) -> "ProposalPool":
        """The pool's points under a prior."""
        return cls(features.point, features.pool(prior.encoder), prior, features.dataset)

    @torch.no_grad()
    def draw(self, cloud: Tensor, slot: Tensor, count: int, rng: np.random.Generator) -> Tensor:
        """`count` actions at points of the pool, given by cloud and slot, [Q] each; [Q, count, 6 or more]."""
        noise = rng.standard_normal((len(cloud), count, self.prior.config.noise_width)).astype(np.float32)
        frames = self.prior.propose(self.features[cloud, slot][:, None], torch.as_tensor(noise))
        if self.dataset.dense is None:
            return frames
        return self.dataset.dense.frames(cloud, self.dataset.clouds.points[cloud, self.point[cloud, slot]], frames)


@torch.no_grad()
def frozen_features(encoder: PointNet2, clouds: CloudBatch, cloud: Tensor, point: Tensor) -> Tensor:
    """Features of points under an encoder that is not trained, [Q, point_width]; each cloud is encoded once.

    Args:
        encoder: in evaluation mode for the duration.
        clouds: all clouds.
        cloud: [Q], which of them.
        point: [Q].
    """
    was_training = encoder.training
    encoder.eval()
    features = torch.empty(len(cloud), encoder.width)
    needed, inverse = torch.unique(cloud, return_inverse=True)
    for start in range(0, len(needed), ENCODING_CHUNK):
        chunk = needed[start : start + ENCODING_CHUNK]
        here = torch.nonzero((inverse >= start) & (inverse < start + len(chunk))).flatten()
        encoded = encoder(clouds.select(chunk))
        features[here] = encoder.at(encoded, inverse[here] - start, point[here])
    encoder.train(was_training)
    return features


def _weights_digest(encoder: PointNet2) -> str:
    digest = hashlib.sha256()
    for name, tensor in encoder.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.numpy(force=True).tobytes())
    return digest.hexdigest()


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
        rows: of the data set.
        features: of the rows' points, [I, point_width].
        pool_features: of the pool's points, [O, P, point_width].
        codes: z_I of the rows, [I, latent_width].
        weights: w_I of the rows, [I].
    """

    aap: Aap
    rows: Rows
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
        return cls(aap, rows, features, known.pool(aap.encoder), codes, weights)

    def latents(self, tries: Tensor) -> Tensor:
        """The z of every prefix of ordered rows `tries`, [..., K]; [..., K + 1, latent_width]."""
        return self.aap.prefix_latents(self.codes[tries], self.weights[tries])

    def logits(self, asked: Tensor, latents: Tensor) -> Tensor:
        """Logits of s_u|z of the actions of rows `asked`, [...], under z, [..., latent_width], which broadcast."""
        return self.aap.action_logits(self.features[asked], self.rows.xyz[asked], self.rows.frame[asked], latents)

    def imagined(self, candidates: Tensor, success: bool) -> tuple[Tensor, Tensor]:
        """Codes and weights of rows, [...], had they succeeded, or failed, each with the usual motion of such a one.

        What else an outcome tells (see `shared.networks.actions.outcome_details`) is unknown.
        """
        rows = self.rows
        alike = rows.motion[(rows.success > 0) == success]
        motion = (alike.median() if len(alike) else rows.motion.new_tensor(0.0)).expand(candidates.shape)
        found = (self.features[candidates], rows.xyz[candidates], rows.frame[candidates])
        return self.aap.interaction_codes(*found, motion, torch.full_like(motion, float(success)))

    def latents_with(self, made: Tensor, codes: Tensor, weights: Tensor) -> Tensor:
        """The z of rows `made`, [..., K], and one more interaction, for each of C, [..., C, latent_width].

        Args:
            made: rows.
            codes: of the further interactions, [..., C, latent_width].
            weights: likewise, [..., C].
        """
        shape = (*codes.shape[:-1], made.shape[-1])
        before = self.codes[made][..., None, :, :].expand(*shape, -1)
        before_weights = self.weights[made][..., None, :].expand(shape)
        return self.aap.prefix_latents(
            torch.cat([before, codes[..., None, :]], dim=-2), torch.cat([before_weights, weights[..., None]], dim=-1)
        )[..., -1, :]

    def expected_divergence(
        self, candidates: Tensor, made: Tensor, latents: Tensor, imagined: list[tuple[Tensor, Tensor]]
    ) -> tuple[Tensor, Tensor]:
        """How far beliefs are expected to move, nats, by each candidate after rows that were made.

        Args:
            candidates: rows, [B, C].
            made: rows, [B, K].
            latents: their z, [B, 1, latent_width].
            imagined: of the candidates had they failed, and had they succeeded (see `imagined`).

        Returns:
            Beliefs in the candidates, [B, C], and the divergence in each of them by each of them, [B, C, C].
        """
        believed = torch.sigmoid(self.logits(candidates, latents))
        expected = torch.zeros(*candidates.shape, candidates.shape[1])
        for odds, (codes, weights) in zip((1.0 - believed, believed), imagined, strict=True):
            # One more axis, so that every candidate is asked about after every candidate.
            after = self.logits(candidates[:, None], self.latents_with(made, codes, weights)[:, :, None])
            expected += odds[..., None] * divergence(torch.sigmoid(after), believed[:, None])
        return believed, expected
