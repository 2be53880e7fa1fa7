"""Counts of tests in several processes, added up."""

import pytest

from tests.chaos.counts import Counts
from tests.chaos.processes import Role

pytestmark = pytest.mark.chaos


def test_counts_of_another_process_are_added() -> None:
    here, there = Counts(), Counts()
    for counts in (here, there):
        counts.killed("collect", Role.ACTOR)
        counts.ended("collect")
        counts.disturbed("disk", "EIO", 3)
    there.killed("collect", Role.HEAD)
    here.add(there.as_json())
    assert here.kills == {("collect", Role.ACTOR): 2, ("collect", Role.HEAD): 1}
    assert here.campaigns == {"collect": 2}
    assert here.steps == {("disk", "EIO"): 6}
