"""Where does a training step's time go, and how many times faster is it than a straightforward port of the paper's?

The rate is that of the training loop itself. Its parts are measured on the same steps taken apart: the encoder is cut
off from the heads, so that the gradient through each is timed by itself.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from benchmarks.script import main
from benchmarks.straightforward import POINTS, PublishedStep
from cluster.cli.benchmarks.learning import NETWORKS, stages_of, training_rate
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from learner.data.dataset import Dataset, load_dataset
from learner.data.sampling import split
from learner.settings import LearnerConfig
from learner.training.hardware import Hardware
from learner.training.loop import Stage
from shared.progress import Progress
from shared.seeds import generator

PARTS = ("read", "sample", "encode", "heads", "optimiser")


class LearningSettings(StoredSettings):
    """Time training of the prior, AAP and AIP, and beside it a straightforward port of the published training step."""

    repeats: int = Field(5, ge=1, le=1000)
    """The median of these counts."""
    steps: int = Field(10, ge=1, le=100_000)
    """Of each network in each repeat."""
    port_interactions: int = Field(4, ge=2, le=32)
    """Of the published step in each repeat, seconds each."""


def measure(command: LearningSettings) -> dict[str, Any]:
    """Measure, turn by turn, and print a table."""
    config = LearnerConfig(seed=command.seed)
    rates: dict[str, list[float]] = {name: [] for name in (*NETWORKS, "port")}
    parts: dict[str, dict[str, list[float]]] = {name: {part: [] for part in PARTS} for name in NETWORKS}
    with stored(command) as store:
        begun = time.perf_counter()
        dataset = load_dataset(store, config.network)
        read_s = time.perf_counter() - begun
        stages, port = stages_of(dataset, split(dataset, None, None), config), Port(dataset, command.port_interactions)
        with Progress("turns of training, and of the published step", command.repeats + 1) as progress:
            for turn in range(command.repeats + 1):
                for name, stage, settings in stages:
                    rate = training_rate(stage, settings, command.steps, config.seed, Hardware())
                    seconds = StepApart(stage).take_all(command.steps, config.seed)
                    if turn:  # The first one warms up.
                        rates[name].append(rate)
                        # A store is read once a run, however many steps follow.
                        for part, value in ({"read": read_s / settings.steps} | seconds).items():
                            parts[name][part].append(value)
                if turn:
                    rates["port"].append(port.rate())
                progress.advance()
        rate_of = {name: median(each) for name, each in rates.items()}
        step = {name: {part: median(each) for part, each in found.items()} for name, found in parts.items()}
        result = {f"{name.replace('-', '_')}_interactions_per_second": rate_of[name] for name in NETWORKS} | {
            "straightforward_port_interactions_per_second": rate_of["port"],
            "times_straightforward_port": rate_of["aap"] / rate_of["port"],
            "step_seconds": step,
            "read_share": {name: found["read"] / sum(found.values()) for name, found in step.items()},
            "threads": torch.get_num_threads(),
            "points": dataset.clouds.points.shape[1],
            "port_points": POINTS,
            "interactions_stored": len(dataset.rows),
            "repeats": command.repeats,
            "steps": command.steps,
            "port_interactions": command.port_interactions,
        }
        result |= source_of(command, store)
    print(f"{command.repeats} times {command.steps} steps, {result['threads']} threads; medians")
    for name, found in step.items():
        print(f"  {name:<16}{rate_of[name]:>9,.0f} interactions/s; ms a step: ", end="")
        print(", ".join(f"{part} {1e3 * seconds:.1f}" for part, seconds in found.items()))
    print(f"  {'port':<16}{rate_of['port']:>9.2f} interactions/s at {POINTS:,} points each")
    print(f"AAP is {result['times_straightforward_port']:,.0f} times the straightforward port")
    return result


class StepApart:
    """Training steps of a stage with a clock between their parts.

    Sampling ends where the stage first asks its encoder or, where it has inherited one, for gains or codes. Features
    are handed on as new leaves: the first backward pass ends at them, the second goes on through the encoder.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.seconds = dict.fromkeys(("sample", "encode", "heads", "optimiser"), 0.0)
        learning = [parameter for group in stage.parameter_groups() for parameter in group.parameters]
        self.optimiser = torch.optim.Adam(learning)
        self._sampled_at: float | None = None
        self._cuts: list[tuple[Tensor, Tensor]] = []

    def take_all(self, steps: int, seed: int) -> dict[str, float]:
        """Seconds a step by part, the mean of some steps."""
        for step in range(steps):
            self.take(generator(seed, "bench.learner", step))
        return {part: seconds / steps for part, seconds in self.seconds.items()}

    def take(self, rng: np.random.Generator) -> None:
        """One step."""
        self.stage.module.train()
        self._sampled_at, self._cuts, encoding_before = None, [], self.seconds["encode"]
        begun = time.perf_counter()
        with self._watched():
            losses = self.stage.loss(rng).losses
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()  # type: ignore[no-untyped-call]
        headed = time.perf_counter()
        sampled = headed if self._sampled_at is None else self._sampled_at
        self.seconds["sample"] += sampled - begun
        self.seconds["heads"] += headed - sampled - (self.seconds["encode"] - encoding_before)
        for features, leaf in self._cuts:
            features.backward(leaf.grad)  # type: ignore[no-untyped-call]
        encoded = time.perf_counter()
        self.optimiser.step()
        self.seconds["encode"] += encoded - headed
        self.seconds["optimiser"] += time.perf_counter() - encoded

    def _watched(self) -> "_Patched":
        network: Any = getattr(self.stage.module, "aap", self.stage.module)
        patches: list[tuple[Any, str, Callable[..., Any]]] = [
            (network.encoder, "forward", self._timed(network.encoder.forward)),
            (network.encoder, "at", self._cut(self._timed(network.encoder.at))),
        ]
        for owner, name in ((self.stage, "gains"), (network, "interaction_codes")):
            if hasattr(owner, name):
                patches.append((owner, name, self._noted(getattr(owner, name))))
        return _Patched(patches)

    def _noted(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*arguments: Any) -> Any:
            self._sampled_at = self._sampled_at or time.perf_counter()
            return function(*arguments)

        return noted

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            begun = time.perf_counter()
            self._sampled_at = self._sampled_at or begun
            found = function(*arguments)
            self.seconds["encode"] += time.perf_counter() - begun
            return found

        return timed

    def _cut(self, function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def cut(*arguments: Any) -> Tensor:
            features = function(*arguments)
            if not features.requires_grad:
                return features
            leaf = features.detach().requires_grad_()
            self._cuts.append((features, leaf))
            return leaf

        return cut


class _Patched:
    """Puts other functions in the place of methods of single instances for as long as the context lasts."""

    def __init__(self, patches: list[tuple[Any, str, Callable[..., Any]]]) -> None:
        self._patches = patches

    def __enter__(self) -> None:
        for owner, name, function in self._patches:
            owner.__dict__[name] = function

    def __exit__(self, *_: object) -> None:
        for owner, name, _function in self._patches:
            del owner.__dict__[name]


class Port:
    """The port's step on clouds of the published size: those of the data set, filled up with points beside theirs."""

    def __init__(self, dataset: Dataset, interactions: int) -> None:
        rng = np.random.default_rng(0)
        rows, index = dataset.rows, dataset.rollouts[0][:interactions]
        spare = torch.from_numpy(rng.integers(0, dataset.clouds.points.shape[1], POINTS))
        own = min(POINTS, dataset.clouds.points.shape[1])
        spare[:own] = torch.arange(own)
        jitter = torch.from_numpy(rng.normal(0.0, 0.003, (len(index), POINTS, 3)).astype(np.float32))
        jitter[:, :own] = 0.0
        clouds = dataset.clouds.points[rows.cloud[index]][:, spare] + jitter
        self._batch = clouds, rows.point[index], rows.frame[index], rows.motion[index], rows.success[index]
        self._step = PublishedStep(0)

    def rate(self) -> float:
        """Interactions a second of one step."""
        begun = time.perf_counter()
        self._step(*self._batch)
        return len(self._batch[1]) / (time.perf_counter() - begun)


if __name__ == "__main__":
    main("learning", LearningSettings, measure)
