"""The configuration of a campaign: all settings that determine its results, and the number of workers."""

from pathlib import Path

from pydantic import Field, field_validator, model_validator

from cluster.config.command_settings import ObjectSelection, WorkerSettings
from learner.settings import LearnerSettings
from shared.config import CollectionConfig, StrictModel
from shared.plan import ROLLOUTS_PER_SHARD, EvaluationConfig

EXECUTION_SETTINGS = frozenset({"workers", "ray_address", "rollout_limit_s", "memory_limit_mb"})
"""Settings that do not change what a run produces; they may differ from one attempt to the next."""


class RolloutCounts(StrictModel):
    """Number of rollouts of each round."""

    random: int = Field(100, ge=1)
    """In the first round, proposed at random."""
    aip: int = Field(30, ge=1)
    """In each later round, proposed by AIP."""
    evaluation: int = Field(8, ge=1)
    """On test objects, which are not trained on."""
    per_shard: int = Field(ROLLOUTS_PER_SHARD, ge=1, le=4096)
    """A job's size: what a worker does in one go, and what a kill can cost."""
    per_object: bool = False
    """Whether the first three are counted for each object, instead of all in all. As published: 4 draws of 32
    interactions an object, and 10 trials a test object."""

    def total(self, count: int, objects: int) -> int:
        """The number of rollouts that `count` means for this many objects."""
        return count * objects if self.per_object else count

    def of_round(self, version: int, objects: int) -> int:
        """How many rollouts the round of a policy makes on so many objects; version 0 is the random round."""
        return self.total(self.aip if version else self.random, objects)


class SplitConfig(StrictModel):
    """The split of the objects: fractions within each category, unless lists or categories define the test objects."""

    train: float = Field(0.7, gt=0, le=1)
    validation: float = Field(0.1, ge=0, le=1)
    test: float = Field(0.2, gt=0, le=1)
    train_list: Path | None = None
    """A list of `<id> <category>` lines: train on these, and test on all others unless `test_list` says which."""
    test_list: Path | None = None
    """Likewise: test on these, and train on all others unless `train_list` says which."""
    test_categories: tuple[str, ...] = ()
    """Test on these categories and train on all others; "test" stands for the paper's five."""

    @property
    def fractions(self) -> tuple[float, float, float]:
        """Of train, validation and test."""
        return self.train, self.validation, self.test

    @model_validator(mode="after")
    def _whole(self) -> "SplitConfig":
        if abs(sum(self.fractions) - 1) > 1e-6:
            raise ValueError(f"train, validation and test must sum to 1; given {self.fractions}")
        return self

    @model_validator(mode="after")
    def _one_way(self) -> "SplitConfig":
        if self.test_categories and (self.train_list or self.test_list):
            raise ValueError("what is tested on is said by lists or by test_categories, not by both")
        return self

    @field_validator("train_list", "test_list")
    @classmethod
    def _absolute(cls, path: Path | None) -> Path | None:
        """A run may be resumed from another working folder."""
        return None if path is None else path.expanduser().resolve()


class ProceduralConfig(StrictModel):
    """The procedural objects that are generated if no folder of objects is given."""

    per_category: int = Field(8, ge=1, le=10_000)
    """Objects of each category that the task applies to."""


class CampaignConfig(WorkerSettings, ObjectSelection):
    """One campaign: a random round, then alternating training and AIP rounds, then evaluation on unseen objects."""

    task: str = "pull-closed-door"
    """Which manipulation task: push, pull, pull-closed-door, push-faucet, one that a package adds, or a TOML file."""
    seed: int = Field(1, ge=0, lt=2**63)
    """Everything random derives from it."""
    alternations: int = Field(1, ge=0, le=1000)
    """AIP rounds, each followed by training."""
    start_from: str | None = Field(None, min_length=1, max_length=4096)
    """A policy to fine-tune on these objects, instead of training one from nothing: a finished run, a folder with a
    policy, or a name of those that the package brings. Its version is 1."""
    rollouts: RolloutCounts = RolloutCounts()
    splits: SplitConfig = SplitConfig()
    procedural: ProceduralConfig = ProceduralConfig()
    collection: CollectionConfig = CollectionConfig()
    learner: LearnerSettings = LearnerSettings()
    evaluation: EvaluationConfig = EvaluationConfig()

    @model_validator(mode="after")
    def _something_to_train(self) -> "CampaignConfig":
        if self.start_from is not None and not self.alternations:
            raise ValueError("start_from fine-tunes in AIP rounds, so alternations must be at least 1; given 0")
        return self

    @field_validator("start_from")
    @classmethod
    def _found_from_anywhere(cls, source: str | None) -> str | None:
        """A run may be resumed from another working folder."""
        return str(Path(source).resolve()) if source is not None and Path(source).exists() else source
