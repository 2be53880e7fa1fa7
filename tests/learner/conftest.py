"""A small store and its data set, once for each module of tests that learns from it."""

from pathlib import Path

import pytest

from learner.data.dataset import Dataset, load_dataset
from tests.support.small_networks import TINY
from tests.support.small_trainings import coins, make_store


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("learner")


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return load_dataset(make_store(folder / "store"), TINY)


@pytest.fixture(scope="module")
def coin_dataset(dataset: Dataset) -> Dataset:
    return coins(dataset)
