"""TensorBoard event files: a view of the metrics, where TensorBoard is installed; their record is metrics.jsonl."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

EVENTS_FOLDER = "tensorboard"


class EventFiles:
    """Writes the figures of each validation where TensorBoard finds them.

    Args:
        folder: of the event files.
        step: where this sitting begins; what earlier sittings wrote of later steps is hidden.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._writer: Any = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(folder), purge_step=step + 1)

    def add(self, step: int, figures: Mapping[str, Any]) -> None:
        """The figures of a step, each under the stage's name; what is no number is left out."""
        if self._writer is None:
            return
        for name, value in figures.items():
            if isinstance(value, int | float) and name != "step":
                self._writer.add_scalar(f"{figures['stage']}/{name}", value, step)
        self._writer.flush()

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()
