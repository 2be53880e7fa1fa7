"""The training loop that all stages share: Adam, a decaying rate, validation, checkpoints and a word of progress.

Every step draws its randomness from the seed, the stage's name and its own number, so that a run that was killed and
resumed gives the same bits as one that was not (on one kind of CPU, with one number of threads).

Adam is used without PyTorch's compiler: its methods import that, for two seconds, and here nothing is compiled.
"""

import functools
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from learner.settings import METRICS_FILE, TrainingConfig
from learner.training import data_parallel
from learner.training.checkpoint import Cursor, check_fingerprint, read_checkpoint, read_cursor, write_checkpoint
from learner.training.hardware import Hardware
from learner.training.trackers import Trackers
from shared.errors import UsageError
from shared.formatting import finite
from shared.io.documents import json_lines
from shared.io.files import read_bounded, remove_remnants, write_atomically
from shared.progress import Progress, minutes
from shared.seeds import generator

CHECKPOINT_FILE = "checkpoint.safetensors"
MAX_METRICS_BYTES = 1 << 26
WARMING = 0.1
"""Share of the steps in which the learning rate grows, where it follows a cosine."""


@dataclass(frozen=True, slots=True)
class ParameterGroup:
    """Parameters that learn at a common factor of the learning rate."""

    parameters: tuple[nn.Parameter, ...]
    rate: float = 1.0


@dataclass(frozen=True, slots=True)
class StepResult:
    """Losses of one step, which are summed, and how many interactions it saw."""

    losses: Mapping[str, Tensor]
    interactions: int


class Stage(Protocol):
    """What is trained, on what, and how it is judged."""

    name: str

    @property
    def module(self) -> nn.Module:
        """Holds everything that is trained."""
        ...

    def parameter_groups(self) -> list[ParameterGroup]:
        """What the optimiser may change."""
        ...

    def loss(self, rng: np.random.Generator) -> StepResult:
        """The losses of one batch, drawn by `rng`."""
        ...

    def validate(self) -> dict[str, float]:
        """Figures on objects not trained on; the lower "score", the better."""
        ...


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """How a stage went; the module holds its best weights."""

    steps: int
    best_step: int
    seconds: float
    interactions: int
    metrics: dict[str, float]
    """Validation figures of the best weights."""


def train(
    stage: Stage,
    config: TrainingConfig,
    seed: int,
    out: Path,
    fingerprint: str = "",
    title: str = "",
    hardware: Hardware | None = None,
    *,
    silent: bool = False,
) -> TrainingResult:
    """Train a stage, from its last checkpoint in `out` where there is one.

    Args:
        stage: what to train; its module ends up with the best weights.
        config: how long, how fast.
        seed: of all randomness.
        out: an existing folder for the checkpoint and the metrics.
        fingerprint: of everything that the result depends on; a checkpoint with another one is refused.
        title: what lines of progress call it; the stage's name where none is given.
        hardware: what to train on, where the stage's module and data already are; the CPU where none is given.
        silent: say nothing of how it goes.

    Raises:
        UsageError: the checkpoint is of another run, or the loss is not finite.
        StoreError: the checkpoint is damaged.
    """
    return _Loop(stage, config, seed, out, fingerprint, hardware or Hardware()).run(title or stage.name, silent)


class _Losses(nn.Module):
    """A stage's losses as a forward pass, which is what DistributedDataParallel watches."""

    def __init__(self, stage: Stage) -> None:
        super().__init__()
        self.module = stage.module
        self._loss = stage.loss

    def forward(self, rng: np.random.Generator) -> tuple[dict[str, Tensor], int]:
        """The losses of one batch, and how many interactions it has."""
        result = self._loss(rng)
        return dict(result.losses), result.interactions


