"""What a try does to the heatmap of a door: the hinge says which side is which, and each kind of try counts once."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.hinting import HintSettings, distance_from_axis, hints_of, measure
from benchmarks.script import run_script
from collector.objects.procedural.cabinets import random_storage_furniture
from collector.objects.procedural.shapes import normalised
from collector.objects.writing import write_object
from shared.plan import InteractionRecord, Job, Plan, RolloutRecord
from shared.seeds import generator
from shared.types import Float32, Interaction, Observation, Outcome, OutcomeKind
from tests.support.fabricate import fabricate_rollout, fabricate_rollouts, fabricate_setting
from tests.support.small_trainings import make_store

places = arrays(np.float64, 3, elements=st.floats(-2, 2))


@given(axis=places, through=places, points=arrays(np.float64, (4, 3), elements=st.floats(-2, 2)))
def test_points_of_a_hinged_part_move_as_fast_as_they_are_far_from_its_axis(
    axis: np.ndarray, through: np.ndarray, points: np.ndarray
) -> None:
    if np.linalg.norm(axis) < 0.1:
        return
    moment = -np.cross(axis, through)
    speeds = np.linalg.norm(np.cross(axis, points) + moment, axis=1)
    assert distance_from_axis(points, axis, moment) * np.linalg.norm(axis) == pytest.approx(speeds, abs=1e-9)


def hints(*args: str) -> int:
    return run_script("hinting", HintSettings, measure, list(args))


def a_door_hung_at_the_left() -> RolloutRecord:
    """Points from y = -0.6 to 0.6 of one part, whose vertical axis is at y = 0.6."""
    made = fabricate_rollout(Plan(setting=fabricate_setting(points=256)), 0, interactions=8)
    observation = made.observations[0]
    part_ids = np.ones_like(observation.part_ids)
    seen = dataclasses.replace(observation, part_ids=part_ids, movable=part_ids > 0)
    return dataclasses.replace(made, observations=(seen,))


def tried_at(rollout: RolloutRecord, y: float, success: bool, **changes: object) -> InteractionRecord:
    """A row that touches the door's point nearest to a place."""
    row, points = rollout.interactions[0], rollout.observations[0].points
    point = int(np.abs(points[:, 1] - y).argmin())
    action = dataclasses.replace(row.action, point_index=point, point=points[point].astype(np.float64))
    outcome = Outcome(OutcomeKind.OK, motion=0.1 * success, success=success)
    axis, through = np.array([0.0, 0.0, 1.0]), np.array([-0.45, 0.6, 0.0])
    twist = np.concatenate([axis, -np.cross(axis, through)])
    told = {"action": action, "outcome": outcome, "target_part": 1, "joint_twist": twist} | changes
    return dataclasses.replace(row, **told)  # type: ignore[arg-type]


def warmer_to_the_right(observation: Observation, history: Sequence[Interaction]) -> Float32:
    return np.where(observation.points[:, 1] < 0, 0.2 + 0.5 * len(history), 0.2).astype(np.float32)


def test_the_first_try_of_each_case_counts_and_its_sides_are_told_by_the_hinge() -> None:
    door = a_door_hung_at_the_left()
    sliding = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    rows = (
        tried_at(door, 0.0, True),  # Between the sides.
        tried_at(door, -0.55, True, joint_twist=sliding),
        tried_at(door, -0.55, True, proposer="aip"),
        tried_at(door, -0.55, True),
        tried_at(door, -0.58, True),
        tried_at(door, 0.58, False),
        tried_at(door, 0.55, False, outcome=Outcome(OutcomeKind.ABANDONED, 0.0, False)),
    )
    free, hinge = hints_of(dataclasses.replace(door, interactions=rows), warmer_to_the_right)
    assert (free.case, hinge.case) == ("success-free", "failure-hinge")
    assert free.interaction.action is rows[3].action
    for hint in (free, hinge):
        assert hint.before == pytest.approx({"free": 0.2, "hinge": 0.2})
        assert hint.after == pytest.approx({"free": 0.7, "hinge": 0.2})


def test_a_door_of_which_one_side_is_hardly_seen_is_left_out() -> None:
    door = a_door_hung_at_the_left()
    observation = door.observations[0]
    outside = (observation.points[:, 1] < 0.3).astype(np.uint8)
    hidden = dataclasses.replace(door, observations=(dataclasses.replace(observation, part_ids=outside),))
    assert not hints_of(dataclasses.replace(hidden, interactions=(tried_at(hidden, -0.58, True),)), warmer_to_the_right)


def test_the_command_counts_tries_and_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setting = fabricate_setting(points=2048)
    plan = Plan(setting=setting.model_copy(update={"task": "push-faucet"}))
    store = make_store(tmp_path / "store", fabricate_rollouts(plan, Job(plan.key, 0, 6)), plan)
    flags = ["--store", str(store.path), "--policy", "push-faucet-sparse", "--picture", str(tmp_path / "hints.png")]
    for bad, message in (
        (["--policy", "pull-closed-door"], "a policy for 'pull-closed-door', but the tries are of 'push-faucet'"),
        (["--picture", str(tmp_path / "nowhere" / "hints.png")], "its folder is not there"),
        (["--picture", str(tmp_path)], "give the name of a PNG file"),
    ):
        assert hints(*flags, *bad) == 2
        assert message in capsys.readouterr().err.splitlines()[-1]
    assert hints(*flags, "--json") == 0
    printed = capsys.readouterr().out
    cases = json.loads(printed.splitlines()[-1])["cases"]
    assert sum(figures["tries"] for figures in cases.values()) > 0
    for figures in cases.values():
        assert 0 <= figures["free"]["brighter"] <= 1
        assert 0 <= figures["hinge"]["after"] <= 1
    assert (tmp_path / "hints.png").is_file() == ("success-free" in cases)


def test_a_policy_of_another_task_is_refused_before_anything_is_tried(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.hinting.stored", lambda _: pytest.fail("a store was made"))
    assert hints("--task", "push-faucet") == 2
    assert "a policy for 'pull-closed-door', but the tries are of 'push-faucet'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_policy_that_comes_along_takes_a_success_on_the_free_side_for_what_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # On fitted cabinets a free edge may meet another leaf, so that a success there says less about the hinge.
    cabinets = tmp_path / "cabinets"
    for index in range(40):
        made = random_storage_furniture(generator(1_000, "procedural StorageFurniture", index))
        write_object(cabinets / f"{index:02d}", normalised(made))
    flags = "--objects", str(cabinets), "--json", "--picture", str(tmp_path / "hints.png")
    assert hints(*flags) == 0
    success = json.loads(capsys.readouterr().out.splitlines()[-1])["cases"]["success-free"]
    assert success["tries"] >= 15
    assert success["free"]["brighter"] > 0.9
    assert success["hinge"]["brighter"] < 0.4
    assert success["hinge"]["after"] < 0.95 * success["hinge"]["before"]
    assert (tmp_path / "hints.png").read_bytes().startswith(b"\x89PNG")
