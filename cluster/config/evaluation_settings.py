"""What `adaafford evaluate` may be told."""

from pydantic import Field

from cluster.config.selection import ObjectSelection, RayAddress
from shared.config import CollectionConfig
from shared.plan import Budget
from shared.policies.methods import MethodName


class EvaluateSettings(ObjectSelection):
    """What is evaluated, on which objects, and by how many workers."""

    task: str | None = None
    """Another task than the policy's, of the same primitive."""
    methods: tuple[MethodName, ...] = ()
    """Which methods are compared; all whose networks are trained where none is named."""
    budgets: tuple[Budget, ...] = Field((1, 2, 4), min_length=1)
    """After how many tries they are judged."""
    trials: int = Field(10, ge=1, le=100_000)
    """Trials an object: each draws hidden dynamics and a camera, tries and acts anew. As published: 10."""
    queries: int = Field(24, ge=1, le=10_000)
    """Random test interactions a trial, which critics are asked about (F-score)."""
    exploit_share: float | None = Field(None, gt=0, le=1)
    """Also act at a point drawn from the best points of the cloud, this share of it, and let AIP draw so; as published:
    0.01. Adds the column "sample-success, best share"."""
    policy_version: int | None = Field(None, ge=1)
    """Of a run: which of its policies; the last where none is named."""
    collection: CollectionConfig = CollectionConfig()
    """Of a policy without a run: how its trials are seen and simulated; a run says so itself."""
    seed: int | None = Field(None, ge=0, lt=2**63)
    """Instead of the run's, or instead of 1."""
    per_shard: int = Field(4, ge=1, le=4096)
    """Trials a shard."""
    workers: int = Field(2, ge=0, le=4096)
    """Ray actors, one CPU each; 0 does everything in one process without Ray."""
    ray_address: RayAddress | None = None
    """Of a running Ray cluster; a private session on this machine where none is given."""
    rollout_limit_s: float = Field(600.0, gt=0)
    """A worker that takes longer for one trial is taken for hung, and replaced."""
    memory_limit_mb: float = Field(2000.0, gt=0)
    """What a worker may take beyond what it had after its start."""
