"""How well scores tell successes from failures. NaN where a figure is not defined (no row, or one class only).

Intervals say how far a figure would scatter had other objects been drawn to test on (percentile bootstrap). Rows of one
object are alike, so that objects are resampled whole; resampled rows would make intervals far too narrow.

The published mix: the published code tops its test rollouts up by label, so its F-scores are of many more successes
than random interactions have. A test rollout has 32 rows. In `collect_data_pull.py` rows 1 to 7 are kept only if they
are successes, rows 8 to 15 only if the fingers held something, and rows 16 to 32 whatever they are. In
`collect_data_push.py` rows 1 to 10 are successes, rows 11 to 20 have no refused contact, and rows 21 to 32 are
anything. (Both are of the repository AdaAffordCode, folder code. The scripts for doors and faucets were not published;
the paper says nothing else of them.) A mean over those rows is, in expectation, a weighted mean over random ones.
Deviations: after 200 to 1,500 trials the scripts take what they get, so a rollout in which successes are rare has fewer
of them there than here; and `sample_succ.py` also scores row 0, which its encoder is shown.

Shapes: I rows, G groups (objects), B resamples, n random interactions of one rollout.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared import seeds
from shared.primitives import PRIMITIVES
from shared.types import Float

THRESHOLD = 0.5
"""Where a score counts as a predicted success, as in the published code."""
CALIBRATION_BINS = 10
"""Of equal width, for the calibration error."""
_MIN_PROBABILITY = 1e-7


@dataclass(frozen=True, slots=True)
class Discrimination:
    """Figures of one critic on one set of rows.

    Attributes:
        f_score: F1 of predicting success at the threshold 0.5.
        best_f_score: F1 at the threshold that is best in hindsight.
        bce: binary cross entropy, nats.
        auc: area under the ROC curve; ties count half.
        calibration_error: expected difference between what is predicted and what happens (ECE).
        base_rate: share of successes.
        rows: how many.
    """

    f_score: float
    best_f_score: float
    bce: float
    auc: float
    calibration_error: float
    base_rate: float
    rows: int


def discrimination(scores: ArrayLike, successes: ArrayLike) -> Discrimination:
    """All figures.

    Args:
        scores: probabilities, [I].
        successes: [I].
    """
    probabilities = np.asarray(scores, dtype=np.float64)
    labels = np.asarray(successes, dtype=bool)
    return Discrimination(
        f_score=f_score(probabilities >= THRESHOLD, labels),
        best_f_score=best_f_score(probabilities, labels),
        bce=cross_entropy(probabilities, labels),
        auc=area_under_roc(probabilities, labels),
        calibration_error=calibration_error(probabilities, labels),
        base_rate=float(labels.mean()) if len(labels) else float("nan"),
        rows=len(labels),
    )


def discrimination_in_chunks(
    rollouts: Sequence[int], size: int, judge: Callable[[Sequence[int]], tuple[ArrayLike, ArrayLike]]
) -> Discrimination:
    """All figures of the rows of many rollouts, `size` of which are judged at once to bound memory.

    Args:
        rollouts: at least one.
        size: of a chunk.
        judge: gives scores and successes, [I] each, of all rows of a chunk.
    """
    judged = [judge(rollouts[start : start + size]) for start in range(0, len(rollouts), size)]
    scores, successes = zip(*judged, strict=True)
    return discrimination(np.concatenate(scores), np.concatenate(successes))


def f_score(predicted: NDArray[np.bool_], labels: NDArray[np.bool_]) -> float:
    """F1 = 2 TP / (2 TP + FP + FN); NaN where there is nothing to find and nothing was claimed."""
    claimed_or_true = int(predicted.sum()) + int(labels.sum())
    return 2.0 * int((predicted & labels).sum()) / claimed_or_true if claimed_or_true else float("nan")


def best_f_score(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """The highest F1 that any threshold gives; NaN without a success."""
    if not labels.any():
        return float("nan")
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(labels[order])
    # A threshold cannot part equal scores: only the last of each run of equals is reached by one.
    reached = np.append(np.diff(scores[order]) != 0, True)
    f = 2.0 * hits / (np.arange(1, len(labels) + 1) + labels.sum())
    return float(f[reached].max())


def cross_entropy(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Mean binary cross entropy, nats."""
    return float(cross_entropies(scores, labels).mean()) if len(labels) else float("nan")


