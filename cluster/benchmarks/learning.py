"""How fast does the learner see interactions? What users run is timed, and beside it the published step.

The rate is that of the training loop itself. Where its time goes is measured on the same steps taken apart: the encoder
is cut off from the heads, so that the gradient through each is timed by itself.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cluster.benchmarks.straightforward import POINTS, PublishedStep
from learner.aap import AapStage, OracleStage
from learner.aip import AipStage
from learner.configuration import LearnerConfig, TrainingConfig
from learner.data import Dataset, Split, load_dataset, split
from learner.features import FrozenFeatures
from learner.frozen import FrozenAap
from learner.oracle import OracleCritic, Teacher
from learner.prior import PriorStage
from learner.training import Stage, train
from shared.policy import Policy
from shared.progress import Advance
from shared.seeds import generator
from shared.store import Store

PARTS = ("read", "sample", "encode", "heads", "optimiser")
NETWORKS = ("prior", "aap", "oracle", "aap-from-oracle", "aip")
"""What is trained: AAP end to end, and by privileged training in two steps."""
NEVER = 10**9
"""Steps between two validations, or seconds between two checkpoints, that a benchmark does not reach."""


@dataclass(slots=True)
class LearningBenchmark:
    """Training steps of each network and of the port, turn by turn.

    Attributes:
        store: what is learnt from.
        config: settings of the learner.
        repeats: turns.
        steps: of each network in each turn, timed as a whole, and as many taken apart.
        port_interactions: of the port's only step in each turn.
        rates: interactions a second, by network and turn; "port" is one of them.
        parts: seconds a step, by network, part and turn.
    """

    store: Store
    config: LearnerConfig
    repeats: int
    steps: int
    port_interactions: int
    rates: dict[str, list[float]] = field(default_factory=dict)
    parts: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    _interactions: int = 0
    _points: int = 0

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return (len(NETWORKS) + 1) * self.repeats + 1

    def run(self, advance: Advance) -> None:
        """Measure; `advance` is called after each network's turn and each of the port's."""
        begun = time.perf_counter()
        dataset = load_dataset(self.store, self.config.network)
        read_s = time.perf_counter() - begun
        self._interactions, self._points = len(dataset.rows), dataset.clouds.points.shape[1]
        stages = stages_of(dataset, split(dataset, None, None), self.config)
        port = Port(dataset, self.port_interactions)
        for _, stage, settings in stages:
            self._take(stage, settings, read_s, [], {part: [] for part in PARTS})  # Warms up.
        advance()
        for _ in range(self.repeats):
            for name, stage, settings in stages:
                parts = self.parts.setdefault(name, {part: [] for part in PARTS})
                self._take(stage, settings, read_s, self.rates.setdefault(name, []), parts)
                advance()
            self.rates.setdefault("port", []).append(port.rate())
            advance()

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints; medians of the turns."""
        rates = {name: median(rates) for name, rates in self.rates.items()}
        seconds = {name: {part: median(values) for part, values in parts.items()} for name, parts in self.parts.items()}
        return {
            "aap_interactions_per_second": rates["aap"],
            "times_straightforward_port": rates["aap"] / rates["port"],
            "prior_interactions_per_second": rates["prior"],
            "oracle_interactions_per_second": rates["oracle"],
            "aap_from_oracle_interactions_per_second": rates["aap-from-oracle"],
            "aip_interactions_per_second": rates["aip"],
            "straightforward_port_interactions_per_second": rates["port"],
            "step_seconds": seconds,
            "read_share": {name: parts["read"] / sum(parts.values()) for name, parts in seconds.items()},
            "threads": torch.get_num_threads(),
            "points": self._points,
            "port_points": POINTS,
            "interactions_stored": self._interactions,
            "repeats": self.repeats,
            "steps": self.steps,
            "port_interactions": self.port_interactions,
        }

    def _take(
        self, stage: Stage, settings: TrainingConfig, read_s: float, rates: list[float], parts: dict[str, list[float]]
    ) -> None:
        """One turn of one network."""
        quiet = {"steps": self.steps, "validate_every": NEVER, "checkpoint_seconds": NEVER, "seconds": None}
        with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
            told = settings.model_copy(update=quiet)
            result = train(stage, told, self.config.seed, Path(scratch), silent=True)
        rates.append(result.interactions / result.seconds)
        apart = StepApart(stage)
        for step in range(self.steps):
            apart.take(generator(self.config.seed, "bench.learner", step))
        for part, seconds in apart.seconds.items():
            parts[part].append(seconds / self.steps)
        # A store is read once a run, however many steps follow.
        parts["read"].append(read_s / settings.steps)


def stages_of(dataset: Dataset, parts: Split, config: LearnerConfig) -> list[tuple[str, Stage, TrainingConfig]]:
    """The critics that are trained, with random weights, named as in `NETWORKS`.

    "aap" is trained end to end, clouds encoded in the step, as the port's is, whatever the configuration says.
    """
    policy, other = (Policy.untrained(dataset.task, config.network, config.seed) for _ in range(2))
    known = FrozenFeatures(dataset)
    frozen = FrozenAap.of(Policy.untrained(dataset.task, config.network, config.seed).aap, known)
    facts = dataset.rows.facts.shape[1]
    oracle = OracleCritic(Policy.untrained(dataset.task, config.network, config.seed).aap, facts)
    teacher = Teacher.of(OracleCritic(Policy.untrained(dataset.task, config.network, config.seed).aap, facts), known)
    paper = config.aap.model_copy(update={"training": "paper", "batch_rollouts": config.aap.oracle_batch_rollouts})
    told = config.aap.model_copy(update={"training": "privileged"})
    stages: list[tuple[Stage, TrainingConfig]] = [
        (PriorStage(policy.prior, dataset, parts, config.prior), config.prior),
        (AapStage(policy.aap, known, parts, paper), paper),
        (OracleStage(oracle, dataset, parts, told), told),
        (AapStage(other.aap, known, parts, told, teacher), told),
        (AipStage(policy.aip, dataset, parts, config.aip, frozen), config.aip),
    ]
    return [(name, *stage) for name, stage in zip(NETWORKS, stages, strict=True)]


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