class _Loop:
    """The state of one training run."""

    def __init__(
        self, stage: Stage, config: TrainingConfig, seed: int, out: Path, fingerprint: str, hardware: Hardware
    ) -> None:
        self.stage, self.config, self.seed, self.out, self.hardware = stage, config, seed, out, hardware
        if config.seconds is not None and data_parallel.processes() > 1:
            raise UsageError("'seconds' is for one process, since clocks differ; give 'steps' alone to several")
        self.groups = [group for group in stage.parameter_groups() if group.parameters]
        self.optimiser = Adam(
            [{"params": list(group.parameters)} for group in self.groups],
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
        )
        self.cursor = Cursor(fingerprint=fingerprint)
        self.best = {name: tensor.clone() for name, tensor in stage.module.state_dict().items()}
        self._loss = math.nan
        self._resume()
        # Nobody may write a checkpoint before everybody has read the last one.
        data_parallel.wait_for_all()
        losses = _Losses(stage)
        self._forward: nn.Module = losses
        if data_parallel.processes() > 1:
            # A gradient that never comes, of what a stage leaves as it is, would otherwise be waited for.
            self._forward = DistributedDataParallel(losses, find_unused_parameters=True)
        self._trackers: Trackers | None = None
        if data_parallel.rank() == 0:
            self._trackers = Trackers(out, stage.name, self.cursor.step, os.environ)
        self._saved_at = time.monotonic()

    def run(self, title: str, silent: bool) -> TrainingResult:
        """Step until the steps, the seconds or the patience are used up."""
        config, silent = self.config, silent or data_parallel.rank() > 0
        # Plain lines go to standard output, where a campaign reads them from its trainer and passes them on.
        progress = Progress(
            title,
            config.steps,
            unit="steps",
            done=self.cursor.step,
            details=self._details,
            live=not silent and sys.stdout.isatty() and sys.stderr.isatty(),
            # Where another process speaks for this one, nothing is said.
            say=(lambda line: None) if silent else partial(print, flush=True),
        )
        with progress:
            while not self._finished():
                self._step()
                left = math.inf if config.seconds is None else max(config.seconds - self.cursor.seconds, 0.0)
                progress.show(self.cursor.step, most_left_s=left)
        if self._trackers is not None:
            self._trackers.close()
        progress.say(self._summary(title))
        self.stage.module.load_state_dict(self.best)
        self.stage.module.eval()
        cursor = self.cursor
        return TrainingResult(cursor.step, cursor.best_step, cursor.seconds, cursor.interactions, cursor.best_metrics)

    def _details(self) -> str:
        """The loss, the speed and the best score so far."""
        best = f", best score {self.cursor.best_score:.4f}" if self.cursor.best_metrics else ""
        return f"loss {self._loss:.4f}, {self._rate():,.0f} interactions/s{best}"

    def _summary(self, title: str) -> str:
        cursor = self.cursor
        best = f", best score {cursor.best_score:.4f} at step {cursor.best_step}" if cursor.best_metrics else ""
        return f"{title}: {cursor.step} steps in {minutes(cursor.seconds)}, {self._rate():,.0f} interactions/s{best}"

    def _rate(self) -> float:
        """Interactions a second, over all sittings."""
        return self.cursor.interactions / max(self.cursor.seconds, 1e-9)

    def _finished(self) -> bool:
        spent = self.config.seconds is not None and self.cursor.seconds >= self.config.seconds
        return self.cursor.step >= self.config.steps or spent or self.cursor.misses >= self.config.patience

    def _step(self) -> None:
        started = time.monotonic()
        step = self.cursor.step
        rate = self.config.learning_rate * rate_factor(self.config, step)
        for group, options in zip(self.groups, self.optimiser.param_groups, strict=True):
            options["lr"] = rate * group.rate
        self.stage.module.train()
        with self.hardware.products():
            losses, interactions = self._forward(generator(self.seed, f"learner.{self.stage.name}", step))
        total = torch.stack(list(losses.values())).sum()
        values = data_parallel.averaged(torch.stack(list(losses.values()))).tolist()
        self._loss = math.fsum(values)
        if not math.isfinite(self._loss):
            raise UsageError(f"{self.stage.name}: the loss is not finite at step {step}; lower learning_rate")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.cursor = self.cursor.model_copy(
            update={
                "step": step + 1,
                "interactions": self.cursor.interactions + interactions,
                "seconds": self.cursor.seconds + time.monotonic() - started,
            }
        )
        ended = self._finished()
        if ended or self.cursor.step % self.config.validate_every == 0:
            self._validate(dict(zip(losses, values, strict=True)))
        if ended or time.monotonic() - self._saved_at >= self.config.checkpoint_seconds:
            self._save()

    def _validate(self, losses: dict[str, float]) -> None:
        started = time.monotonic()
        self.stage.module.eval()
        metrics = self.stage.validate()
        better = metrics["score"] < self.cursor.best_score
        if better:
            self.best = {name: tensor.clone() for name, tensor in self.stage.module.state_dict().items()}
        self.cursor = self.cursor.model_copy(
            update={
                "misses": 0 if better else self.cursor.misses + 1,
                "best_score": metrics["score"] if better else self.cursor.best_score,
                "best_step": self.cursor.step if better else self.cursor.best_step,
                "best_metrics": metrics if better else self.cursor.best_metrics,
            }
        )
        line: dict[str, Any] = {"stage": self.stage.name, "step": self.cursor.step}
        line |= {f"loss_{name}": value for name, value in losses.items()} | metrics
        line |= {
            "training_seconds": round(self.cursor.seconds, 3),
            "validation_seconds": round(time.monotonic() - started, 3),
            "interactions_per_second": round(self.cursor.interactions / max(self.cursor.seconds, 1e-9), 1),
        }
        if self._trackers is not None:
            with (self.out / METRICS_FILE).open("a", encoding="utf-8") as file:
                file.write(json.dumps(finite(line)) + "\n")
            self._trackers.add(self.cursor.step, finite(line))

    def _save(self) -> None:
        if data_parallel.rank() > 0:
            return
        path = self.out / CHECKPOINT_FILE
        write_checkpoint(path, self.cursor, self.stage.module, self.best, self.optimiser)
        self._saved_at = time.monotonic()

    def _resume(self) -> None:
        path = self.out / CHECKPOINT_FILE
        remove_remnants(self.out)
        if path.exists():
            check_fingerprint(read_cursor(path), self.cursor.fingerprint, self.out)
            self.cursor, self.best = read_checkpoint(path, self.stage.module, self.optimiser)
        if data_parallel.rank() == 0:
            self._forget_metrics_after(self.cursor.step)

    def _forget_metrics_after(self, step: int) -> None:
        """Drop lines written after the checkpoint, which will be written again, and a line that a kill cut off."""
        path = self.out / METRICS_FILE
        if not path.exists():
            return
        lines = read_bounded(path, MAX_METRICS_BYTES).decode(errors="replace").splitlines()
        kept = [
            line
            for line in json_lines(lines)
            if isinstance(at := line.setdefault("step", 0), int | float) and at <= step
        ]
        text = "".join(json.dumps(line) + "\n" for line in kept)
        write_atomically(path, text.encode())


