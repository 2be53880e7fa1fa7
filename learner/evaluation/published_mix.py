"""The mix of rows that the paper tested on, as weights of our random interactions.

The published code tops its test rollouts up by label, so its F-scores are of many more successes than random
interactions have. A test rollout has 32 rows. In `collect_data_pull.py` rows 1 to 7 are kept only if they are
successes, rows 8 to 15 only if the fingers held something, and rows 16 to 32 whatever they are. In
`collect_data_push.py` rows 1 to 10 are successes, rows 11 to 20 have no refused contact, and rows 21 to 32 are
anything. (Both are of the repository AdaAffordCode, folder code. The scripts for doors and faucets were not published;
the paper says nothing else of them.) A mean over those rows is, in expectation, a weighted mean over random ones.

Deviations: after 200 to 1,500 trials the scripts take what they get, so a rollout in which successes are rare has fewer
of them there than here; and `sample_succ.py` also scores row 0, which its encoder is shown.

Shapes: n random interactions of one rollout.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learner.metrics import THRESHOLD
from shared.primitives import PRIMITIVES
from shared.types import Float


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
