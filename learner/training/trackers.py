"""Trackers: where else the figures of each validation go; their record is metrics.jsonl.

TensorBoard's files are written wherever it is installed. Others are named in an environment variable, which reaches
every process of a campaign and has no part in what is trained: `ADAAFFORD_TRACKERS=wandb,mlflow`. A tracker that fails
is left out for the rest of the training, which must not be lost for its sake.
"""

import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from shared.extensions import Registry
from shared.extras import require_packages

logger = logging.getLogger(__name__)

VARIABLE = "ADAAFFORD_TRACKERS"
ALWAYS = "tensorboard"
EVENTS_FOLDER = "tensorboard"
_VERSION = "brain.Event:2"
EXPERIMENT = "adaafford"


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


class EventFiles:
    """TensorBoard: event files, where it is installed.

    They are written here and not by `torch.utils.tensorboard`, which puts the host's name into its files.

    Args:
        folder: of the event files.
        step: where this sitting begins; what earlier sittings wrote of later steps is hidden.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._path: Path | None = None
        if find_spec("tensorboard") is not None:
            from tensorboard.compat.proto.event_pb2 import SessionLog

            folder.mkdir(parents=True, exist_ok=True)
            self._path = folder / f"events.out.tfevents.{time.time_ns()}.{os.getpid()}"
            self._write(file_version=_VERSION)
            self._write(step=step + 1, session_log=SessionLog(status=SessionLog.START))

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """See `Tracking`."""
        if self._path is None:
            return
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = [Summary.Value(tag=name, simple_value=value) for name, value in figures.items()]
        self._write(step=step, summary=Summary(value=values))

    def close(self) -> None:
        """Nothing is open."""

    def _write(self, **content: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        assert self._path is not None
        # An event is rare, so nothing is left open or unwritten whenever the process ends.
        with self._path.open("ab") as file:
            RecordWriter(file).write(Event(wall_time=time.time(), **content).SerializeToString())


class WandbRun:
    """Weights & Biases: offline unless WANDB_MODE is set; `wandb sync RUN/wandb/offline-run-*` uploads it later."""

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
        """See `Tracking`."""
        self._run.log({**figures, f"{self._stage}/step": step})

    def close(self) -> None:
        """End the run."""
        self._run.finish()


class MlflowRun:
    """MLflow: a database `mlflow.db` beside the metrics, unless MLFLOW_TRACKING_URI is set."""

    def __init__(self, folder: Path, stage: str, step: int) -> None:
        require_packages("the tracker mlflow", "mlflow")
        uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder.absolute() / 'mlflow.db'}"
        self._client: Any = import_module("mlflow").MlflowClient(tracking_uri=uri)
        known = self._client.get_experiment_by_name(EXPERIMENT)
        experiment = known.experiment_id if known is not None else self._client.create_experiment(EXPERIMENT)
        run = self._client.create_run(experiment, run_name=f"{folder.name}-{stage}-{step}")
        self._run_id = run.info.run_id

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """See `Tracking`."""
        for name, value in figures.items():
            self._client.log_metric(self._run_id, name, value, step=step)

    def close(self) -> None:
        """End the run."""
        self._client.set_terminated(self._run_id)


TRACKERS = Registry(
    "tracker",
    Tracker,
    {
        ALWAYS: Tracker(lambda folder, stage, step: EventFiles(folder / EVENTS_FOLDER, step)),
        "wandb": Tracker(WandbRun),
        "mlflow": Tracker(MlflowRun),
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
