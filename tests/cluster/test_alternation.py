"""The order of the alternation: every step finds what it needs, whoever drives it."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.alternation import ADOPTED, AlternationStep, Collect, Publish, Train, alternation, perform
from shared.heartbeat import Heartbeat
from shared.policies.methods import BaselineName

BASELINES: tuple[BaselineName, ...] = ("where2act-interaction", "where2act-adaptation")


@given(rounds=st.integers(1, 6), adopts=st.booleans(), baselines=st.lists(st.sampled_from(BASELINES), unique=True))
def test_alternation_of_any_length_each_step_finds_what_it_needs(
    rounds: int, adopts: bool, baselines: list[BaselineName]
) -> None:
    asked: list[int] = []

    def goes_on(number: int) -> bool:
        asked.append(number)
        return number < rounds

    steps = list(alternation(goes_on, adopts=adopts, baselines=baselines))
    assert asked == list(range(1, rounds + 1)), "once a round, when its networks are trained"
    assert len({step.name for step in steps}) == len(steps)
    left: set[str | None] = {None}
    published = {0}
    for step in steps:
        match step:
            case Collect(version=version):
                assert version in published
            case Train(folder=folder, init=init):
                assert init in left
                left.add(folder)
            case Publish(version=version, folder=folder):
                assert folder in left
                published.add(version)
            case _:
                assert step.name == "adopt" and adopts
                left.add(ADOPTED)
    assert published == set(range(rounds + 1))
    assert left >= set(baselines)
    last = [step for step in steps if isinstance(step, Publish)][-1]
    assert (
        steps[-1] == last and last.folder == (baselines or [ADOPTED if adopts and rounds == 1 else f"aip-{rounds}"])[-1]
    )


def test_perform_of_a_step_that_is_around_the_alternation_raises() -> None:
    with pytest.raises(ValueError, match="'report' is no step of an alternation"):
        perform(AlternationStep("report"), None, print)  # type: ignore[arg-type]


def test_heartbeat_beats_while_the_context_lasts_and_not_after() -> None:
    beats: list[float] = []
    beaten = threading.Event()

    def beat() -> None:
        beats.append(0.0)
        if len(beats) > 3:
            beaten.set()

    asked: list[float] = []

    def pause_s(spent_s: float) -> float:
        asked.append(spent_s)
        return 0.001

    with Heartbeat(beat, pause_s, "test"):
        assert beaten.wait(60)
    count = len(beats)
    threading.Event().wait(0.05)
    assert len(beats) == count
    assert asked == sorted(asked)
    with Heartbeat(lambda: beats.append(1.0), lambda _: 3600.0, "test", at_once=True):
        pass
    assert beats[count:] == [1.0], "at the beginning, and its end does not wait for the next"
