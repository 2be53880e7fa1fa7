"""The paper's own figures, to stand beside those of a run (AdaAfford, quantitative evaluations, ablation, supplement).

Objects, physics and random draws differ, so the absolute figures are marks and no more.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from shared.policies.methods import MethodName

BUDGETS = (1, 2, 4)
PUBLISHED_MEASURES = ("f_score", "sample_success")
"""What the paper has figures of."""
STANDS_BESIDE: Mapping[str, str] = {
    **{measure: measure for measure in PUBLISHED_MEASURES},
    "mix_f_score": "f_score",
    "shifted_f_score": "f_score",
    "share_success": "sample_success",
}
"""Which of them each of our measures is compared with; the others have none."""


@dataclass(frozen=True, slots=True)
class PublishedFigures:
    """One method on one task, percent: one figure where the budget does not matter, else one for each of `BUDGETS`."""

    f_score: tuple[float, ...]
    sample_success: tuple[float, ...]

    def at(self, budget: int, measure: str) -> float | None:
        """The figure after a budget of interactions; None where the paper has none."""
        if measure not in STANDS_BESIDE:
            return None
        figures = self.f_score if STANDS_BESIDE[measure] == "f_score" else self.sample_success
        if len(figures) == 1:
            return figures[0]
        return figures[BUDGETS.index(budget)] if budget in BUDGETS else None


_PUSH_TRAIN: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((56.44,), (20.85,)),
    "where2act-interaction": PublishedFigures((72.13,), (31.53,)),
    "where2act-adaptation": PublishedFigures((64.16, 65.42, 64.99), (20.77, 22.72, 26.82)),
    "ours-random": PublishedFigures((70.24, 70.58, 70.85), (29.59, 31.35, 32.57)),
    "ours-purefps": PublishedFigures((66.78, 69.43, 70.65), (28.23, 31.50, 29.51)),
    "ours-argfps": PublishedFigures((66.78, 69.43, 70.65), (28.23, 31.50, 29.51)),
    "ours-fps": PublishedFigures((64.32, 69.58, 70.99), (26.22, 27.30, 30.65)),
    "ours-no-iteration": PublishedFigures((71.21, 72.64, 73.16), (30.67, 31.62, 32.56)),
    "ours-final": PublishedFigures((72.78, 73.12, 75.18), (33.82, 33.23, 35.23)),
}
_PUSH_TEST: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((59.95,), (21.69,)),
    "where2act-interaction": PublishedFigures((76.12,), (37.10,)),
    "where2act-adaptation": PublishedFigures((51.09, 53.28, 55.56), (19.06, 22.27, 24.50)),
    "ours-random": PublishedFigures((75.12, 76.92, 76.98), (30.78, 30.78, 29.48)),
    "ours-purefps": PublishedFigures((66.35, 66.55, 67.19), (34.15, 32.60, 35.06)),
    "ours-argfps": PublishedFigures((74.04, 75.03, 76.63), (33.11, 34.54, 36.49)),
    "ours-fps": PublishedFigures((66.17, 67.27, 69.08), (33.64, 35.19, 37.79)),
    "ours-no-iteration": PublishedFigures((77.24, 77.33, 77.17), (31.03, 33.89, 38.83)),
    "ours-final": PublishedFigures((77.58, 77.63, 78.42), (34.97, 36.75, 37.40)),
}
_PULL_TRAIN: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((31.19,), (1.92,)),
    "where2act-interaction": PublishedFigures((38.28,), (3.89,)),
    "where2act-adaptation": PublishedFigures((37.22, 38.48, 39.13), (1.11, 2.15, 1.62)),
    "ours-random": PublishedFigures((35.03, 34.48, 36.84), (4.44, 2.78, 6.11)),
    "ours-purefps": PublishedFigures((35.46, 37.54, 37.35), (2.78, 5.56, 2.78)),
    "ours-argfps": PublishedFigures((35.46, 37.54, 37.35), (3.89, 4.44, 6.11)),
    "ours-fps": PublishedFigures((39.88, 42.74, 43.55), (2.78, 5.56, 4.44)),
    "ours-no-iteration": PublishedFigures((41.19, 42.10, 42.81), (6.67, 7.22, 8.33)),
    "ours-final": PublishedFigures((42.62, 43.87, 44.08), (7.78, 9.44, 10.55)),
}
_PULL_TEST: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((36.36,), (10.00,)),
    "where2act-interaction": PublishedFigures((45.80,), (9.73,)),
    "where2act-adaptation": PublishedFigures((40.11, 45.52, 48.80), (3.40, 6.25, 10.17)),
    "ours-random": PublishedFigures((41.97, 44.88, 46.11), (6.13, 4.78, 8.26)),
    "ours-purefps": PublishedFigures((43.60, 48.91, 47.36), (6.96, 5.22, 3.91)),
    "ours-argfps": PublishedFigures((45.17, 47.39, 50.60), (8.69, 7.22, 10.00)),
    "ours-fps": PublishedFigures((43.67, 42.77, 48.33), (4.35, 3.91, 4.78)),
    "ours-no-iteration": PublishedFigures((48.31, 48.28, 50.50), (5.65, 6.52, 9.13)),
    "ours-final": PublishedFigures((49.51, 50.00, 51.33), (5.21, 7.39, 10.45)),
}
_CLOSED_DOOR: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((48.44,), (4.38,)),
    "where2act-interaction": PublishedFigures((66.79,), (9.09,)),
    "where2act-adaptation": PublishedFigures((50.21, 55.75, 56.81), (6.60, 7.18, 6.83)),
    "ours-random": PublishedFigures((52.41, 54.25, 53.37), (7.14, 6.84, 6.53)),
    "ours-purefps": PublishedFigures((53.53, 59.81, 67.20), (6.67, 7.64, 10.71)),
    "ours-argfps": PublishedFigures((58.42, 62.31, 68.72), (8.94, 11.25, 13.75)),
    "ours-fps": PublishedFigures((59.79, 63.43, 69.13), (8.88, 11.33, 12.10)),
    "ours-no-iteration": PublishedFigures((56.74, 64.88, 80.64), (9.77, 11.50, 22.00)),
    "ours-final": PublishedFigures((57.83, 65.60, 79.65), (10.86, 11.57, 22.14)),
}
_FAUCET: dict[MethodName, PublishedFigures] = {
    "where2act": PublishedFigures((64.92,), (55.46,)),
    "where2act-interaction": PublishedFigures((79.85,), (80.97,)),
    "where2act-adaptation": PublishedFigures((66.25, 62.18, 67.15), (57.50, 52.08, 61.70)),
    "ours-random": PublishedFigures((72.61, 76.29, 79.16), (61.81, 79.01, 80.82)),
    "ours-purefps": PublishedFigures((73.39, 79.13, 79.85), (61.88, 76.59, 72.50)),
    "ours-argfps": PublishedFigures((74.66, 78.30, 79.61), (61.42, 66.65, 74.75)),
    "ours-fps": PublishedFigures((74.19, 79.36, 77.95), (60.44, 70.12, 77.41)),
    "ours-no-iteration": PublishedFigures((73.81, 83.03, 84.32), (61.11, 81.60, 84.03)),
    "ours-final": PublishedFigures((77.42, 83.06, 83.83), (65.90, 81.66, 82.14)),
}
_ON_TRAINED_CATEGORIES = {
    "push": _PUSH_TRAIN,
    "pull": _PULL_TRAIN,
    "pull-closed-door": _CLOSED_DOOR,
    "push-faucet": _FAUCET,
}
_ON_NOVEL_CATEGORIES = {"push": _PUSH_TEST, "pull": _PULL_TEST}


def published(task: str, *, novel_categories: bool) -> Mapping[MethodName, PublishedFigures]:
    """The paper's figures for a task, by method; none for a task that the paper does not have.

    Args:
        task: what was evaluated.
        novel_categories: whether on categories that nothing was trained on.
    """
    return (_ON_NOVEL_CATEGORIES if novel_categories else _ON_TRAINED_CATEGORIES).get(task, {})


def published_figure(task: str, method: str, budget: int, measure: str, *, novel_categories: bool) -> float | None:
    """One of the paper's figures, percent; None where it has none.

    Args:
        task: what was evaluated.
        method: any name.
        budget: how many interactions.
        measure: one of `STANDS_BESIDE`, or another, of which the paper has none.
        novel_categories: whether on categories that nothing was trained on.
    """
    told = {str(name): each for name, each in published(task, novel_categories=novel_categories).items()}
    return told[method].at(budget, measure) if method in told else None
