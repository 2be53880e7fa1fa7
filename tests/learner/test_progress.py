"""What those who wait for training are told."""

import re

import pytest

from learner.progress import LINE_SECONDS, ProgressReport, Standing


def lines_of(paces: list[float], steps: int, limit: float | None = None, done: int = 0) -> list[str]:
    """The lines of a run whose steps take `paces` seconds."""
    now, said = [100.0], []
    report = ProgressReport("aap", steps, limit, done, live=False, say=said.append, clock=lambda: now[0])
    with report:
        for number, pace in enumerate(paces, start=done + 1):
            now[0] += pace
            report.update(Standing(number, 0.5, 128 * number, sum(paces[: number - done]), None))
        report.finish(Standing(done + len(paces), 0.5, 1280, sum(paces), 0.25), 3)
    return said


def test_a_line_comes_every_few_seconds_and_one_at_the_end() -> None:
    said = lines_of([1.0] * 20, 20)
    assert len(said) == 20 // LINE_SECONDS + 1
    assert said[0] == "aap: step 5/20, loss 0.5000, 128 interactions/s, 0:15 min left"
    assert said[-1] == "aap: 20 steps in 0:20 min, 64 interactions/s, best score 0.2500 at step 3"


@pytest.mark.parametrize(("steps", "limit", "done", "left"), [(65, None, 0, 60), (65, None, 40, 20), (65, 12.0, 0, 7)])
def test_the_time_left_is_of_this_sitting_and_within_the_limit(
    steps: int, limit: float | None, done: int, left: int
) -> None:
    first = lines_of([1.0] * 5, steps, limit, done)[0]
    found = re.search(r"(\d+):(\d\d) min left", first)
    assert found is not None
    assert 60 * int(found[1]) + int(found[2]) == left


def test_a_quick_run_says_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(lines_of([0.1] * 5, 5)) == 1
    ProgressReport("prior", 1, live=False).finish(Standing(1, 0.5, 8, 1.0, None), 0)
    assert capsys.readouterr().out == "prior: 1 steps in 0:01 min, 8 interactions/s\n"
