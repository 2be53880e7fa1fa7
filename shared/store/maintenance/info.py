"""What a store holds, in figures."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from shared.io.documents import with_checksum
from shared.store.layout import (
    INTERACTIONS_FILE,
    OBJECTS,
    ROLLOUTS_FILE,
    STORE,
    Quarantined,
    ShardManifest,
    reproduction,
)
from shared.store.store import Store
from shared.types import OutcomeKind


@dataclass(frozen=True, slots=True)
class SuccessCount:
    """How many interactions, and how many of them succeeded; infrastructure failures are in neither."""

    interactions: int
    successes: int

    @property
    def success_rate(self) -> float:
        """Share of the interactions that succeeded; NaN for none."""
        return self.successes / self.interactions if self.interactions else float("nan")


@dataclass(frozen=True, slots=True)
class StoreInfo:
    """What a store holds. Dictionaries are in order of name."""

    shards: int
    rollouts: int
    interactions: int
    observations: int
    bytes: int
    by_category: dict[str, SuccessCount]
    by_proposer: dict[str, SuccessCount]
    """By proposer and policy version, such as "aip v1"."""
    by_role: dict[str, SuccessCount]
    by_outcome: dict[str, int]
    by_status: dict[str, int]
    """Rollouts by status."""
    quarantined: tuple[Quarantined, ...]
    """Rollouts that were given up, and why."""

    @property
    def bytes_per_interaction(self) -> float:
        """All files of all shards over all interactions; NaN for none."""
        return self.bytes / self.interactions if self.interactions else float("nan")


def quarantined_in(
    manifests: Iterable[ShardManifest], store: Path | str = STORE, objects: Path | str = OBJECTS
) -> tuple[Quarantined, ...]:
    """What some shards have quarantined, with the command that executes each rollout where the store now is."""
    return tuple(
        each.model_copy(update={"command": reproduction(store, manifest.shard_id, objects, each.rollout)})
        for manifest in manifests
        for each in manifest.quarantined
    )


def info(store: Store) -> StoreInfo:
    """Count what a store holds.

    Raises:
        StoreError: a file is damaged or foreign.
    """
    shards = rollouts = observations = size = 0
    quarantined: list[Quarantined] = []
    categories, proposers, roles = _Tallies(), _Tallies(), _Tallies()
    outcomes, statuses = Counter[str](), Counter[str]()
    columns = ["object_category", "proposer", "policy_version", "role", "outcome", "success"]
    for _, manifest, table in store.each(INTERACTIONS_FILE, columns):
        shards += 1
        rollouts += manifest.rollouts
        observations += manifest.observations
        size += manifest.bytes + len(with_checksum(manifest.as_document()))
        quarantined += quarantined_in([manifest], store.where)
        for row in table.to_pylist():
            outcomes[row["outcome"]] += 1
            if OutcomeKind(row["outcome"]).is_label:
                categories.add(row["object_category"], row["success"])
                proposers.add(f"{row['proposer']} v{row['policy_version']}", row["success"])
                roles.add(row["role"], row["success"])
    for _, _, table in store.each(ROLLOUTS_FILE, ["status"]):
        statuses.update(table.column("status").to_pylist())
    return StoreInfo(
        shards=shards,
        rollouts=rollouts,
        interactions=sum(outcomes.values()),
        observations=observations,
        bytes=size,
        by_category=categories.found,
        by_proposer=proposers.found,
        by_role=roles.found,
        by_outcome=dict(sorted(outcomes.items())),
        by_status=dict(sorted(statuses.items())),
        quarantined=tuple(quarantined),
    )


class _Tallies:
    """Interactions and successes by some name."""

    def __init__(self) -> None:
        self._tried, self._succeeded = Counter[str](), Counter[str]()

    def add(self, name: str, success: bool) -> None:
        """Count one interaction."""
        self._tried[name] += 1
        self._succeeded[name] += success

    @property
    def found(self) -> dict[str, SuccessCount]:
        """In order of name."""
        return {name: SuccessCount(count, self._succeeded[name]) for name, count in sorted(self._tried.items())}
