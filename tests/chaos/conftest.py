"""What the chaos suite shares: the seed, the counts and their table at the end, objects, and places."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.chaos.campaigns import COLLECT
from tests.chaos.counts import Counts
from tests.chaos.killer import await_last_breath
from tests.chaos.processes import Marked

SEED_VARIABLE = "ADAAFFORD_CHAOS_SEED"
LIMIT_S = 2700
"""Against what hangs; on a busy machine a test takes many times its usual minute or two."""

HERE = Path(__file__).parent
LONGEST_FIRST = ("test_learning.py", "test_collecting.py", "test_two_drivers.py", "test_every_step.py")

COUNTS = "chaos counts"
"""The property of a test's report that holds what it counted."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("chaos") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(LIMIT_S))
    ours = sorted((item for item in items if item.path.parent == HERE), key=_rank)
    # A process is given one half, and what the other has not begun when it is done: short tests end both halves.
    items[:] = [item for item in items if item.path.parent != HERE] + ours[::2] + ours[1::2]


def _rank(item: pytest.Item) -> int:
    """The place of its file in `LONGEST_FIRST`."""
    return LONGEST_FIRST.index(item.path.name) if item.path.name in LONGEST_FIRST else len(LONGEST_FIRST)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    all_counts = Counts()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if isinstance(report, pytest.TestReport) and report.when == "teardown":
            for name, value in report.user_properties:
                if name == COUNTS:
                    all_counts.add(str(value))
    all_counts.print(_seed())


def _seed() -> int:
    return int(os.environ.get(SEED_VARIABLE, "1"))


@pytest.fixture
def seed() -> int:
    return _seed()


@pytest.fixture
def counts(record_property: Callable[[str, object], None]) -> Iterator[Counts]:
    counts = Counts()
    yield counts
    record_property(COUNTS, counts.as_json())


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of built-in objects."""
    folder = tmp_path_factory.mktemp("objects")
    arguments = ["--workers", "0", "--rollouts", "1", "--procedural-per-category", "4", "--store", str(folder / "s")]
    assert Marked().start([*COLLECT, *arguments], folder / "log.txt").wait(200) == 0, (folder / "log.txt").read_text()
    return folder / "s-objects"


@pytest.fixture
def base(place: str, tmp_path: Path, request: pytest.FixtureRequest) -> str:
    """Where stores go, by the kind of place."""
    return str(tmp_path) if place == "disk" else str(request.getfixturevalue("s3_url"))


@pytest.fixture(scope="session")
def s3_environment(s3_endpoint: str) -> dict[str, str]:
    """What names the S3 server, for processes that outlive a test."""
    credentials = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}
    return {**credentials, "AWS_ENDPOINT_URL": s3_endpoint}


@pytest.fixture(scope="session")
def ray_folder() -> Iterator[Path]:
    """For temporary files and Ray's sessions; its name is short, as that of sockets has to be."""
    folder = Path(tempfile.mkdtemp(prefix="ada", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def everybody(ray_folder: Path) -> Iterator[list[Marked]]:
    """All that were started; asked for in the end, once, whether they are gone, since Ray's agents take a minute."""
    started: list[Marked] = []
    yield started
    await_last_breath(started)
