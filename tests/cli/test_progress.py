"""How people are shown how far long work is."""

import re

import pytest

from shared.progress import LINE_EVERY_S, Progress, minutes


def lines_of(paces: list[float], total: int, done: int = 0, limit: float = 1e9) -> list[str]:
    """The lines of work whose items take `paces` seconds."""
    now, said = [100.0], []
    with Progress(
        "work", total, unit="items", done=done, say=said.append, live=False, clock=lambda: now[0]
    ) as progress:
        for number, pace in enumerate(paces, start=done + 1):
            now[0] += pace
            progress.show(number, most_left_s=limit - (now[0] - 100.0))
    return said


def test_plain_lines_come_every_few_seconds_and_none_for_quick_work() -> None:
    said = lines_of([1.0] * 20, 20)
    assert len(said) == 20 // LINE_EVERY_S - 1
    assert said[0] == "work: 5/20 items, 0:15 min left"
    assert lines_of([0.1] * 5, 5) == []


@pytest.mark.parametrize(("total", "limit", "done", "left"), [(65, 1e9, 0, 60), (65, 1e9, 40, 20), (65, 12.0, 0, 7)])
def test_the_time_left_is_at_the_pace_of_this_attempt_and_within_the_limit(
    total: int, limit: float, done: int, left: int
) -> None:
    found = re.search(r"(\d+):(\d\d) min left", lines_of([1.0] * 5, total, done, limit)[0])
    assert found is not None
    assert 60 * int(found[1]) + int(found[2]) == left


def test_work_that_says_its_total_begins_anew_with_each_total() -> None:
    now, said = [0.0], []
    with Progress("shards", say=said.append, live=False, clock=lambda: now[0]) as progress:
        for total in (4, 8):
            for done in range(1, total + 1):
                now[0] += 3.0
                progress.show(done, total)
    left = {2: 6} | {3: 15, 5: 9, 7: 3}
    assert said == [f"shards: {k}/{4 if k == 2 else 8}, {minutes(s)} left" for k, s in left.items()]


def test_a_bar_says_what_a_line_says_and_a_title_cannot_command_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with Progress("[red]x[/]\x1b]0;owned\x07", 3, details=lambda: "7 a second", live=True) as progress:
        progress.advance()
        text = progress.describe()
    assert text.startswith("1/3, 7 a second, ")
    progress.say("done [b]\x1b")
    err = capsys.readouterr().err
    assert "\x07" not in err
    assert "done [b]\\x1b" in err
