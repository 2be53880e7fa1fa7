"""Settings of the learner, whose defaults fit a few thousand interactions and two cores, and names of its files."""

from typing import Annotated, Any, Literal

import tyro
from pydantic import Field

from shared.config import Name, StrictModel
from shared.networks.network_config import NetworkConfig

METRICS_FILE = "metrics.jsonl"
"""Of a training: one line a validation."""
OUTPUT_FILE = "output.txt"
"""What the process of a stage printed, where a campaign started it; it is made before the stage begins."""
PUBLISHED_FILE = "published.json"
"""Of a learner beside collection: which version each of its policies became."""


class TrainingConfig(StrictModel):
    """What the training loop itself needs to know."""

    steps: int = Field(300, ge=1)
    seconds: float | None = Field(None, gt=0)
    """End after this much training time, whatever `steps` says; such a run cannot be repeated bit for bit."""
    learning_rate: float = Field(1e-3, gt=0)
    """As published: 1e-3 for the prior, 1e-4 for the alternation, on a hundred times more steps."""
    schedule: Literal["cosine", "published"] = "cosine"
    """Of the learning rate. "cosine": it grows over the first tenth of the training and falls to nothing along half a
    cosine, as few steps want it; "published": `decay` every `decay_steps`."""
    decay: float = Field(0.9, gt=0, le=1)
    decay_steps: int = Field(5_000, ge=1)
    weight_decay: float = Field(1e-5, ge=0)
    validate_every: int = Field(50, ge=1)
    """Steps between two looks at the validation objects; the best weights are kept."""
    patience: int = Field(6, ge=1)
    """Looks without improvement after which training ends."""
    checkpoint_seconds: float = Field(5.0, ge=0)


class AugmentationConfig(StrictModel):
    """How interactions are turned before the prior, the oracle and AAP see them; not in the paper."""

    mirror: bool = True
    """Reflect half of the sets of interactions."""
    turn_deg: float = Field(15.0, ge=0, le=180)
    """Turn each set about the vertical by up to this much."""
    flip: bool = Field(False, exclude_if=lambda flips: not flips)
    """Turn the gripper by 180 deg about its approach in half of the sets, which swaps its fingers."""


class AffordanceConfig(TrainingConfig):
    """An affordance network D, trained when its critic is done."""

    loss: Literal["mean", "published"] = "mean"
    """"published": L1, which finds the median of what a critic makes of a point, and that is next to nothing where
    successes are rare. "mean": cross entropy, and squares for AIP, which find the mean."""
    steps: int = Field(300, ge=1)
    learning_rate: float = Field(3e-3, gt=0)
    questions: int = Field(6_400, ge=1, le=10_000_000)
    """Points, each with a z, that the critic answers for D to learn from; where it answers as many as `steps` times
    `points`, each is met once, as published."""
    points: int = Field(256, ge=1)
    """Of the questions, a step."""
    context: int = Field(8, ge=0)
    """The longest context whose z is asked about; AAP and AIP only."""
    proposals: int = Field(100, ge=1)
    """Rotations at a point that the critic scores, as published."""


class PriorConfig(TrainingConfig):
    """The Where2Act prior."""

    steps: int = Field(200, ge=1)
    batch_clouds: int = Field(12, ge=1)
    actions_per_cloud: int = Field(32, ge=1)
    """At the most; a cloud of a restart rollout has 8, or all of them where every state is the same."""
    proposals: int = Field(100, ge=1)
    """Draws a point for the proposal loss, as published."""
    augmentation: AugmentationConfig = AugmentationConfig()
    affordance: AffordanceConfig = AffordanceConfig()


class AapConfig(TrainingConfig):
    """Adaptive Affordance Prediction."""

    training: Literal["paper", "privileged"] = "privileged"
    """"paper": end to end. "privileged": first an oracle critic that is told the hidden facts; AAP starts from it,
    keeps its point encoder, and learns to infer the facts and to imitate its scores. An AAP that is already trained is
    fine-tuned without an oracle.
    """
    steps: int = Field(600, ge=1)
    learning_rate: float = Field(2e-3, gt=0)
    batch_rollouts: int = Field(64, ge=1)
    """Rows of one rollout share what is hidden, so that few rollouts a step teach little of it. Training the paper's
    way encodes their clouds, so that twelve are as much as two cores care for."""
    rows_per_rollout: int = Field(32, ge=2)
    """At the most, drawn anew each time."""
    validate_every: int = Field(50, ge=1)
    patience: int = Field(8, ge=1)
    context: int = Field(8, ge=1)
    """The longest context; every shorter one, and none, is trained in the same pass."""
    augmentation: AugmentationConfig = AugmentationConfig()
    continued_first: float = Field(0.5, ge=0, le=1)
    """How often the interactions that continued one another come first in the context, where a rollout has some: what a
    policy proposed, and random ones by `rollout.continued`."""
    unknown_details: float = Field(0.25, ge=0, le=1)
    """How often the kinds of a rollout's outcomes, and how often its grasp widths, are left out in training, so that
    histories without them serve as well; only where `network.outcome_details` is set."""
    top: int = Field(5, ge=1)
    """Best proposals whose mean score is a point's actionability, as published."""
    affordance: AffordanceConfig = AffordanceConfig()
    distillation: float = Field(0.3, ge=0)
    """Weight of the loss that draws z to the oracle's; privileged training only."""
    imitation: float = Field(1.0, ge=0)
    """Weight of the loss that draws scores to the oracle's, which are surer than single successes; privileged training
    only."""
    inherited_rate: float = Field(0.2, ge=0, le=1)
    """Factor of the learning rate for what comes from the oracle, and for an AAP that is fine-tuned; privileged
    training only."""
    oracle_steps: int = Field(300, ge=1)
    """Steps of the oracle critic; privileged training only."""
    oracle_batch_rollouts: int = Field(12, ge=1)
    oracle_learning_rate: float = Field(3e-3, gt=0)


