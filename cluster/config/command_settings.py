"""Settings that flags and files of several commands share: objects, workers, evaluations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import AfterValidator, Field, field_validator, model_validator

from shared.config import CollectionConfig, StrictModel
from shared.plan import Budget
from shared.policies.methods import MethodName
from shared.tasks import TASK_FILE_SUFFIX, Task, read_task, task_named

if TYPE_CHECKING:
    from collector.watchdog import Limits


class ObjectSelection(StrictModel):
    """Settings of task and objects; other settings inherit from it, so its flags have no prefix.

    If `task` is a TOML file, the settings contain the definition, and the file is not needed any more.
    """

    task: str | None = None
    """Which manipulation task: a name, or a TOML file that defines one."""
    task_definition: Annotated[Task | None, tyro.conf.Suppress] = Field(None, exclude_if=lambda task: task is None)
    """What the file said."""
    objects: Path | None = None
    """A folder of objects in PartNet-Mobility's layout; default: procedural objects."""
    object_list: Path | None = None
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

    @field_validator("objects", "object_list")
    @classmethod
    def _absolute(cls, path: Path | None) -> Path | None:
        """A run may be resumed from another working folder."""
        return None if path is None else path.expanduser().resolve()


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
