"""Stages: named steps that run in order, once each, however often the run is stopped and resumed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cluster.ledger import Ledger


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of a campaign.

    Attributes:
        name: unique within the campaign, and the same in every attempt.
        run: does it and returns what to note; must be idempotent, since a kill may come just before the note.
    """

    name: str
    run: Callable[[], Mapping[str, Any]]


def run_stages(stages: Sequence[Stage], ledger: Ledger, say: Callable[[str], None]) -> None:
    """Run what the ledger does not call done, in order.

    Args:
        stages: all of them, done or not.
        ledger: of the run.
        say: is told which stage begins, and which were done before.
    """
    assert len({stage.name for stage in stages}) == len(stages)
    finished = set(ledger.finished)
    before = [stage.name for stage in stages if stage.name in finished]
    if before:
        say(f"done before: {', '.join(before)}")
    for number, stage in enumerate(stages, start=1):
        if stage.name not in finished:
            say(f"stage {number} of {len(stages)}: {stage.name}")
            with ledger.stage(stage.name) as done:
                done(stage.run())
