"""Adaptation curves of several trainings, pooled over their seeds, with intervals over objects.

Shapes: Q questions in all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learner.evaluation.curve import Answers, Asked, CriticKind
from learner.metrics import THRESHOLD, cross_entropies, discrimination, f_score_interval, ratio_interval

_PRIOR, _NO_TRIES, _ORACLE = Asked("where2act", 0), Asked("random", 0), Asked("oracle", 0)


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One critic after some interactions; NaN where a figure is not defined.

    Attributes:
        name: of the training.
        run: the place of its run among those of the name, from "1"; "" for all of them together.
        critic: whose answers, and how its interactions were chosen.
        tries: how many.
        f_score: at the threshold 0.5, with its 95% interval over objects.
        best_f_score: at the threshold best in hindsight.
        bce: binary cross entropy, nats.
        auc: area under the ROC curve.
        calibration_error: ECE.
        base_rate: share of successes among the questions.
        questions: how many; a run's draws of interactions and questions from one rollout all count.
        objects: how many they are about.
        closed: share of the gap in cross entropy between Where2Act and the oracle, with its 95% interval over objects.
        closed_from_none: the same of the gap between AAP without interactions, a second prior, and the oracle.
    """

    name: str
    run: str
    critic: CriticKind
    tries: int
    f_score: float
    f_score_low: float
    f_score_high: float
    best_f_score: float
    bce: float
    auc: float
    calibration_error: float
    base_rate: float
    questions: int
    objects: int
    closed: float
    closed_low: float
    closed_high: float
    closed_from_none: float


def curve_rows(name: str, runs: Sequence[tuple[str, Answers]]) -> list[CurveRow]:
    """Rows of a training: those of all its runs together first, then of each.

    Args:
        name: of the training.
        runs: each run's name and what its critics answered; all to the same critics and numbers of interactions.
    """
    pooled = rows_of(name, "", [answers for _, answers in runs])
    return pooled + [row for run, answers in runs for row in rows_of(name, run, [answers])]


def rows_of(name: str, run: str, answers: Sequence[Answers]) -> list[CurveRow]:
    """A row for each critic and number of interactions."""
    labels = np.concatenate([found.labels for found in answers])
    _, groups = np.unique(np.concatenate([found.objects for found in answers]), return_inverse=True)
    scores = {
        asked: np.concatenate([found.scores[asked] for found in answers]).astype(np.float64)
        for asked in answers[0].scores
    }
    losses = {asked: cross_entropies(found, labels) for asked, found in scores.items()}
    return [_row(name, run, asked, scores[asked], losses, labels, groups) for asked in scores]


def _row(
    name: str,
    run: str,
    asked: Asked,
    scores: NDArray[np.float64],
    losses: dict[Asked, NDArray[np.float64]],
    labels: NDArray[np.bool_],
    groups: NDArray[np.int64],
) -> CurveRow:
    found = discrimination(scores, labels)
    f_low, f_high = f_score_interval(scores >= THRESHOLD, labels, groups)
    closed, closed_low, closed_high, from_none = (float("nan"),) * 4
    if _ORACLE in losses:
        gained, whole = losses[_PRIOR] - losses[asked], losses[_PRIOR] - losses[_ORACLE]
        closed = share(gained, whole)
        closed_low, closed_high = ratio_interval(gained, whole, groups)
        from_none = share(losses[_NO_TRIES] - losses[asked], losses[_NO_TRIES] - losses[_ORACLE])
    return CurveRow(
        name=name,
        run=run,
        critic=asked.critic,
        tries=asked.tries,
        f_score=found.f_score,
        f_score_low=f_low,
        f_score_high=f_high,
        best_f_score=found.best_f_score,
        bce=found.bce,
        auc=found.auc,
        calibration_error=found.calibration_error,
        base_rate=found.base_rate,
        questions=found.rows,
        objects=len(np.unique(groups)),
        closed=closed,
        closed_low=closed_low,
        closed_high=closed_high,
        closed_from_none=from_none,
    )


def share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    """Sum of a part over the sum of the whole; NaN where there is no gap to close."""
    gap = float(whole.sum())
    return float(part.sum()) / gap if gap > 0 else float("nan")
