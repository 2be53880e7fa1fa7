"""The loop that observes, proposes and executes: what it hands on, when it ends, and what it puts back."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from collector.rollout import interact
from shared.types import Action, Interaction, Observation, Outcome, OutcomeKind


class Door:
    """Counts its interactions as its state; each observation shows a target until the state reaches `hidden_from`."""

    def __init__(self, hidden_from: float = 99.0, unstable_at: float = 99.0) -> None:
        self.position, self.calls = 0.0, list[str]()
        self.hidden_from, self.unstable_at = hidden_from, unstable_at

    def observe(self) -> Observation:
        self.calls.append("observe")
        points, ids = np.zeros((4, 3), np.float32), np.ones(4, np.uint8)
        movable = np.full(4, self.position < self.hidden_from)
        return Observation(points, points, ids, movable, np.arange(4, dtype=np.uint32), np.eye(4))

    def execute(self, action: Action) -> Outcome:
        self.calls.append("execute")
        self.position += 1.0
        kind = OutcomeKind.UNSTABLE if self.position >= self.unstable_at else OutcomeKind.OK
        return Outcome(kind, self.position, success=False)

    def restore(self, state: float) -> None:
        self.calls.append("restore")
        self.position = state


class Proposes:
    """Proposes `most` actions, and remembers what it was given."""

    name = "listed"

    def __init__(self, most: int = 99) -> None:
        self.most, self.given = most, list[tuple[Observation, int]]()

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        self.given.append((observation, len(history)))
        return Action(0, np.zeros(3), np.eye(3)) if len(self.given) <= self.most else None


def run(door: Door, proposer: Proposes, most: int, **options: Any) -> list[Interaction]:
    return list(interact(door, proposer, most, **options))  # type: ignore[arg-type]


def test_interactions_continue_one_another_and_are_handed_to_the_proposer() -> None:
    door, proposer = Door(), Proposes()
    first = run(door, proposer, 2)
    assert [each.outcome.motion for each in first] == [1.0, 2.0]
    run(door, proposer, 1, history=first)
    assert [known for _, known in proposer.given] == [0, 1, 2]
    assert len(first) == 2


def test_each_observation_is_made_once_and_is_the_one_that_the_proposer_saw() -> None:
    door, proposer, executed = Door(), Proposes(), list[Observation]()

    def execute(observation: Observation, action: Action) -> Outcome:
        executed.append(observation)
        return door.execute(action)

    found = run(door, proposer, 3, execute=execute)
    assert door.calls == ["observe", "execute"] * 3
    for (given, _), seen, interaction in zip(proposer.given, executed, found, strict=True):
        assert given is seen is interaction.observation


def test_a_state_is_put_back_before_each_interaction() -> None:
    door = Door()
    door.position = 7.0
    assert [each.outcome.motion for each in run(door, Proposes(), 2, start=3.0)] == [4.0, 4.0]
    assert door.calls == ["restore", "observe", "execute"] * 2


@pytest.mark.parametrize(
    ("door", "proposer", "count"),
    [(Door(hidden_from=2.0), Proposes(), 2), (Door(), Proposes(3), 3), (Door(unstable_at=2.0), Proposes(), 2)],
)
def test_the_loop_ends_where_nothing_can_be_believed_seen_or_proposed(
    door: Door, proposer: Proposes, count: int
) -> None:
    assert len(run(door, proposer, 9)) == count
