"""TensorBoard event files: a view of the metrics, where TensorBoard is installed; their record is metrics.jsonl.

The files are written here and not by `torch.utils.tensorboard`, which puts the host's name into theirs.
"""

import os
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from learner.training.trackers import Tracker

EVENTS_FOLDER = "tensorboard"
_VERSION = "brain.Event:2"


class EventFiles:
    """Writes the figures of each validation where TensorBoard finds them.

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
        """See `learner.training.trackers.Tracking`."""
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


TENSORBOARD = Tracker(lambda folder, stage, step: EventFiles(folder / EVENTS_FOLDER, step))
