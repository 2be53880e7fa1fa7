"""Calibration: the last layer of a trained policy's critics, fitted to a few interactions with one's own objects.

The logit of a critic is w h + b, where h is the input of its last layer. "scale" fits a temperature and a bias (Platt,
1999; Guo et al., 2017): the logit becomes a (w h + b) + c. "last-layer" fits w and b. Both only change w and b, so that
a calibrated policy is a policy like any other.

A penalty holds each fit near the policy as it is. Its strength is chosen by cross-validation over objects, and the
reported cross entropies are of objects that neither the fit nor this choice has seen. Not in the paper.

Shapes: Q questions (one interaction asked about after some number of interactions), n numbers a critic's logit is
linear in.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures
from learner.data.sampling import spread
from learner.evaluation.curve import Candidates, tries_by_aip
from learner.metrics import cross_entropies, ratio_interval
from shared.errors import UsageError
from shared.networks.layers import Head
from shared.policies.policy import Policy
from shared.types import Float

Fit = Literal["scale", "last-layer"]
CalibratedCritic = Literal["where2act", "aap"]
INTERACTIONS = (0, 1, 2, 4)
"""After how many interactions AAP is asked."""
MIN_OBJECTS = 3
"""With fewer, nothing is left to choose the penalty by when one is held out."""
MIN_OF_EACH = 10
"""Successes, and failures."""
MAX_ROLLOUTS = 400
"""More are not read: two numbers are known well long before."""
DRAWS = 2
"""How often interactions and questions are drawn from a rollout."""
FOLDS, INNER_FOLDS = 8, 4
STRENGTHS = (1.0, 10.0, 100.0, 1e3, 1e4, 1e9)
"""Of the penalty (see `fit_logits`): with the first, a temperature or bias that changes logits by 1 costs 1 nat in all;
with the last the policy stays as it is."""
MIN_SCALE = 0.05
"""A critic that ranks worse than chance on the given objects is not turned round."""
_STEPS, _TOLERANCE = 60, 1e-9
_FIXED = 1e15


@dataclass(frozen=True, slots=True)
class CriticRows:
    """What a critic makes of questions before its last step, and what happened.

    Attributes:
        inputs: of the last layer, [Q, n]; the last column is 1.
        weights: of the last layer, its bias last, [n].
        labels: whether the interaction succeeded, [Q].
        objects: whose interaction it was, [Q].
        interactions: how many the critic knew, [Q].
    """

    inputs: Float
    weights: Float
    labels: NDArray[np.bool_]
    objects: NDArray[np.str_]
    interactions: NDArray[np.int64]

    @property
    def logits(self) -> Float:
        """Of the critic as it is, [Q]."""
        return np.asarray(self.inputs @ self.weights)

    def design(self, fit: Fit) -> tuple[Float, Float]:
        """What the fitted logit is linear in, [Q, m], and the coefficients that leave it as it is, [m]."""
        if fit == "last-layer":
            return self.inputs, self.weights
        return np.stack([self.logits, np.ones(len(self.labels))], axis=1), np.array([1.0, 0.0])


@dataclass(frozen=True, slots=True)
class CalibrationRow:
    """Cross entropies of a critic after some interactions, nats.

    Attributes:
        critic: which.
        interactions: how many it knew.
        constant: of the base rate of these very questions.
        before: of the policy as it was.
        after: calibrated, each object by a fit to the others.
        gain: before less after, with its 95% interval over objects.
        questions: how many.
        objects: how many they are about.
    """

    critic: CalibratedCritic
    interactions: int
    constant: float
    before: float
    after: float
    gain: float
    gain_low: float
    gain_high: float
    questions: int
    objects: int


@dataclass(frozen=True, slots=True)
class Calibration:
    """A fit of one critic.

    Attributes:
        scale: a, which D's logits are multiplied by, too.
        bias: c.
        weights: of the critic's last layer, its bias last, [n].
        strength: of the penalty, one of `STRENGTHS`.
        rows: what it gains on objects that were held out.
    """

    scale: float
    bias: float
    weights: Float
    strength: float
    rows: tuple[CalibrationRow, ...]


def calibrate(
    policy: Policy, asked: Mapping[CalibratedCritic, CriticRows], fit: Fit = "scale"
) -> dict[CalibratedCritic, Calibration]:
    """Fit the critics of a policy, and write what came out into its weights.

    The logits of each D network, which follows its critic, get the critic's scale and bias.

    Args:
        policy: is changed.
        asked: what its critics make of the interactions (see `critic_rows`).
        fit: what is fitted.
    """
    found = {}
    for name, rows in asked.items():
        network = policy.prior if name == "where2act" else policy.aap
        after = held_out(rows, fit)
        strength = chosen_strength(rows, fit)
        design, start = rows.design(fit)
        fitted = fit_logits(design, rows.labels, start, strength)
        scaled = fitted
        if fit == "last-layer":
            numbers, ones = rows.design("scale")
            scaled = fit_logits(numbers, rows.labels, ones, chosen_strength(rows, "scale"))
        weights = (
            fitted if fit == "last-layer" else scaled[0] * rows.weights + scaled[1] * np.eye(len(rows.weights))[-1]
        )
        found[name] = Calibration(
            float(scaled[0]), float(scaled[1]), weights, strength, tuple(_rows(name, rows, after))
        )
        _write(network.critic_head, weights)
        own = _last_layer(network.affordance_head)
        _write(network.affordance_head, scaled[0] * own + scaled[1] * np.eye(len(own))[-1])
    return found


def check(labels: NDArray[np.bool_], objects: NDArray[np.str_]) -> None:
    """Refuse interactions that are too few to calibrate on.

    Raises:
        UsageError: with what there is, and what is needed.
    """
    successes, kinds = int(labels.sum()), len(np.unique(objects))
    failures = len(labels) - successes
    if kinds < MIN_OBJECTS or successes < MIN_OF_EACH or failures < MIN_OF_EACH:
        raise UsageError(
            f"{successes} successes and {failures} failures on {kinds} objects are too few to calibrate on; needed are "
            f"{MIN_OF_EACH} of each and {MIN_OBJECTS} objects that the policy has not seen: collect more"
        )


def critic_rows(
    policy: Policy, dataset: Dataset, rollouts: Sequence[int], seed: int
) -> dict[CalibratedCritic, CriticRows]:
    """Ask Where2Act and AAP about stored interactions, AAP after others of the same rollout, which AIP chooses.

    Args:
        policy: with a trained prior and AAP; without a trained AIP, the interactions are chosen at random.
        dataset: the interactions.
        rollouts: those of objects that the policy has not seen, at least one.
        seed: of the draws.
    """
    policy.modules().eval().requires_grad_(False)
    known = FrozenFeatures(dataset)
    candidates = Candidates.of(dataset, spread(rollouts, MAX_ROLLOUTS), DRAWS, seed)
    rows, asked = dataset.rows, candidates.questions
    index = candidates.ordered.rows[asked]
    places, frames = rows.xyz[index], rows.frame[index]
    labels = rows.success[index].numpy(force=True) > 0.5
    objects = np.array([dataset.objects[number] for number in candidates.rollouts]).repeat(asked.sum(dim=1).numpy())
    features = known.rows(policy.prior.encoder)[index]
    head = policy.prior.critic_head
    inputs = _last_inputs(head, policy.prior.action_logits, features, places, frames)
    found: dict[CalibratedCritic, CriticRows] = {
        "where2act": CriticRows(inputs, _last_layer(head), labels, objects, np.zeros(len(labels), np.int64))
    }
    frozen, aap = FrozenAap.of(policy.aap, known), policy.aap
    numbers = [number for number in INTERACTIONS if number <= candidates.count]
    made = candidates.rows[:, : max(numbers)]
    if "aip" in policy.trained:
        made = tries_by_aip(known, candidates.rows, frozen, policy.aip, max(numbers))
    features, parts = frozen.features[index], []
    for latents in frozen.latents(made)[:, numbers].unbind(dim=1):
        z = latents[:, None].expand(*asked.shape, -1)[asked]
        parts.append(_last_inputs(aap.critic_head, aap.action_logits, features, places, frames, z))
    found["aap"] = CriticRows(
        np.concatenate(parts),
        _last_layer(aap.critic_head),
        np.tile(labels, len(numbers)),
        np.tile(objects, len(numbers)),
        np.repeat(numbers, len(labels)),
    )
    return found


def together(parts: Sequence[CriticRows]) -> CriticRows:
    """Questions of several stores to the same critic as one."""
    first, *_ = parts
    names = ("inputs", "labels", "objects", "interactions")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return CriticRows(weights=first.weights, **joined)


def fit_logits(design: Float, labels: NDArray[np.bool_], start: Float, strength: float) -> Float:
    """Coefficients of a logistic regression, held near where they start, [m].

    The penalty of each is `strength` m / 2 times the mean square of the change of logits that it brings about, so that
    it does not depend on the units of `design`.

    Args:
        design: [Q, m].
        labels: [Q].
        start: [m].
        strength: of the penalty.
    """
    penalties = strength * len(start) * np.maximum((design**2).mean(axis=0), 1e-12)
    found = _newton(design, labels, start, penalties)
    if len(start) == 2 and found[0] < MIN_SCALE:
        found = _newton(design, labels, np.array([MIN_SCALE, start[1]]), np.array([_FIXED, penalties[1]]))
    return found


def chosen_strength(rows: CriticRows, fit: Fit) -> float:
    """The penalty under which fits to some of the objects do best on the others; of equals the strongest."""
    design, start = rows.design(fit)
    parts = _folds(rows.objects, INNER_FOLDS)
    losses = []
    for strength in STRENGTHS:
        loss = 0.0
        for part in parts:
            theta = fit_logits(design[~part], rows.labels[~part], start, strength)
            loss += float(_losses(design[part] @ theta, rows.labels[part]).sum())
        losses.append(loss)
    best = min(losses)
    return max(strength for strength, loss in zip(STRENGTHS, losses, strict=True) if loss <= best * (1 + 1e-9))


def held_out(rows: CriticRows, fit: Fit) -> Float:
    """Calibrated logits, [Q], those of each object by a fit, its penalty included, that has not seen the object."""
    design, start = rows.design(fit)
    logits = np.empty(len(rows.labels))
    for part in _folds(rows.objects, FOLDS):
        others = CriticRows(
            rows.inputs[~part], rows.weights, rows.labels[~part], rows.objects[~part], rows.interactions[~part]
        )
        theta = fit_logits(design[~part], others.labels, start, chosen_strength(others, fit))
        logits[part] = design[part] @ theta
    return logits


def _rows(name: CalibratedCritic, rows: CriticRows, after: Float) -> list[CalibrationRow]:
    found = []
    before = rows.logits
    for number in np.unique(rows.interactions):
        mine = rows.interactions == number
        labels, groups = rows.labels[mine], np.unique(rows.objects[mine], return_inverse=True)[1]
        losses = [_losses(logits[mine], labels) for logits in (before, after)]
        base = np.full(len(labels), labels.mean())
        low, high = ratio_interval(losses[0] - losses[1], np.ones(len(labels)), groups)
        found.append(
            CalibrationRow(
                critic=name,
                interactions=int(number),
                constant=float(cross_entropies(base, labels).mean()),
                before=float(losses[0].mean()),
                after=float(losses[1].mean()),
                gain=float((losses[0] - losses[1]).mean()),
                gain_low=low,
                gain_high=high,
                questions=len(labels),
                objects=int(groups.max()) + 1,
            )
        )
    return found


def _folds(objects: NDArray[np.str_], most: int) -> list[NDArray[np.bool_]]:
    """Which questions are held out together, [Q] each: those of whole objects."""
    names, which = np.unique(objects, return_inverse=True)
    count = min(most, len(names))
    return [which % count == fold for fold in range(count)]


def _losses(logits: Float, labels: NDArray[np.bool_]) -> Float:
    return np.logaddexp(0.0, np.where(labels, -logits, logits))


def _newton(design: Float, labels: NDArray[np.bool_], start: Float, penalties: Float) -> Float:
    """The least of a convex function: Newton's method, where a step that does not lower it is halved."""

    def value(theta: Float) -> float:
        return float(_losses(design @ theta, labels).sum() + 0.5 * (penalties * (theta - start) ** 2).sum())

    theta, least = start.astype(np.float64), value(start)
    for _ in range(_STEPS):
        expected = 0.5 * (1.0 + np.tanh(0.5 * (design @ theta)))
        slope = design.T @ (expected - labels) + penalties * (theta - start)
        curvature = (design * (expected * (1.0 - expected))[:, None]).T @ design + np.diag(penalties)
        step = np.linalg.solve(curvature, slope)
        size, moved = 1.0, value(theta - step)
        while moved > least and size > 1e-6:
            size *= 0.5
            moved = value(theta - size * step)
        if least - moved <= _TOLERANCE * max(1.0, abs(least)):
            break
        theta, least = theta - size * step, moved
    return theta


@torch.no_grad()
def _last_inputs(head: Head, ask: Callable[..., Tensor], *told: Tensor) -> Float:
    """What the last layer of a head gets when its critic is asked, and 1, [Q, n]."""
    kept: list[Tensor] = []
    hook = head.output.register_forward_pre_hook(lambda _, given: kept.append(given[0]))
    try:
        ask(*told)
    finally:
        hook.remove()
    (inputs,) = kept
    return np.concatenate([inputs.double().numpy(force=True), np.ones((len(inputs), 1))], axis=1)


def _last_layer(head: Head) -> Float:
    """Weights and bias of the one output, [n]."""
    assert head.output.bias is not None
    return np.append(head.output.weight.detach()[0].double().numpy(), float(head.output.bias.detach()[0]))


@torch.no_grad()
def _write(head: Head, weights: Float) -> None:
    head.output.weight.copy_(torch.from_numpy(weights[None, :-1]))
    head.output.bias.copy_(torch.from_numpy(weights[-1:]))
