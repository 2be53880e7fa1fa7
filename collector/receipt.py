"""What a worker tells of a job; no engine is imported for it."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Receipt:
    """What came of a job: counts and times, never data.

    Attributes:
        shard_id: the committed shard.
        rollouts: how many it holds.
        interactions: likewise.
        successes: likewise.
        outcomes: interactions by outcome kind.
        seconds: wall time by stage, and "total".
        quarantined: rollouts that were not executed, since they had failed again and again.
        memory_mb: what the worker's process held in the end.
        empty: by status and by object, rollouts that were executed and gave no interaction.
    """

    shard_id: str
    rollouts: int
    interactions: int
    successes: int
    outcomes: dict[str, int]
    seconds: dict[str, float]
    quarantined: int = 0
    memory_mb: float = 0.0
    empty: dict[str, dict[str, int]] = field(default_factory=dict)
