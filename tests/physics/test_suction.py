"""Laws of the hand with a suction cup: where it seals, what the seal bears, and that nothing remains of it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject, Body
from collector.sim.gripper import ARM_STIFFNESS
from collector.sim.scene import Scene
from collector.sim.suction import BEND_STIFFNESS, HOLDING_FORCE, RADIUS, SuctionGripper
from collector.sim.trial import Trial
from shared.config import FIDELITIES, Fidelity
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, Leg, PrimitiveSpec, hand_start
from shared.types import Action, HiddenDynamics, Outcome, OutcomeKind
from tests.support.single_door import base_with, box, door, drawer

PULL = PRIMITIVES.get("pull")
FAR = replace(PULL, then=Leg((0.0, 0.0, -0.3)))
"""A pull so far that the hand, whose drive has 1 N for each mm, would pull by 190 N."""
FRICTION = 0.5
UP = np.array([0.0, 0.0, 1.0])


def scene_of(target: ArticulatedObject, joint_friction: float = 0.05, fidelity: str = "fast") -> Scene:
    dynamics = HiddenDynamics(part_mass=0.2, joint_friction=joint_friction, surface_friction=FRICTION)
    return Scene(target, dynamics, FIDELITIES[fidelity], PULL, "suction")


def aimed(point: tuple[float, float, float], slant_deg: float = 0.0) -> Action:
    """Into +x, or up to a slant of it."""
    slant = np.deg2rad(slant_deg)
    return Action(0, np.array(point), gripper_rotation(np.array([np.cos(slant), np.sin(slant), 0.0]), UP))


def pull(
    target: ArticulatedObject | Scene,
    action: Action,
    primitive: PrimitiveSpec = PULL,
    joint_friction: float = 0.05,
    fidelity: str = "fast",
    start: float = 0.0,
) -> Outcome:
    scene = target if isinstance(target, Scene) else scene_of(target, joint_friction, fidelity)
    scene.put(np.array([start]))
    return Trial(scene, action, 1, primitive, FIDELITIES[fidelity]).run()


def sealed(scene: Scene, point: tuple[float, float, float], slant_deg: float = 0.0) -> SuctionGripper:
    """The hand as it has closed with its lip in the surface."""
    gripper, action = scene.gripper, aimed(point, slant_deg)
    assert isinstance(gripper, SuctionGripper)
    gripper.place(action.rotation, hand_start(action), opened=True)
    gripper.drive(np.array([0.0, 0.0, 0.05, 0.0]))
    for _ in range(240):
        scene.system.step()
    gripper.close()
    return gripper


def plate(width: float) -> ArticulatedObject:
    """A drawer whose front is a block of this width, well before a wall of the same body."""
    slide = drawer().parts[0].joint
    meshes = (box((0.0, -width / 2, -width / 2), (0.4, width / 2, width / 2)), box((0.05, -0.2, -0.2), (0.4, 0.2, 0.2)))
    return base_with(box((0.0, 1.0, 0.0), (0.1, 1.1, 0.1)), Body("block", "drawer", slide, meshes, meshes))


@pytest.mark.parametrize("fidelity", ["fast", pytest.param("reference", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("share", "holds"), [(0.95, True), (1.05, False)])
def test_a_seal_holds_below_its_force_and_lets_go_above(share: float, holds: bool, fidelity: str) -> None:
    # A drawer that moves at a known force: what the cup pulls by grows to that and no further.
    outcome = pull(drawer(), aimed((0.3, 0.0, 0.0)), FAR, share * HOLDING_FORCE, fidelity, start=0.3)
    assert outcome.kind is OutcomeKind.OK
    assert outcome.success is holds
    assert outcome.grasp_opening == 2 * RADIUS


# What the seal bears alone in each direction, over what the hand's drive has for each m or rad.
LIMITS = {
    "pull": (0.0, 0.0, -HOLDING_FORCE / ARM_STIFFNESS, 0.0),
    "shear": (FRICTION * HOLDING_FORCE / ARM_STIFFNESS, 0.0, 0.0, 0.0),
    "turn": (0.0, 0.0, 0.0, RADIUS * HOLDING_FORCE / BEND_STIFFNESS),
    "half of a pull and half of a shear": (
        *(0.0, FRICTION * HOLDING_FORCE / 2 / ARM_STIFFNESS),
        *(-HOLDING_FORCE / 2 / ARM_STIFFNESS, 0.0),
    ),
}


@pytest.mark.parametrize("direction", LIMITS)
def test_the_limit_of_the_load_holds_in_each_direction(direction: str) -> None:
    scene = scene_of(drawer(), joint_friction=1e4)
    for share, holds in ((0.95, True), (1.05, False)):
        scene.put(np.array([0.3]))
        gripper = sealed(scene, (0.3, 0.0, 0.0))
        touching = np.append(gripper.displacement(), 0.0)
        for part in np.linspace(0.0, share, 240):
            gripper.drive(touching + part * np.array(LIMITS[direction]))
            scene.system.step()
            gripper.attached()
        for _ in range(120):
            scene.system.step()
            gripper.attached()
        assert gripper.holds() is holds, share


def test_a_seal_needs_a_flat_face_of_one_body_that_is_wider_than_the_rim() -> None:
    kinds = {width: pull(plate(width), aimed((0.0, 0.0, 0.0))).kind for width in (0.032, 0.028, 0.01)}
    assert kinds == {0.032: OutcomeKind.OK, 0.028: OutcomeKind.NO_GRASP, 0.01: OutcomeKind.NO_GRASP}
    # A slab ends at y = -0.3; then the same one with a frame around it, flush with its front but another body.
    slab, frame = door(), box((-0.32, -0.6, -0.3), (-0.25, -0.301, 0.3))
    for target in (slab, base_with(frame, slab.parts[0])):
        inside, across = (pull(target, aimed((-0.32, y, 0.0))).kind for y in (-0.284, -0.29))
        assert (inside, across) == (OutcomeKind.OK, OutcomeKind.NO_GRASP)


def test_a_seal_counts_as_a_contact_where_only_the_lip_reaches_the_surface() -> None:
    # The hand ends 0.1 before p, and its tip 0.0124 behind p.
    kinds = {}
    for gap in (0.003, 0.009):
        outcome = pull(door(), aimed((-0.32 - 0.0124 - gap, -0.1, 0.1)))
        kinds[gap] = outcome.kind, outcome.success
    assert kinds == {0.003: (OutcomeKind.OK, True), 0.009: (OutcomeKind.NO_GRASP, False)}


def test_a_seal_needs_a_cup_that_faces_the_surface() -> None:
    kinds = {slant: pull(door(), aimed((-0.32, 0.0, 0.1), slant)).kind for slant in (0, 18, 22, 35)}
    assert kinds == {0: OutcomeKind.OK, 18: OutcomeKind.OK, 22: OutcomeKind.NO_GRASP, 35: OutcomeKind.NO_GRASP}


@pytest.mark.parametrize("fidelity", ["fast", pytest.param("reference", marks=pytest.mark.slow)])
def test_a_pull_with_the_cup_opens_doors_and_drawers_that_fingers_cannot_pinch(fidelity: str) -> None:
    for target, point, start in ((door(), (-0.32, -0.1, 0.0), 0.0), (drawer(), (0.3, 0.0, 0.0), 0.3)):
        assert pull(target, aimed(point), fidelity=fidelity, start=start).success


def test_what_is_not_waited_for_changes_no_outcome_of_a_cup() -> None:
    for primitive, joint_friction in itertools.product((PULL, FAR), (0.05, 2.0, 12.0, 60.0)):
        outcomes = []
        for fidelity in (Fidelity(), FIDELITIES["fast"]):
            scene = scene_of(door(), joint_friction)
            scene.put(np.zeros(1))
            outcomes.append(Trial(scene, aimed((-0.32, -0.2, 0.1)), 1, primitive, fidelity).run())
        full, early = outcomes
        assert (early.kind, early.success) == (full.kind, full.success)
        assert early.motion == pytest.approx(full.motion, abs=5e-3)


def test_nothing_remains_of_a_seal_in_the_trials_after_it() -> None:
    """On the door and on the carcass, held to the end and torn off, and not sealed at all."""
    aims = [aimed((-0.32, -0.2, 0.1), 6.0), aimed((-0.25, 0.45, 0.0)), aimed((-0.32, -0.3, 0.0))]
    for joint_friction in (0.05, 30.0):
        used = scene_of(door(overhang=-0.3), joint_friction)
        for aim in (*aims, *aims[::-1]):
            again, new = pull(used, aim, FAR), pull(door(overhang=-0.3), aim, FAR, joint_friction)
            assert (again.kind, again.motion, again.steps) == (new.kind, new.motion, new.steps)
            assert again.displacement.tobytes() == new.displacement.tobytes()
