"""Weights & Biases: offline unless the user sets WANDB_MODE; `wandb sync RUN/wandb/offline-run-*` uploads it later."""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from learner.training.trackers import Tracker
from shared.extras import require_packages


class WandbRun:
    """A sitting of a training as a run; its metrics are drawn over the steps of their stage."""

    def __init__(self, folder: Path, stage: str, step: int) -> None:
        require_packages("the tracker wandb", "wandb")
        wandb: Any = import_module("wandb")
        self._stage = stage
        # What it would find out about the machine, its user and the code is not asked for.
        settings = wandb.Settings(
            console="off", disable_git=True, x_disable_meta=True, x_disable_stats=True, silent=True
        )
        self._run: Any = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "adaafford"),
            name=f"{folder.name}-{stage}-{step}",
            dir=str(folder),
            mode=os.environ.get("WANDB_MODE", "offline"),
            settings=settings,
        )
        self._run.define_metric(f"{stage}/*", step_metric=f"{stage}/step")

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """See `learner.training.trackers.Tracking`."""
        self._run.log({**figures, f"{self._stage}/step": step})

    def close(self) -> None:
        """End the run."""
        self._run.finish()


WANDB = Tracker(WandbRun)
