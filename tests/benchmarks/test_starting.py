"""The benchmark of a collection's start, on made-up commands."""

from pathlib import Path

import pytest

from benchmarks.starting import started

COMMAND = """
import sys, time
from pathlib import Path

def main():
    flags = dict(arg.removeprefix("--").split("=", 1) for arg in sys.argv[2:])
    assert sys.argv[:2] == ["adaafford", "collect"] and flags["workers"] == "2"
"""
COMMITS = """
    shard = Path(flags["store"], "shards", "random-v0-00000000-00000008")
    shard.mkdir(parents=True)
    (shard / "manifest.json").touch()
    time.sleep(600)
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose command does nothing."""
    (tmp_path / "adaafford").mkdir()
    (tmp_path / "adaafford" / "__init__.py").touch()
    (tmp_path / "adaafford" / "console.py").write_text(COMMAND)
    return tmp_path


def test_a_collection_is_stopped_at_its_first_shard(checkout: Path) -> None:
    with (checkout / "adaafford" / "console.py").open("a") as program:
        program.write(COMMITS)
    wall_s, cpu_s = started(checkout, checkout, 2)
    assert wall_s > 0 and cpu_s > 0


def test_a_collection_that_ends_without_a_shard_is_said(checkout: Path) -> None:
    with pytest.raises(SystemExit, match="no shard came of: adaafford collect --objects="):
        started(checkout, checkout, 2)
