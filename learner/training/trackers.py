"""Trackers: where else the figures of each validation go; their record is metrics.jsonl.

TensorBoard's files are written wherever it is installed. Others are named in an environment variable, which reaches
every process of a campaign and has no part in what is trained: `ADAAFFORD_TRACKERS=wandb,mlflow`. A tracker that fails
is left out for the rest of the training, which must not be lost for its sake.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from shared.extensions import Registry

logger = logging.getLogger(__name__)

VARIABLE = "ADAAFFORD_TRACKERS"
ALWAYS = "tensorboard"


class Tracking(Protocol):
    """One sitting of one training, as a tracker follows it."""

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """Figures of a step, by names such as "aap/score"."""
        ...

    def close(self) -> None:
        """The sitting ended."""
        ...


@dataclass(frozen=True, slots=True)
class Tracker:
    """A kind of tracker.

    Attributes:
        begin: follows a training, given its folder, the name of its stage, and the step where the sitting begins;
            imports what it needs, and raises UsageError where that is not installed.
    """

    begin: Callable[[Path, str, int], Tracking]


TRACKERS = Registry(
    "tracker",
    Tracker,
    {
        ALWAYS: "learner.training.tensorboard_tracker:TENSORBOARD",
        "wandb": "learner.training.wandb_tracker:WANDB",
        "mlflow": "learner.training.mlflow_tracker:MLFLOW",
    },
)


class Trackers:
    """All trackers of a sitting.

    Args:
        folder: of the training.
        stage: its name.
        step: where the sitting begins.
        environment: names further trackers.

    Raises:
        UsageError: there is no such tracker, or its package is not installed.
    """

    def __init__(self, folder: Path, stage: str, step: int, environment: Mapping[str, str]) -> None:
        named = [name.strip() for name in environment.get(VARIABLE, "").split(",")]
        chosen = {name: TRACKERS.get(name) for name in dict.fromkeys([ALWAYS, *filter(None, named)])}
        self._stage = stage
        self._tracking = {name: tracker.begin(folder, stage, step) for name, tracker in chosen.items()}

    def add(self, step: int, figures: Mapping[str, Any]) -> None:
        """The figures of a step; what is no number is left out."""
        values = {
            f"{self._stage}/{name}": float(value)
            for name, value in figures.items()
            if isinstance(value, int | float) and name != "step"
        }
        self._each(lambda tracking: tracking.add(step, values))

    def close(self) -> None:
        """The sitting ended."""
        self._each(lambda tracking: tracking.close())

    def _each(self, act: Callable[[Tracking], None]) -> None:
        for name, tracking in list(self._tracking.items()):
            try:
                act(tracking)
            except Exception as error:  # noqa: BLE001 - packages of others, which raise what they like.
                del self._tracking[name]
                logger.warning("tracker %s failed (%s: %s); the training goes on", name, type(error).__name__, error)