def cross_entropies(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Binary cross entropy of each row, nats, [I]; bounded, since a score may be 0 or 1."""
    clipped = np.clip(scores, _MIN_PROBABILITY, 1.0 - _MIN_PROBABILITY)
    return np.asarray(-np.log(np.where(labels, clipped, 1.0 - clipped)))


def calibration_error(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Expected calibration error: mean over rows of |mean score - share of successes| of the row's bin, ten bins."""
    if not len(labels):
        return float("nan")
    bins = np.minimum((scores * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    surplus = np.bincount(bins, weights=scores - labels, minlength=CALIBRATION_BINS)
    return float(np.abs(surplus).sum() / len(labels))


def area_under_roc(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Probability that a success scores above a failure."""
    positives, negatives = int(labels.sum()), int((~labels).sum())
    if not positives or not negatives:
        return float("nan")
    ranks = _ranks(scores)[labels]
    return float((ranks.sum() - positives * (positives + 1) / 2.0) / (positives * negatives))


def rank_correlation(scores: ArrayLike, others: ArrayLike) -> float:
    """Spearman's correlation; ties share their mean rank. NaN where one of the two does not vary."""
    return correlation(*(_ranks(np.asarray(values, dtype=np.float64)) for values in (scores, others)))


def correlation(values: ArrayLike, others: ArrayLike) -> float:
    """Pearson's correlation. NaN where one of the two does not vary."""
    pair = np.array([values, others], dtype=np.float64)
    if pair.shape[1] < 2 or (pair.std(axis=1) == 0).any():
        return float("nan")
    return float(np.asarray(np.corrcoef(pair))[0, 1])


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranks from 1, ties sharing their mean, as `scipy.stats.rankdata`, which takes half a second to import."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    mean_ranks = np.cumsum(counts) - (counts - 1) / 2.0
    return np.asarray(mean_ranks[inverse], dtype=np.float64)


CONFIDENCE = 0.95
RESAMPLES = 2000


def ratio_interval(above: ArrayLike, below: ArrayLike, groups: ArrayLike) -> tuple[float, float]:
    """An interval for sum(above) / sum(below), where whole groups of rows are drawn with replacement.

    Shares are such ratios, and so is F1 = 2 TP / (claimed + true). The resamples depend on the number of groups alone,
    so that methods that are compared on the same objects meet the same resamples.

    Args:
        above: what the numerator sums, [I].
        below: what the denominator sums, [I].
        groups: numbers from 0, [I]: whose row it is.

    Returns:
        Lower and upper limit at 95%; NaN where no row is given, or the ratio is not defined.
    """
    group = np.asarray(groups, dtype=np.int64)
    if not len(group):
        return float("nan"), float("nan")
    of_groups = np.unique(group, return_inverse=True)[1]
    count = int(of_groups.max()) + 1
    drawn = seeds.generator(0, "bootstrap", count).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    sums = [drawn @ np.bincount(of_groups, np.asarray(values, dtype=np.float64)) for values in (above, below)]
    defined = sums[1] > 0
    if not defined.any():
        return float("nan"), float("nan")
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(sums[0][defined] / sums[1][defined], (tail, 100.0 - tail))
    return float(low), float(high)


def f_score_interval(claimed: NDArray[np.bool_], labels: NDArray[np.bool_], groups: ArrayLike) -> tuple[float, float]:
    """The interval of F1 = 2 TP / (claimed + true), [I] each; see `ratio_interval`."""
    return ratio_interval(2.0 * (claimed & labels), 1.0 * claimed + labels, groups)


@dataclass(frozen=True, slots=True)
class RowMix:
    """How many rows of a published test rollout are of which kind.

    Attributes:
        successes: rows that are successes.
        valid: rows whose primitive ran to its end, successes among them.
        anything: rows that were kept whatever they are.
    """

    successes: int
    valid: int
    anything: int

    @property
    def rows(self) -> int:
        """All rows of a rollout."""
        return self.successes + self.valid + self.anything

    def weights(self, success: NDArray[np.bool_], valid: NDArray[np.bool_]) -> Float:
        """How many published rows each random interaction of one rollout stands for, [n]; their sum is `rows`.

        Zeros for a rollout without a success, which the scripts drop or never fill.

        Args:
            success: whether each succeeded, [n].
            valid: whether the primitive of each ran to its end, [n]; every success is valid.
        """
        if not success.any():
            return np.zeros(len(success))
        shares = ((self.successes, success), (self.valid, valid | success), (self.anything, np.ones_like(success)))
        weights: Float = np.sum([count * kind / kind.sum() for count, kind in shares], axis=0)
        return weights


PULL_MIX = RowMix(7, 8, 17)
"""Of primitives that close their fingers."""
PUSH_MIX = RowMix(10, 10, 12)
"""Of all others."""


def mix_for(primitive: str) -> RowMix:
    """The mix for a primitive; of pull-left and the like, which the paper does not test, that of pull or push.

    Raises:
        UsageError: there is no such primitive.
    """
    return PULL_MIX if PRIMITIVES.get(primitive).closes_fingers else PUSH_MIX


def shifted_threshold(base_rate: float, new_base_rate: float) -> float:
    """Which scores pass the threshold 0.5 once logits are shifted by logit(new base rate) - logit(base rate).

    This is what Bayes' rule makes of a calibrated score where successes have become more frequent and nothing else has
    changed (Saerens et al. 2002). Scores s pass where logit(s) + shift >= 0.

    Args:
        base_rate: of success where the scores are calibrated, above 0.
        new_base_rate: of success where they are used, above 0.
    """
    failures, successes = base_rate * (1.0 - new_base_rate), new_base_rate * (1.0 - base_rate)
    # Where everything succeeds before and after, nothing shifts.
    return failures / (failures + successes) if failures + successes else THRESHOLD
