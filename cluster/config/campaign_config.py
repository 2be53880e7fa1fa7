"""Settings that several commands share (objects, workers, evaluations), and the configuration of a campaign."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import AfterValidator, Field, field_validator, model_validator

from learner.settings import LearnerSettings
from shared.config import CollectionConfig, StrictModel
from shared.plan import ROLLOUTS_PER_SHARD, Budget, EvaluationConfig
from shared.policies.methods import MethodName
from shared.tasks import TASK_FILE_SUFFIX, Task, read_task, task_named

if TYPE_CHECKING:
    from collector.watchdog import Limits


AbsolutePath = Annotated[Path, AfterValidator(lambda path: path.expanduser().resolve())]
"""Of what is read again when a run is resumed, perhaps from another working folder."""


class ObjectSelection(StrictModel):
    """Settings of task and objects; other settings inherit from it, so its flags have no prefix.

    If `task` is a TOML file, the settings contain the definition, and the file is not needed any more.
    """

    task: str | None = None
    """Which manipulation task: a name, or a TOML file that defines one."""
    task_definition: Annotated[Task | None, tyro.conf.Suppress] = Field(None, exclude_if=lambda task: task is None)
    """What the file said."""
    objects: AbsolutePath | None = None
    """A folder of objects in PartNet-Mobility's layout; default: procedural objects."""
    object_list: AbsolutePath | None = None
    """Only the objects of this list, `<id> <category>` a line, such as Where2Act publishes."""
    categories: tuple[str, ...] = ()
    """Only objects of these; "train" and "test" stand for the paper's ten and five. Default: all."""

    @property
    def task_record(self) -> Task:
        """The task; raises as `task_named` does."""
        assert self.task is not None, "only settings that name a task are asked for it"
        return self.task_definition or task_named(self.task)

    @model_validator(mode="before")
    @classmethod
    def _defined_task(cls, values: Any) -> Any:
        """A flag may name another task than the one that a file of settings defines."""
        if not isinstance(values, dict):
            return values
        task, defined = values.get("task"), values.get("task_definition")
        if isinstance(task, str) and task.endswith(TASK_FILE_SUFFIX):
            defined = read_task(Path(task))
            return values | {"task": defined.name, "task_definition": defined}
        name = defined.get("name") if isinstance(defined, dict) else getattr(defined, "name", None)
        return values | {"task_definition": defined if name == task else None}


def _without_credentials(address: str) -> str:
    if "@" in address:
        raise ValueError("an address may hold no user and password; Ray takes its token from RAY_AUTH_TOKEN")
    return address


RayAddress = Annotated[str, AfterValidator(_without_credentials)]
"""Of a Ray cluster; it is kept and shown, so that it may hold no secret."""


class WorkerSettings(StrictModel):
    """How many workers there are, where, and what a rollout may take of them."""

    workers: int = Field(2, ge=0, le=4096)
    """Ray actors, one CPU each; 0 does everything in one process without Ray."""
    ray_address: RayAddress | None = None
    """HOST:PORT of a running Ray cluster, or auto; default: a private session on this machine."""
    rollout_limit_s: float = Field(300.0, gt=0)
    """A worker that takes longer for one rollout is taken for hung, and replaced; after three times the rollout is
    quarantined."""
    memory_limit_mb: float = Field(2000.0, gt=0)
    """What a worker may take beyond what it had after its start; at half of that it is replaced after its job."""

    @property
    def limits(self) -> "Limits":
        """Of a worker's process."""
        from collector.watchdog import Limits

        return Limits(self.rollout_limit_s, self.memory_limit_mb)


class EvaluateSettings(WorkerSettings, ObjectSelection):
    """What is evaluated, on which objects, and by how many workers."""

    task: str | None = None
    """Another task than the policy's, of the same primitive."""
    methods: tuple[MethodName, ...] = ()
    """The methods; default: all of the paper's, and of packages, whose networks are trained."""
    budgets: tuple[Budget, ...] = Field((1, 2, 4), min_length=1)
    """Numbers of interactions after which methods are evaluated."""
    trials: int = Field(10, ge=1, le=100_000)
    """Trials of each object, each with new hidden dynamics and a new camera. As published: 10."""
    queries: int = Field(24, ge=1, le=10_000)
    """Random test interactions a trial, which critics are asked about (F-score)."""
    exploit_share: float | None = Field(None, gt=0, le=1)
    """Each method also acts at a point drawn from this share of the cloud, the best points, and AIP draws its points in
    the same way; as published: 0.01. Adds the column "sample-success, best share"."""
    repeats: bool = False
    """Each method with interactions also repeats one that succeeded, as a robot does (`adapt`), from the start state.
    Adds the column "from the start, repeated"."""
    policy_version: int | None = Field(None, ge=1)
    """Version of the run's policy; default: the last."""
    collection: CollectionConfig = CollectionConfig()
    """Camera and simulation of the trials of a policy without a run; a run has its own."""
    seed: int | None = Field(None, ge=0, lt=2**63)
    """Instead of the run's, or instead of 1."""
    per_shard: int = Field(4, ge=1, le=4096)
    """Trials a shard."""
    rollout_limit_s: float = Field(600.0, gt=0)
    """A worker that takes longer for one trial is taken for hung, and replaced."""


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
    train_list: AbsolutePath | None = None
    """A list of `<id> <category>` lines: train on these, and test on all others unless `test_list` says which."""
    test_list: AbsolutePath | None = None
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