class AipConfig(TrainingConfig):
    """Adaptive Interaction Proposal."""

    training: Literal["paper", "inherited"] = "inherited"
    """"paper": a point encoder of its own, and L1, which finds the median gain of an interaction. "inherited": AAP's
    encoder as it is, so that a step may see ten times the rollouts, squares, which find the mean gain, and, where an
    oracle taught AAP, gains by what it expects instead of by single successes."""
    target: Literal["loss", "beliefs"] = "loss"
    """What an interaction is worth. "loss", as published: by how much the one that was made next lowered AAP's loss.
    "beliefs": how far AAP's beliefs are expected to move, as Kullback-Leibler divergence, by each that may be next."""
    steps: int = Field(200, ge=1)
    validate_every: int = Field(25, ge=1)
    patience: int = Field(8, ge=1)
    batch_rollouts: int = Field(24, ge=1)
    rows_per_rollout: int = Field(32, ge=2)
    context: int = Field(4, ge=1)
    """Interactions of an ordered subset; each gives one target."""
    draws: int = Field(4, ge=1)
    """Ordered subsets a rollout and step, which share the encoded clouds."""
    continued_first: float = Field(0.5, ge=0, le=1)
    """As for AAP: what an interaction tells depends on where those before it left the object."""
    top: int = Field(5, ge=1)
    affordance: AffordanceConfig = AffordanceConfig(context=4)


class InteractionConfig(TrainingConfig):
    """The baseline Where2Act-interaction, which starts from the prior."""

    steps: int = Field(80, ge=1)
    validate_every: int = Field(20, ge=1)
    batch_rollouts: int = Field(12, ge=1)
    rows_per_rollout: int = Field(32, ge=2)
    augmentation: AugmentationConfig = AugmentationConfig()
    inherited_rate: float = Field(0.2, ge=0, le=1)
    """Factor of the learning rate for the prior's encoder."""
    affordance: AffordanceConfig = AffordanceConfig(steps=150)


class AdaptationConfig(TrainingConfig):
    """The baseline Where2Act-adaptation; only its similarities are trained."""

    steps: int = Field(300, ge=1)
    batch_rollouts: int = Field(16, ge=1)
    rows_per_rollout: int = Field(32, ge=2)
    context: int = Field(4, ge=1)
    """The longest context; every shorter one is trained in the same pass."""


class SegmentationConfig(TrainingConfig):
    """The training of the segmentation network."""

    steps: int = Field(1300, ge=1)
    learning_rate: float = Field(3e-3, gt=0)
    validate_every: int = Field(100, ge=1)
    patience: int = Field(20, ge=1)
    checkpoint_seconds: float = Field(30.0, ge=0)
    batch_scenes: int = Field(4, ge=1)
    mirror: bool = True
    """Reflect half of the scenes."""
    blend: float = Field(1.0, gt=0, le=1, exclude_if=lambda share: share == 1)
    """With --init: how far the weights go from the start to what was learned. Between the two lies a network that knows
    both kinds of scenes, and finds more on other objects than either (docs/learning.md)."""


class AlternationConfig(StrictModel):
    """When `adaafford train alternate` ends."""

    rounds: int = Field(8, ge=1, le=1000)
    """AAP and AIP are trained at most this many times."""
    improvement: float = Field(0.01, ge=0, lt=1)
    """A round counts if it lowers AAP's best validation loss by more than this share."""
    patience: int = Field(1, ge=1)
    """Rounds in a row that do not count, after which it has converged."""


class LearnerSettings(StrictModel):
    """What decides the networks, apart from the seed; a campaign's `learner` settings."""

    network: NetworkConfig = NetworkConfig()
    prior: PriorConfig = PriorConfig()
    aap: AapConfig = AapConfig()
    aip: AipConfig = AipConfig()
    interaction: InteractionConfig = InteractionConfig()
    adaptation: AdaptationConfig = AdaptationConfig()
    baselines: Annotated[dict[Name, dict[str, Any]], tyro.conf.Suppress] = Field({}, exclude_if=lambda told: not told)
    """Of baselines that packages add, a table each by name; see `learner.stages.trainers.settings_of`."""


class LearnerConfig(LearnerSettings):
    """Everything that `adaafford train` may be told by a file."""

    seed: int = Field(0, ge=0)
    threads: int | None = Field(None, ge=1, le=1024)
    """Of PyTorch; unset: as many as it chooses. Bits may differ between numbers of threads."""
    device: str = Field("auto", pattern=r"^(auto|cpu|cuda(:[0-9]{1,3})?|mps)$")
    """auto, cpu, cuda, cuda:N or mps; "auto" takes a GPU where there is one."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of a training step's products; "bf16" is for GPUs, and CPUs with instructions for it. Weights stay in fp32."""
    alternation: AlternationConfig = AlternationConfig()
