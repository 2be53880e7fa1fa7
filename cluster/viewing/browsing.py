"""The rollouts of a store that meet some filters, one page at a time: memory does not grow with the store."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from shared.plan import RolloutRecord
from shared.store import Store
from shared.store.coverage import Part
from shared.types import OutcomeKind

PAGE = 25
"""Rollouts of a page."""
_SHARDS_AT_ONCE = 8
"""A compacted shard has tens of megabytes."""
_COLUMNS = ("plan_key", "rollout", "object_id", "object_category", "step", "success", "proposer", "policy_version")


@dataclass(frozen=True, slots=True)
class Filters:
    """What an interaction must have, by column; None: anything."""

    object_id: str | None = None
    outcome: OutcomeKind | None = None
    success: bool | None = None
    proposer: str | None = None
    policy_version: int | None = None


@dataclass(frozen=True, slots=True)
class Match:
    """A rollout with an interaction that meets the filters.

    Attributes:
        shard: that holds it.
        plan: its plan.
        rollout: its number in the plan.
        object_id: its object.
        category: that of the object; any text.
        steps: of the interactions that meet the filters.
        successes: how many of these succeeded.
    """

    shard: str
    plan: str
    rollout: int
    object_id: str
    category: str
    steps: tuple[int, ...]
    successes: int


class Browser:
    """Pages of the rollouts of a store that meet some filters, in order of plan and rollout.

    Args:
        store: which one; what is committed later is not shown.
        filters: all of which one interaction must meet.
        page: rollouts of a page.

    Raises:
        StoreError: the store is damaged.
    """

    def __init__(self, store: Store, filters: Filters = Filters(), page: int = PAGE) -> None:
        self.store = store
        self._size = page
        self._parts = store.parts()
        # Values of an enumeration are compared as texts.
        wanted = {
            name: value.value if isinstance(value, OutcomeKind) else value for name, value in asdict(filters).items()
        }
        where = [(name, "=", value) for name, value in wanted.items() if value is not None]
        self._selection = store.select(_COLUMNS, where)
        self._starts = [(0, 0)]
        self._shard: tuple[str, Mapping[int, RolloutRecord]] = ("", {})

    def page(self, number: int) -> list[Match]:
        """A page from 0 on; all before it were read before, since each tells where the next one begins.

        Raises:
            StoreError: a shard is damaged.
        """
        found = list[Match]()
        begin = self._starts[number]
        for at in self._matches(begin[0]):
            place, match = at
            if place < begin:
                continue
            if len(found) == self._size:
                if len(self._starts) == number + 1:
                    self._starts.append(place)
                break
            found.append(match)
        return found

    def has_page(self, number: int) -> bool:
        """Whether there is a page of this number, as far as pages were read."""
        return 0 <= number < len(self._starts)

    def rollout(self, match: Match) -> RolloutRecord:
        """The whole rollout; the rollouts of one shard are kept in memory.

        Raises:
            StoreError: the shard is damaged.
        """
        if self._shard[0] != match.shard:
            self._shard = "", {}
            self._shard = match.shard, {each.index: each for each in self.store.read_rollouts(match.shard)}
        return self._shard[1][match.rollout]

    def _matches(self, first: int) -> Iterator[tuple[tuple[int, int], Match]]:
        """The matches of all parts from one on, each with the part and its number among the matches of that part."""
        for start in range(first, len(self._parts), _SHARDS_AT_ONCE):
            some = self._parts[start : start + _SHARDS_AT_ONCE]
            for part, table in enumerate(self.store.selected(self._selection, some), start):
                for number, match in enumerate(_by_rollout(table.to_pylist())):
                    yield (part, number), match


def choices(store: Store) -> tuple[list[str], list[int]]:
    """The proposers and the policy versions of a store, from the first and the last shard of each plan.

    Raises:
        StoreError: a shard is damaged.
    """
    ends = dict[str, tuple[Part, Part]]()
    for part in store.parts():
        first, _ = ends.get(part.shard.plan_key, (part, part))
        ends[part.shard.plan_key] = first, part
    selection = store.select(("proposer", "policy_version"))
    seen = {
        (row["proposer"], row["policy_version"])
        for pair in ends.values()
        for table in store.selected(selection, dict.fromkeys(pair))
        for row in table.to_pylist()
    }
    return sorted({proposer for proposer, _ in seen}), sorted({version for _, version in seen})


def _by_rollout(rows: list[dict[str, Any]]) -> Iterator[Match]:
    for rollout, group in groupby(rows, lambda row: row["rollout"]):
        own = list(group)
        yield Match(
            own[0]["shard"],
            own[0]["plan_key"],
            rollout,
            own[0]["object_id"],
            own[0]["object_category"],
            tuple(row["step"] for row in own),
            sum(row["success"] for row in own),
        )
