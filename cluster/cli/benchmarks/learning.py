"""How fast is training? The training loop of each critic is timed on stored interactions, turn by turn."""

from dataclasses import dataclass, field
from statistics import median
from typing import Any

import torch

from learner.data.dataset import Dataset, load_dataset
from learner.data.features import FrozenAap, FrozenFeatures
from learner.data.sampling import Split, split
from learner.settings import LearnerConfig, TrainingConfig
from learner.stages.aap import AapStage, OracleStage
from learner.stages.aip import AipStage
from learner.stages.oracle import OracleCritic, Teacher
from learner.stages.prior import PriorStage
from learner.training.hardware import Hardware
from learner.training.loop import Stage, train
from shared.io.files import scratch_folder
from shared.policies.policy import Policy
from shared.progress import Advance
from shared.store import Store

NETWORKS = ("prior", "aap", "oracle", "aap-from-oracle", "aip")
"""What is trained: AAP end to end, and by privileged training in two steps."""
NEVER = 10**9
"""Steps between two validations, or seconds between two checkpoints, that a benchmark does not reach."""


@dataclass(slots=True)
class LearningBenchmark:
    """Training steps of each critic.

    Attributes:
        store: what is learnt from.
        config: settings of the learner.
        hardware: what to train on.
        repeats: turns, of which the median counts.
        steps: of each critic in each turn.
        rates: interactions a second, by critic and turn.
    """

    store: Store
    config: LearnerConfig
    hardware: Hardware
    repeats: int
    steps: int
    rates: dict[str, list[float]] = field(default_factory=dict)
    interactions: int = 0

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return len(NETWORKS) * (self.repeats + 1)

    def run(self, advance: Advance) -> None:
        """Measure; the first turn warms up and is not counted."""
        dataset = load_dataset(self.store, self.config.network).on(self.hardware.device)
        self.interactions = len(dataset.rows)
        with self.hardware.home():
            stages = stages_of(dataset, split(dataset, None, None), self.config)
            for turn in range(self.repeats + 1):
                for name, stage, settings in stages:
                    rate = training_rate(stage, settings, self.steps, self.config.seed, self.hardware)
                    if turn:
                        self.rates.setdefault(name, []).append(rate)
                    advance()

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        rates = {f"{name.replace('-', '_')}_interactions_per_second": median(each) for name, each in self.rates.items()}
        return rates | {
            "device": self.hardware.describe().removeprefix("device: "),
            "threads": torch.get_num_threads(),
            "interactions_stored": self.interactions,
            "repeats": self.repeats,
            "steps": self.steps,
        }


def training_rate(stage: Stage, settings: TrainingConfig, steps: int, seed: int, hardware: Hardware) -> float:
    """Interactions a second of the training loop, without validation and checkpoints."""
    quiet = {"steps": steps, "validate_every": NEVER, "checkpoint_seconds": NEVER, "seconds": None}
    with scratch_folder("bench") as scratch:
        timed = settings.model_copy(update=quiet)
        result = train(stage, timed, seed, scratch, hardware=hardware, silent=True)
    return result.interactions / result.seconds


def stages_of(dataset: Dataset, parts: Split, config: LearnerConfig) -> list[tuple[str, Stage, TrainingConfig]]:
    """The critics that are trained, with random weights, named as in `NETWORKS`.

    "aap" is trained end to end, clouds encoded in the step as in the paper, whatever the configuration says.
    """
    device, facts = dataset.clouds.points.device, dataset.rows.facts.shape[1]

    def fresh() -> Policy:
        made = Policy.untrained(dataset.task, config.network, config.seed)
        made.modules().to(device)
        return made

    policy, other, known = fresh(), fresh(), FrozenFeatures(dataset)
    frozen = FrozenAap.of(fresh().aap, known)
    oracle = OracleCritic(fresh().aap, facts).to(device)
    teacher = Teacher.of(OracleCritic(fresh().aap, facts).to(device), known)
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
