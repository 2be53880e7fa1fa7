"""What the trainings of all stages have in common, how those of baselines are found, and critics of stored rows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from learner.data.dataset import Dataset
from learner.data.features import FrozenAap, FrozenFeatures, FrozenPrior, ProposalPool
from learner.data.sampling import Split
from learner.settings import AffordanceConfig, LearnerConfig, LearnerSettings, TrainingConfig
from learner.stages.affordance import AffordanceStage, Critic, RowOrder
from learner.stages.oracle import OracleCritic, Teacher
from learner.training.hardware import Hardware
from learner.training.loop import Stage, TrainingResult, train
from shared.config import parse
from shared.errors import UsageError
from shared.policies.methods import BASELINES, BaselineName, CriticName, ModuleName
from shared.policies.policy import Policy
from shared.seeds import generator

ORACLE_FILE = "oracle.safetensors"
ORACLE_FOLDER = "oracle"
AFFORDANCE_FOLDER = "affordance"


@dataclass(frozen=True, slots=True)
class Runner:
    """Trains the networks of one stage one after the other, each with checkpoints of its own."""

    out: Path
    seed: int
    fingerprint: str
    hardware: Hardware

    def train(self, stage: Stage, settings: TrainingConfig, title: str, subfolder: str = "") -> TrainingResult:
        """Train one network."""
        folder = self.out / subfolder
        folder.mkdir(exist_ok=True)
        return train(stage, settings, self.seed, folder, self.fingerprint, title, self.hardware)

    def train_affordance(
        self, stage: AffordanceStage, settings: AffordanceConfig, before: TrainingResult
    ) -> TrainingResult:
        """Train D; returns the critic's result with D's figures added."""
        result = self.train(stage, settings, stage.name, AFFORDANCE_FOLDER)
        stage.module.eval().requires_grad_(False)
        figures = {name: value for name, value in result.metrics.items() if name != "score"}
        return replace(before, seconds=before.seconds + result.seconds, metrics=before.metrics | figures)


@dataclass(frozen=True, slots=True)
class StageTrainer:
    """What the stages have in common: a policy of which one module is trained, from what, and how.

    Each stage has a function that trains its networks with it, one after the other, such as
    `learner.stages.aap.train_aap`.

    Attributes:
        config: the settings.
        policy: the modules.
        known: the interactions, and features of them.
        parts: which to learn from, and which to judge by.
        runner: trains one network.
        oracle: what privileged training of AAP left, to teach further stages; None where there is none.
    """

    config: LearnerConfig
    policy: Policy
    known: FrozenFeatures
    parts: Split
    runner: Runner
    oracle: OracleCritic | None = None

    @property
    def dataset(self) -> Dataset:
        """The interactions."""
        return self.known.dataset

    def affordance(
        self,
        stage: ModuleName,
        critic: Critic,
        config: AffordanceConfig,
        pool: ProposalPool,
        frozen: FrozenAap | None = None,
        order: RowOrder | None = None,
        shortest: int = 0,
    ) -> AffordanceStage:
        """The stage that trains a module's D, when its critic is done."""
        rng = generator(self.config.seed, f"learner.{stage}.questions")
        name = f"{stage}-affordance"
        return AffordanceStage(
            name, critic, self.dataset, self.parts, config, pool, rng, frozen=frozen, order=order, shortest=shortest
        )

    def pool(self) -> ProposalPool:
        """Rotations that the prior proposes at the points of the pool."""
        return ProposalPool.of(self.policy.prior, self.known)

    def teacher(self, oracle: OracleCritic | None) -> Teacher | None:
        """What an oracle says of all rows; nothing where there is none."""
        return None if oracle is None else Teacher.of(oracle, self.known)


class RowCritic(Protocol):
    """What a method believes of rows after interactions of the same rollout."""

    def __call__(self, asked: Tensor, tries: Tensor) -> Tensor:
        """Scores in [0, 1] of rows, [Q], after the rows `tries`, [K], of which there may be none; [Q]."""
        ...


@dataclass(frozen=True, slots=True)
class Load:
    """What one step of a training works through, for estimates.

    Attributes:
        rollouts: whose clouds are encoded, forward and backward.
        rows: that pass a critic.
        encoders: point encoders that are frozen and see every cloud once.
    """

    rollouts: int
    rows: int
    encoders: int


@dataclass(frozen=True, slots=True)
class BaselineTraining:
    """How a baseline is trained, and judged by rows (`shared.policies.methods.Baseline` names where it stands).

    Attributes:
        settings: the model of its settings.
        train: trains its network, `recipe.policy.baselines[name]`, on `recipe.dataset`; of a recipe and the settings.
        row_critic: what the trained network of a policy believes of the rows of a data set.
        load: of a step, by the settings.
        table: the table of its settings in `LearnerSettings`; "": `baselines.NAME`.
    """

    settings: type[TrainingConfig]
    train: Callable[[StageTrainer, Any], TrainingResult]
    row_critic: Callable[[Policy, FrozenFeatures], RowCritic]
    load: Callable[[Any], Load]
    table: str = ""


def training_of(name: BaselineName) -> BaselineTraining:
    """How a baseline is trained.

    Raises:
        UsageError: there is no such baseline, or what trains it cannot be imported.
    """
    place = BASELINES.get(name).training
    try:
        training = EntryPoint(name, place, "training").load()
    except Exception as error:
        raise UsageError(
            f"baseline '{name}': '{place}' cannot be imported ({type(error).__name__}: {error})"
        ) from error
    if not isinstance(training, BaselineTraining):
        raise UsageError(f"baseline '{name}': '{place}' is no BaselineTraining")
    return training


def settings_of(settings: LearnerSettings, name: BaselineName) -> TrainingConfig:
    """The settings of a baseline.

    Raises:
        UsageError: one of them is unknown or not allowed.
    """
    training = training_of(name)
    told = getattr(settings, training.table) if training.table else settings.baselines.get(name, {})
    return told if isinstance(told, training.settings) else parse(training.settings, told, f"baselines.{name}")


def check_baselines(settings: LearnerSettings) -> None:
    """Refuse settings of baselines that would be found wrong, or not be found, when these are trained.

    Raises:
        UsageError: there is no such baseline, or one of its settings is unknown or not allowed.
    """
    for name in settings.baselines:
        if table := training_of(name).table:
            raise UsageError(f"settings of the baseline '{name}' belong into the table '{table}', not into 'baselines'")
        settings_of(settings, name)


def row_critic(name: CriticName, policy: Policy, known: FrozenFeatures) -> RowCritic:
    """The critic of a policy that is called `name`; what does not depend on interactions is computed once for all rows.

    Raises:
        UsageError: its network is not trained.
    """
    if name == "where2act":
        scores = FrozenPrior.of(policy.prior, known).scores
        return lambda asked, tries: scores[asked]
    if name == "aap":
        return adaptive_critic(FrozenAap.of(policy.aap, known))
    policy.require(name)
    return training_of(name).row_critic(policy, known)


def adaptive_critic(frozen: FrozenAap) -> RowCritic:
    """The critic of an AAP, or of a baseline whose network has its form."""

    @torch.no_grad()
    def scores(asked: Tensor, tries: Tensor) -> Tensor:
        return torch.sigmoid(frozen.logits(asked, frozen.latents(tries)[-1]))

    return scores
