"""Does the store say what happened? Random rows are executed again, each alone in a scene of its own, and compared."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from collector.objects.catalogue import load_ref
from collector.sim.restoration import refuse_other_simulators, restored
from collector.sim.trial import Trial
from shared.errors import StoreError, UsageError
from shared.plan import InteractionRecord, RolloutRecord
from shared.primitives import PRIMITIVES
from shared.seeds import generator
from shared.store import Store
from shared.types import Float, Outcome, OutcomeKind


@dataclass(frozen=True, slots=True)
class Replayed:
    """A stored row beside what came of executing it again."""

    shard: str
    rollout: int
    step: int
    stored: Outcome
    again: Outcome

    @property
    def same_label(self) -> bool:
        """Whether both say the same of success."""
        return self.stored.success is self.again.success

    @property
    def joint_error(self) -> float:
        """How far the target joint's end positions are apart, rad or length; NaN where a trial has none."""
        return abs(self.stored.end_joint_position - self.again.end_joint_position)


@dataclass(frozen=True, slots=True)
class Divergence:
    """How far rows come out again."""

    rows: tuple[Replayed, ...]

    @property
    def other_labels(self) -> tuple[Replayed, ...]:
        """Rows with another label."""
        return tuple(row for row in self.rows if not row.same_label)

    @property
    def other_kinds(self) -> int:
        """How many ended in another way."""
        return sum(row.stored.kind is not row.again.kind for row in self.rows)

    @property
    def joint_errors(self) -> Float:
        """Of all rows where both have an end position."""
        return np.array([row.joint_error for row in self.rows if math.isfinite(row.joint_error)])


def resimulate(
    store: Store, objects: Path, rows: int, seed: int, advance: Callable[[], None] = lambda: None
) -> Divergence:
    """Execute random labels of a store again.

    Args:
        store: which one.
        objects: folder of the objects that it was made with.
        rows: how many; all of them, if there are fewer.
        seed: of the choice.
        advance: called after each.

    Raises:
        StoreError: the store is damaged, or holds no label.
        ObjectError: an object is missing, or its files are others.
        UsageError: another simulator made the store.
    """
    refuse_other_simulators(store.setting.collection)
    replayed = []
    for shard, chosen in _chosen(store, rows, seed).items():
        records = {record.index: record for record in store.read_rollouts(shard)}
        for rollout, step in chosen:
            record = records[rollout]
            row = next(one for one in record.interactions if one.step == step)
            replayed.append(Replayed(shard, rollout, step, row.outcome, _again(store, objects, record, row)))
            advance()
    return Divergence(tuple(replayed))


def _chosen(store: Store, rows: int, seed: int) -> dict[str, list[tuple[int, int]]]:
    """Rollout and step of random labels, by shard."""
    table = store.interactions(["rollout", "step", "outcome"]).to_pylist()
    labels = [row for row in table if OutcomeKind(row["outcome"]).was_executed]
    if not labels:
        raise StoreError(f"{store.where}: holds no interaction that could be executed again")
    picked = generator(seed, "resimulate").choice(len(labels), min(rows, len(labels)), replace=False)
    by_shard: dict[str, list[tuple[int, int]]] = {}
    for row in (labels[k] for k in sorted(picked.tolist())):
        by_shard.setdefault(row["shard"], []).append((row["rollout"], row["step"]))
    return by_shard


def chosen_interactions(
    store: Store, shard: str = "", rollout: int | None = None, step: int | None = None, success: bool | None = None
) -> tuple[RolloutRecord, tuple[InteractionRecord, ...]]:
    """A whole rollout of a store, if only that is chosen, or else the first interaction that fits.

    Args:
        store: which one.
        shard: name of the only shard that counts; "": all count.
        rollout: number of the rollout; None: any.
        step: number of the interaction within the rollout; None: any.
        success: label of the interaction; None: any.

    Raises:
        UsageError: there is none, or several plans have a rollout of this number.
        StoreError: the store is damaged.
    """
    wanted = {"rollout": rollout, "step": step, "success": success}
    where = [(name, "=", value) for name, value in wanted.items() if value is not None]
    table = store.interactions(["rollout", "step", "success", "outcome"], where=where).to_pylist()
    found = [row for row in table if OutcomeKind(row["outcome"]).was_executed and shard in ("", row["shard"])]
    if not found:
        chosen = [f"{name} {value}" for name, value in wanted.items() if value is not None]
        chosen += [f"shard {shard}"] if shard else []
        raise UsageError(
            f"{store.where}: has no interaction" + (f" of {', '.join(chosen)}" if chosen else "") + "; choose another "
            "(rollouts and steps are columns of interactions.parquet)"
        )
    shards = list(dict.fromkeys(row["shard"] for row in found))
    if rollout is not None and len(shards) > 1:
        raise UsageError(f"{store.where}: several plans have a rollout {rollout}; name one of: {', '.join(shards)}")
    first = found[0]
    record = next(each for each in store.read_rollouts(first["shard"]) if each.index == first["rollout"])
    if rollout is not None and step is None and success is None:
        return record, tuple(row for row in record.interactions if row.outcome.kind.was_executed)
    return record, tuple(row for row in record.interactions if row.step == first["step"])


def _again(store: Store, objects: Path, record: RolloutRecord, row: InteractionRecord) -> Outcome:
    collection = store.setting.collection
    scene = restored(load_ref(objects, record.object, collection.collision), collection, record, row)
    return Trial(scene, row.action, row.target_part, PRIMITIVES.get(row.primitive), collection.fidelity).run()
