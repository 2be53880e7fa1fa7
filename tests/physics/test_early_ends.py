"""What fidelity version 2 does not wait for changes no outcome."""

from collections.abc import Callable

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.sim.scene import CONTACT_RANGE, PART_RANGE, Scene
from collector.sim.trial import Trial
from shared.config import FIDELITIES, CollectionConfig, Fidelity
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, HiddenDynamics, Outcome, OutcomeKind
from tests.support.single_door import door, drawer

FULL, EARLY = Fidelity(), FIDELITIES["fast"]
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
) -> None:
    full, early = (act(make(), point, primitive, fidelity, **changed) for fidelity in (FULL, EARLY))
    assert early.kind is full.kind
    assert early.success is full.success
    assert early.motion == pytest.approx(full.motion, abs=2e-3)


def test_a_hand_that_nothing_gives_way_to_takes_a_fraction_of_the_steps() -> None:
    for primitive, point in (("push", MIDDLE), ("pull", MIDDLE)):
        full, early = (act(door(), point, primitive, fidelity, surface_friction=4.0) for fidelity in (FULL, EARLY))
        assert full.kind is early.kind is OutcomeKind.OK
        assert early.steps < 0.8 * full.steps


def test_parts_look_out_for_the_hand_as_far_as_before_and_less_for_each_other() -> None:
    scene = Scene(door(), HiddenDynamics(EASY), EARLY, PRIMITIVES.get("push"))
    hand = {shape.contact_offset for link in scene.gripper.fingers for shape in link.collision_shapes}
    part = {shape.contact_offset for link in scene.links for shape in link.collision_shapes}
    assert [2 * offset for offset in part] == pytest.approx([PART_RANGE])
    assert [sum(pair) for pair in zip(hand, part, strict=True)] == pytest.approx([CONTACT_RANGE])


def test_a_setting_says_which_version_it_is_of_and_one_that_does_not_is_of_the_first() -> None:
    assert CollectionConfig().as_document()["fidelity"]["version"] == 2
    assert "version" not in FULL.as_document()
    described = CollectionConfig.model_validate({"fidelity": FULL.as_document()})
    assert described.fidelity == FULL
