"""MLflow: a database `mlflow.db` beside the metrics, unless the user sets MLFLOW_TRACKING_URI."""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from learner.training.trackers import Tracker
from shared.extras import require_packages

EXPERIMENT = "adaafford"


class MlflowRun:
    """A sitting of a training as a run."""

    def __init__(self, folder: Path, stage: str, step: int) -> None:
        require_packages("the tracker mlflow", "mlflow")
        uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder.absolute() / 'mlflow.db'}"
        self._client: Any = import_module("mlflow").MlflowClient(tracking_uri=uri)
        known = self._client.get_experiment_by_name(EXPERIMENT)
        experiment = known.experiment_id if known is not None else self._client.create_experiment(EXPERIMENT)
        run = self._client.create_run(experiment, run_name=f"{folder.name}-{stage}-{step}")
        self._run_id = run.info.run_id

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """See `learner.training.trackers.Tracking`."""
        for name, value in figures.items():
            self._client.log_metric(self._run_id, name, value, step=step)

    def close(self) -> None:
        """End the run."""
        self._client.set_terminated(self._run_id)


MLFLOW = Tracker(MlflowRun)
