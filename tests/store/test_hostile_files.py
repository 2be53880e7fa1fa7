"""Twenty thousand hostile files of stores, policies and runs: each is refused with one line, or read without harm.

They are read in processes of their own, so that a crash, a hang or a gigabyte of memory is caught and its file named.
To try one again: `python -m tests.support.hostile_files SCRATCH SEED NUMBER NUMBER+1 KIND...`.
"""

from pathlib import Path

import pytest

from tests.support.hostile_runs import assert_harmless

MUTANTS = {"store": 8000, "policy": 4000, "run": 8000}
SAMPLE, SOME, BATCH = 6, {"store": 200, "policy": 300, "run": 750}, 1000


def test_a_sample_of_hostile_files_is_refused_or_harmless(tmp_path: Path) -> None:
    assert_harmless(tmp_path, [*MUTANTS], range(SAMPLE * len(MUTANTS)), "tests.support.hostile_files")


@pytest.mark.slow
@pytest.mark.parametrize("kind", MUTANTS)
def test_a_thousand_hostile_files_are_refused_or_harmless(tmp_path: Path, kind: str) -> None:
    assert_harmless(tmp_path, [kind], range(SAMPLE, SOME[kind]), "tests.support.hostile_files")


@pytest.mark.exhaustive
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", MUTANTS)
def test_twenty_thousand_hostile_files_are_refused_or_harmless(tmp_path: Path, kind: str) -> None:
    for start in range(SOME[kind], MUTANTS[kind], BATCH):
        assert_harmless(
            tmp_path, [kind], range(start, min(start + BATCH, MUTANTS[kind])), "tests.support.hostile_files"
        )
