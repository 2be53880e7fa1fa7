"""Catches and latches: what holds, at which force it lets go, and that states restore it."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.sim.mechanisms import AJAR, handles_of
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from shared.config import FIDELITIES, Fidelity
from shared.geometry import gripper_rotation
from shared.hidden import BUILT_IN, HiddenParameter
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, HiddenDynamics, Outcome, OutcomeKind
from tests.support.single_door import door, drawer, latched_door

FAST, AS_PUBLISHED = FIDELITIES["fast"], pytest.param(FIDELITIES["reference"], marks=pytest.mark.slow)
PUSH = PRIMITIVES.get("push")
DOOR, LEVER, BUTTON = 0, 1, 2
INTO, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def scene_of(target: ArticulatedObject, friction: float = 0.05, **hidden: float) -> Scene:
    values = {"part_mass": 0.1, "joint_friction": friction, "surface_friction": 1.0} | hidden
    scene = Scene(target, HiddenDynamics(values), FAST, PUSH)
    scene.put(np.zeros(len(target.parts)))
    return scene


def load(scene: Scene, part: int, amount: float) -> None:
    """Act on the joint of a part (0-based) with a force, N, or a moment, N m, for the next step."""
    body = scene.object.parts[part]
    assert body.joint is not None
    link, along = scene.links[part], scene.body_pose(part + 1)[:3, :3] @ body.joint.axis * amount
    if body.joint.kind == "prismatic":
        link.add_force_at_point(along, scene.body_pose(part + 1)[:3, 3])
    else:
        link.add_force_torque(np.zeros(3), along)


def run(scene: Scene, steps: int, loads: Sequence[tuple[int, float]] = ()) -> Float:
    """The joint positions at the end of `steps` under constant loads."""
    for _ in range(steps):
        for part, amount in loads:
            load(scene, part, amount)
        scene.step()
    return scene.joint_positions()


def released_at(scene: Scene, most: float, steps: int = 1500) -> float:
    """The load on the first joint at which it opens, growing slowly to `most`; infinite if it does not."""
    for step in range(steps):
        load(scene, DOOR, most * step / steps)
        scene.step()
        if scene.joint_positions()[DOOR] > 2e-3:
            return most * step / steps
    return float("inf")


@pytest.mark.parametrize("target", [latched_door(), door(), drawer()], ids=["latched", "door", "drawer"])
def test_a_joint_that_is_locked_for_good_does_not_move_whatever_pulls(target: ArticulatedObject) -> None:
    scene = scene_of(target, latch_travel=1.05)
    for amount in (0.5, -5.0, 50.0, 100.0):
        assert abs(run(scene, 240, [(DOOR, amount)])[DOOR]) < 1e-6
    if len(target.parts) > 1:
        assert abs(run(scene, 240, [(DOOR, 50.0), (LEVER, 3.0), (BUTTON, 3.0)])[DOOR]) < 1e-6


@pytest.mark.parametrize("target", [door(), drawer()], ids=["turning", "sliding"])
@pytest.mark.parametrize("force", [0.5, 2.0, 8.0, 20.0])
def test_a_catch_lets_go_at_its_force_beyond_friction(target: ArticulatedObject, force: float) -> None:
    scene = scene_of(target, catch_force=force)
    expected = force + 0.05
    assert released_at(scene, 1.5 * expected) == pytest.approx(expected, rel=0.05)
    scene.put(np.zeros(1))
    assert released_at(scene, 0.95 * expected) == float("inf")
    assert abs(scene.joint_positions()[0]) < 1e-5


@pytest.mark.parametrize("target", [door(), drawer()], ids=["turning", "sliding"])
def test_a_catch_holds_only_where_the_part_is_closed(target: ArticulatedObject) -> None:
    scene = scene_of(target, catch_force=20.0)
    scene.put(np.array([0.1]))
    assert run(scene, 60, [(DOOR, 0.2)])[0] > 0.14
    scene.put(np.array([0.05]))
    run(scene, 240, [(DOOR, -0.2)])
    assert released_at(scene, 25.0) == pytest.approx(20.05, rel=0.05)


@pytest.mark.parametrize(("choice", "handle", "other"), [(0.2, LEVER, BUTTON), (0.9, BUTTON, LEVER)])
def test_a_latch_opens_after_its_own_handle_has_passed_its_travel(choice: float, handle: int, other: int) -> None:
    scene = scene_of(latched_door(), latch_travel=0.5, latch_handle=choice)
    span = scene.limits[:, 1]
    for moved in (0.0, 0.3, 0.49):
        state = np.zeros(3)
        state[handle], state[other] = moved * span[handle], span[other]
        scene.put(state)
        for _ in range(120):
            load(scene, DOOR, 50.0)
            scene.step()
            assert scene.joint_positions()[DOOR] < 1e-6
    scene.put(np.zeros(3))
    assert run(scene, 120, [(handle, 5.0)])[handle] == pytest.approx(span[handle], abs=1e-3)
    ajar = run(scene, 480)
    assert AJAR * 0.5 < ajar[DOOR] < 2 * AJAR
    assert np.abs(ajar[1:]).max() < 1e-4
    assert run(scene, 60, [(DOOR, 0.5)])[DOOR] > ajar[DOOR] + 0.1


def test_a_latch_locks_again_once_the_part_is_closed_and_the_handle_is_back() -> None:
    scene = scene_of(latched_door(), latch_travel=0.5)
    scene.put(np.array([0.2, 0.0, 0.0]))
    run(scene, 240, [(DOOR, -0.3)])
    assert abs(run(scene, 120, [(DOOR, 50.0)])[DOOR]) < 1e-6
    scene.put(np.array([0.2, 1.0, 0.0]))
    assert run(scene, 5, [(DOOR, -0.3), (LEVER, 5.0)])[DOOR] > 0.0
    assert run(scene, 480, [(LEVER, 5.0)])[DOOR] > 0.5 * AJAR


@pytest.mark.parametrize(
    "hidden", [{"catch_force": 3.0}, {"latch_travel": 0.5}, {"latch_travel": 0.5, "catch_force": 9}]
)
def test_runs_and_restored_states_give_the_same_bits(hidden: dict[str, float]) -> None:
    def motions(scene: Scene) -> list[bytes]:
        scene.put(np.zeros(3))
        return [run(scene, 1, [(DOOR, 4.0), (LEVER, 2.0 * (i % 50 < 25))]).tobytes() for i in range(200)]

    scene = scene_of(latched_door(), **hidden)
    assert motions(scene) == motions(scene) == motions(scene_of(latched_door(), **hidden))


def test_the_order_of_the_parameters_decides_nothing() -> None:
    hidden = {"catch_force": 3.0, "latch_travel": 0.5, "latch_handle": 0.9, "joint_friction": 0.2}
    ends = [
        run(scene_of(latched_door(), **dict(order)), 200, [(DOOR, 4.0), (BUTTON, 2.0)]).tobytes()
        for order in (hidden.items(), reversed(hidden.items()))
    ]
    assert ends[0] == ends[1]


def test_without_a_mechanism_nothing_is_called_and_a_value_of_none_gives_the_same_motion() -> None:
    plain = scene_of(latched_door())
    assert not plain._mechanisms
    defaults = {name: p.default for name, p in BUILT_IN.items() if p.default is not None}
    held = scene_of(latched_door(), **defaults)
    loads = [(DOOR, 0.3), (LEVER, 0.2), (BUTTON, 0.1)]
    assert run(plain, 100, loads).tobytes() == run(held, 100, loads).tobytes()


# Trials


def touch(scene: Scene, point: tuple[float, float, float], part: int, fidelity: Fidelity) -> Outcome:
    action = Action(0, np.array(point), gripper_rotation(INTO, UP))
    return Trial(scene, action, part, PUSH, fidelity).run()


@pytest.mark.parametrize("fidelity", [FAST, AS_PUBLISHED], ids=["fast", "reference"])
def test_a_pressed_handle_opens_its_door_in_a_trial(fidelity: Fidelity) -> None:
    values = {"part_mass": 0.1, "joint_friction": 0.05, "surface_friction": 1.0}
    for choice, opens in ((0.9, True), (0.1, False)):
        hidden = HiddenDynamics(values, latch_travel=0.3, latch_handle=choice)
        scene = Scene(latched_door(), hidden, fidelity, PUSH)
        scene.put(np.zeros(3))
        outcome = touch(scene, (-0.34, 0.0, -0.5), BUTTON + 1, fidelity)
        assert outcome.kind is OutcomeKind.OK
        assert outcome.success is opens
        assert outcome.motion == pytest.approx(scene.joint_positions()[DOOR], abs=1e-6)
        assert (outcome.motion > 0.01) is opens


@pytest.mark.parametrize(
    "fidelity",
    [Fidelity(), Fidelity(version=2), FAST, Fidelity(version=4), AS_PUBLISHED],
    ids=["1", "2", "3", "4", "reference"],
)
def test_a_hand_that_stands_still_before_a_catch_presses_as_hard_as_it_can(fidelity: Fidelity) -> None:
    """The force grows while nothing moves, to 13.9 N at every fidelity."""
    for force, opens in ((13.2, True), (14.6, False)):
        values = {"part_mass": 0.1, "joint_friction": 0.05, "surface_friction": 1.0, "catch_force": force}
        scene = Scene(drawer(), HiddenDynamics(values), fidelity, PUSH)
        scene.put(np.zeros(1))
        assert touch(scene, (0.0, 0.0, 0.0), 1, fidelity).success is opens


def test_a_mechanism_of_a_package_acts_before_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []

    def apply(target: object, value: float) -> None:
        def wind(positions: Float) -> None:
            seen.append(float(positions[0]))
            target.links[0].add_force_at_point([value, 0, 0], [0, 0, 0])  # type: ignore[attr-defined]

        target.before_step(wind)  # type: ignore[attr-defined]

    found: Callable[[str], HiddenParameter] = lambda name: (  # noqa: E731
        HiddenParameter("wind", "", "N", 0.0, 1.0, False, apply, 0.0) if name == "wind" else BUILT_IN[name]
    )
    monkeypatch.setattr("collector.sim.scene.HIDDEN_PARAMETERS.get", found)
    assert run(scene_of(drawer(), wind=1.0), 60)[0] > 0.05
    assert len(seen) == 61


def test_handles_belong_to_the_part_that_carries_them_or_to_the_nearest() -> None:
    assert handles_of(latched_door()) == {1: (2, 3)}
    assert handles_of(door()) == {}
