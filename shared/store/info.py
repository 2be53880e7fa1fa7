"""What a store holds, in figures."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.reproduction import OBJECTS, STORE, reproduction
from shared.store.layout import MANIFEST_FILE, MAX_DOCUMENT_BYTES, Quarantined, ShardManifest
from shared.store.reader import shard_folder
from shared.store.store import Store
from shared.vocabulary import OutcomeKind


@dataclass(frozen=True, slots=True)
class Tally:
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
    by_category: dict[str, Tally]
    by_proposer: dict[str, Tally]
    """By proposer and policy version, such as "aip v1"."""
    by_role: dict[str, Tally]
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
    manifests = store.committed()
    columns = ["object_category", "proposer", "policy_version", "role", "outcome", "success"]
    table = store.interactions(columns).to_pydict()
    labels = [OutcomeKind(kind).is_label for kind in table["outcome"]]
    proposers = [f"{n} v{v}" for n, v in zip(table["proposer"], table["policy_version"], strict=True)]

    def tally(names: Sequence[str]) -> dict[str, Tally]:
        rows = [(name, ok) for name, ok, label in zip(names, table["success"], labels, strict=True) if label]
        tried, succeeded = Counter(name for name, _ in rows), Counter(name for name, ok in rows if ok)
        return {name: Tally(count, succeeded[name]) for name, count in sorted(tried.items())}

    return StoreInfo(
        shards=len(manifests),
        rollouts=sum(manifest.rollouts for manifest in manifests),
        interactions=len(labels),
        observations=sum(manifest.observations for manifest in manifests),
        bytes=sum(manifest.bytes + _manifest_bytes(store, manifest) for manifest in manifests),
        by_category=tally(table["object_category"]),
        by_proposer=tally(proposers),
        by_role=tally(table["role"]),
        by_outcome=dict(sorted(Counter(table["outcome"]).items())),
        by_status=dict(sorted(Counter(store.rollouts().column("status").to_pylist()).items())),
        quarantined=quarantined_in(manifests, store.where),
    )


def _manifest_bytes(store: Store, manifest: ShardManifest) -> int:
    return len(shard_folder(store.place, manifest.shard_id).read(MANIFEST_FILE, MAX_DOCUMENT_BYTES))