def rate_factor(config: TrainingConfig, step: int) -> float:
    """What the learning rate is multiplied with at a step, from 0."""
    if config.schedule == "published":
        return config.decay ** (step // config.decay_steps)
    done = (step + 0.5) / config.steps
    if done < WARMING:
        return done / WARMING
    return 0.5 * (1.0 + math.cos(math.pi * (done - WARMING) / (1.0 - WARMING)))


P = ParamSpec("P")
T = TypeVar("T")

COMPILER = "torch._dynamo"


def without_compiler(method: Callable[P, T]) -> Callable[P, T]:
    """The same method; while it runs, something that does nothing stands for the compiler, unless that is imported."""

    @functools.wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        with _stand_in():
            return method(*args, **kwargs)

    return call


@contextmanager
def _stand_in() -> Iterator[None]:
    if COMPILER in sys.modules:
        yield
        return
    module = ModuleType(COMPILER)
    module.__dict__.update(disable=lambda function, *_, **__: function, graph_break=lambda: None)
    sys.modules[COMPILER] = module
    try:
        yield
    finally:
        del sys.modules[COMPILER]


class Adam(torch.optim.Adam):
    """`torch.optim.Adam`, with the same steps."""

    __init__ = without_compiler(torch.optim.Adam.__init__)
    step = without_compiler(torch.optim.Adam.step)
    zero_grad = without_compiler(torch.optim.Adam.zero_grad)
    state_dict = without_compiler(torch.optim.Adam.state_dict)
    load_state_dict = without_compiler(torch.optim.Adam.load_state_dict)
