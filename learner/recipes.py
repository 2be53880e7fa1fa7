"""What each stage trains, one network after the other."""

import copy
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from safetensors.torch import save

from learner import sharing
from learner.aap import AapStage, OracleStage
from learner.affordance import AapCritic, AffordanceStage, AipCritic, Critic, PriorCritic, RowOrder
from learner.aip import AipStage
from learner.configuration import AffordanceConfig, LearnerConfig, TrainingConfig
from learner.data import Dataset, Split
from learner.features import FrozenFeatures, ProposalPool
from learner.frozen import FrozenAap, FrozenPrior
from learner.hardware import Hardware
from learner.oracle import OracleCritic, Teacher
from learner.prior import PriorStage
from learner.training import Stage, TrainingResult, train
from learner.where2act_adaptation import AdaptationStage
from learner.where2act_interaction import InteractionStage
from shared.files import write_atomically
from shared.methods import ModuleName
from shared.networks.where2act_interaction import TRIES
from shared.policy import Policy
from shared.seeds import generator, torch_seed

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
class Recipe:
    """What the stages have in common: a policy of which one module is trained, from what, and how.

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

    def train(self, stage: ModuleName) -> TrainingResult:
        """Train one module of the policy; the others stay as they are."""
        self.policy.modules().eval().requires_grad_(False)
        match stage:
            case "prior":
                return self._prior()
            case "aap":
                return self._aap()
            case "aip":
                return self._aip()
            case "where2act-interaction":
                return self._interaction()
            case "where2act-adaptation":
                return self._adaptation()

    def _prior(self) -> TrainingResult:
        prior, config = self.policy.prior.requires_grad_(True), self.config.prior
        result = self.runner.train(PriorStage(prior, self.dataset, self.parts, config), config, "prior")
        prior.eval().requires_grad_(False)
        pool = self._pool()
        affordance = self._affordance("prior", PriorCritic(prior, pool), config.affordance, pool)
        return self.runner.train_affordance(affordance, config.affordance, result)

    def _aap(self) -> TrainingResult:
        aap, config, pool = self.policy.aap.requires_grad_(True), self.config.aap, self._pool()
        # An AAP that has been trained has a z of its own, which a new oracle would only disturb; the old one may teach.
        trained, oracle = "aap" in self.policy.trained, self.oracle
        if config.training == "privileged" and not trained:
            oracle = self._oracle()
        teacher = self._teacher(oracle if config.training == "privileged" else None)
        stage = AapStage(aap, self.known, self.parts, config, teacher, trained=trained)
        result = self.runner.train(stage, config, "aap")
        frozen = FrozenAap.of(aap, self.known)
        affordance = self._affordance("aap", AapCritic(frozen, config.top), config.affordance, pool, frozen)
        return self.runner.train_affordance(affordance, config.affordance, result)

    def _aip(self) -> TrainingResult:
        aip, config, pool = self.policy.aip.requires_grad_(True), self.config.aip, self._pool()
        frozen = FrozenAap.of(self.policy.aap, self.known)
        teacher = self._teacher(self.oracle if config.training == "inherited" else None)
        stage = AipStage(aip, self.dataset, self.parts, config, frozen, teacher)
        result = self.runner.train(stage, config, "aip")
        aip.eval().requires_grad_(False)
        critic = AipCritic(aip, self.known.pool(aip.encoder), frozen, config.top)
        affordance = self._affordance("aip", critic, config.affordance, pool, frozen)
        return self.runner.train_affordance(affordance, config.affordance, result)

    def _interaction(self) -> TrainingResult:
        network, config = self.policy.where2act_interaction, self.config.interaction
        assert network is not None, "a baseline is begun before it is trained"
        pool, prior = self._pool(), FrozenPrior.of(self.policy.prior, self.known)
        stage = InteractionStage(network.requires_grad_(True), self.dataset, self.parts, config, prior)
        result = self.runner.train(stage, config, stage.name)
        frozen = FrozenAap.of(network, self.known)
        # The mean of all proposals' scores, as Where2Act has it, and not of the best.
        critic = AapCritic(frozen, config.affordance.proposals)
        settings = config.affordance.model_copy(update={"context": TRIES})
        affordance = self._affordance("where2act-interaction", critic, settings, pool, frozen, stage.order, TRIES)
        return self.runner.train_affordance(affordance, settings, result)

    def _adaptation(self) -> TrainingResult:
        network, config = self.policy.where2act_adaptation, self.config.adaptation
        assert network is not None, "a baseline is begun before it is trained"
        prior = FrozenPrior.of(self.policy.prior, self.known)
        stage = AdaptationStage(network.requires_grad_(True), self.dataset, self.parts, config, prior)
        return self.runner.train(stage, config, stage.name)

    def _affordance(
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

    def _pool(self) -> ProposalPool:
        return ProposalPool.of(self.policy.prior, self.known)

    def _teacher(self, oracle: OracleCritic | None) -> Teacher | None:
        """What the oracle says of all rows; nothing where there is none."""
        return None if oracle is None else Teacher.of(oracle, self.known)

    def _oracle(self) -> OracleCritic:
        """Train the oracle critic, save it, and start AAP from it."""
        # Drawn on the CPU, so that the first weights are the same whatever device trains them.
        with torch.random.fork_rng(devices=[]), torch.device("cpu"):
            torch.manual_seed(torch_seed(self.config.seed, "learner.oracle") % 2**32)
            critic = OracleCritic(copy.deepcopy(self.policy.aap), self.dataset.rows.facts.shape[1])
        critic.to(self.runner.hardware.device)
        config = self.config.aap
        settings = config.model_copy(
            update={"steps": config.oracle_steps, "learning_rate": config.oracle_learning_rate}
        )
        self.runner.train(OracleStage(critic, self.dataset, self.parts, config), settings, "oracle", ORACLE_FOLDER)
        if sharing.rank() == 0:
            weights = save({name: tensor.contiguous() for name, tensor in critic.state_dict().items()})
            write_atomically(self.runner.out / ORACLE_FILE, weights)
        for inherited in ("encoder", "action_encoder", "critic_head"):
            getattr(self.policy.aap, inherited).load_state_dict(getattr(critic.aap, inherited).state_dict())
        return critic
