"""What the chaos suite shares: the seed, the counts, and their table at the end."""

import os
from collections.abc import Callable

import numpy as np
import pytest

from tests.chaos.counts import Counts

SEED_VARIABLE = "ADAAFFORD_CHAOS_SEED"
LIMIT_S = 600
"""For tests that name no limit of their own."""

COUNTS = Counts()

Draw = Callable[[str], np.random.Generator]


def seed_of_all() -> int:
    return int(os.environ.get(SEED_VARIABLE, "1"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("chaos") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(LIMIT_S))


def pytest_terminal_summary() -> None:
    COUNTS.print(seed_of_all())


@pytest.fixture
def counts() -> Counts:
    return COUNTS


@pytest.fixture
def draw() -> Draw:
    """A generator by a name, the same whichever other tests run."""
    return lambda name: np.random.default_rng([seed_of_all(), *name.encode()])
