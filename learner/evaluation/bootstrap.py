"""How far a figure would scatter had other objects been drawn to test on: percentile bootstrap over objects.

Rows of one object are alike, so that objects are resampled whole; resampled rows would make intervals far too narrow.

Shapes: I rows, G groups (objects), B resamples.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared import seeds

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
