"""What `adaafford evaluate` may be told."""

from pydantic import Field

from cluster.config.selection import ObjectSelection
from cluster.config.worker_settings import WorkerSettings
from shared.config import CollectionConfig
from shared.plan import Budget
from shared.policies.methods import MethodName


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
