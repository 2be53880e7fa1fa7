"""What fidelity versions 2 to 4 do not wait for changes no outcome."""

from collections.abc import Callable

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.sim.scene import CONTACT_RANGE, SHORTCUTS, Scene
from collector.sim.trial import Trial
from shared.config import FIDELITIES, CollectionConfig, Fidelity
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, HiddenDynamics, Outcome, OutcomeKind
from tests.support.single_door import door, drawer

FULL, STILL, SLIDING, MEASURING = (Fidelity(version=version) for version in (1, 2, 3, 4))
EASY = {"part_mass": 0.2, "joint_friction": 0.05, "surface_friction": 1.0}
FREE_EDGE, HINGE_EDGE, MIDDLE = (-0.32, -0.295, 0.0), (-0.32, 0.295, 0.0), (-0.32, 0.0, 0.0)
INTO: Float = np.array([1.0, 0.0, 0.0])


def act(
    target: ArticulatedObject,
    point: tuple[float, float, float],
    primitive: str,
    fidelity: Fidelity,
    **changed: float,
) -> Outcome:
    spec = PRIMITIVES.get(primitive)
    scene = Scene(target, HiddenDynamics(EASY | changed), fidelity, spec)
    scene.put(np.zeros(1))
    action = Action(0, np.array(point), gripper_rotation(INTO, np.array([0.0, 0.0, 1.0])))
    return Trial(scene, action, 1, spec, fidelity).run()


@pytest.mark.parametrize("fidelity", [STILL, SLIDING, MEASURING], ids=["version 2", "version 3", "version 4"])
@pytest.mark.parametrize(
    ("make", "point", "primitive", "changed"),
    [
        (door, FREE_EDGE, "pull", {}),
        (door, FREE_EDGE, "pull", {"joint_friction": 6.0}),
        (door, HINGE_EDGE, "pull", {}),
        (door, MIDDLE, "pull", {}),
        (door, MIDDLE, "pull", {"surface_friction": 4.0}),
        (door, MIDDLE, "pull", {"surface_friction": 0.1}),
        (door, MIDDLE, "push", {}),
        (door, MIDDLE, "push-left", {"surface_friction": 4.0}),
        (door, FREE_EDGE, "pull-up", {"joint_friction": 6.0}),
        (drawer, (0.0, 0.0, 0.0), "push", {}),
        # 50 N would be needed; the hand has less than 15.
        (drawer, (0.0, 0.0, 0.0), "push", {"joint_friction": 50.0}),
        # It has more than 5 N when it has pressed for long enough, so that the drawer moves after a standstill.
        (drawer, (0.0, 0.0, 0.0), "push", {"joint_friction": 5.0}),
    ],
)
def test_what_is_not_waited_for_changes_no_outcome(
    make: Callable[[], ArticulatedObject],
    point: tuple[float, float, float],
    primitive: str,
    changed: dict[str, float],
    fidelity: Fidelity,
) -> None:
    full, early = (act(make(), point, primitive, timing, **changed) for timing in (FULL, fidelity))
    assert early.kind is full.kind
    assert early.success is full.success
    assert early.motion == pytest.approx(full.motion, abs=2e-3)


def test_a_hand_that_nothing_gives_way_to_takes_a_fraction_of_the_steps() -> None:
    for primitive, point in (("push", MIDDLE), ("pull", MIDDLE)):
        full, early = (act(door(), point, primitive, fidelity, surface_friction=4.0) for fidelity in (FULL, STILL))
        assert full.kind is early.kind is OutcomeKind.OK
        assert early.steps < 0.8 * full.steps


def test_fingers_that_slide_along_what_does_not_move_take_a_fraction_of_the_steps() -> None:
    """They hold the edge at the hinge, where no pull opens the door."""
    for surface_friction in (0.7, 1.0, 4.0):
        changed = {"surface_friction": surface_friction}
        still, sliding = (act(door(), HINGE_EDGE, "pull", fidelity, **changed) for fidelity in (STILL, SLIDING))
        assert still.kind is sliding.kind is OutcomeKind.OK
        assert still.grasp_opening == pytest.approx(sliding.grasp_opening, abs=1e-4)
        assert max(still.motion, sliding.motion) < 1e-4
        assert sliding.steps < 0.6 * still.steps


@pytest.mark.parametrize("surface_friction", [0.3, 1.0, 4.0])
def test_sliding_faster_pulls_no_harder(surface_friction: float) -> None:
    """A pull opens the door against the same friction of its joint, whether what slides may move faster or not."""
    for joint_friction in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0):
        changed = {"surface_friction": surface_friction, "joint_friction": joint_friction}
        still, sliding = (act(door(), FREE_EDGE, "pull", fidelity, **changed) for fidelity in (STILL, SLIDING))
        assert still.kind is sliding.kind
        assert still.success is sliding.success
        assert sliding.motion == pytest.approx(still.motion, abs=3e-3)


@pytest.mark.parametrize(
    ("fidelity", "steps"), [(FULL, [256, 281]), (STILL, [168, 216])], ids=["version 1", "version 2"]
)
def test_an_older_version_takes_the_steps_that_it_took(fidelity: Fidelity, steps: list[int]) -> None:
    """Stores of these versions are continued and executed again with them."""
    outcomes = [act(door(), HINGE_EDGE, "pull", fidelity, surface_friction=friction) for friction in (0.7, 4.0)]
    assert [outcome.steps for outcome in outcomes] == steps


def test_only_what_closed_fingers_pull_slides_faster() -> None:
    for primitive, point in (("push", MIDDLE), ("push-left", MIDDLE), ("push-up", FREE_EDGE)):
        still, sliding = (act(door(), point, primitive, fidelity) for fidelity in (STILL, SLIDING))
        assert still.steps == sliding.steps
        assert still.motion == sliding.motion


def test_parts_look_out_for_the_hand_as_far_as_before_and_less_for_each_other() -> None:
    scene = Scene(door(), HiddenDynamics(EASY), STILL, PRIMITIVES.get("push"))
    hand = {shape.contact_offset for link in scene.gripper.fingers for shape in link.collision_shapes}
    part = {shape.contact_offset for link in scene.links for shape in link.collision_shapes}
    assert [2 * offset for offset in part] == pytest.approx([SHORTCUTS[2].part_range])
    assert [sum(pair) for pair in zip(hand, part, strict=True)] == pytest.approx([CONTACT_RANGE])


def test_a_setting_says_which_version_it_is_of_and_one_that_does_not_is_of_the_first() -> None:
    assert FIDELITIES["fast"] == SLIDING
    assert CollectionConfig().as_document()["fidelity"]["version"] == 3
    assert "version" not in FULL.as_document()
    described = CollectionConfig.model_validate({"fidelity": FULL.as_document()})
    assert described.fidelity == FULL
