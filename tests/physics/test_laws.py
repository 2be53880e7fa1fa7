"""Laws that the simulated world must obey, on objects whose right answers are known by hand."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.objects.procedural import generate
from collector.objects.readers import read_object
from collector.sim.scene import Scene, restricted_limits
from collector.sim.trial import Trial, hand_pose
from shared.config import FIDELITIES, PUBLISHED_LEG_S
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, PrimitiveSpec, hand_start
from shared.types import Action, Direction, HiddenDynamics, Outcome, OutcomeKind
from tests.support.single_door import door, drawer

FAST = FIDELITIES["fast"]
PUSH, PULL = PRIMITIVES.get("push"), PRIMITIVES.get("pull")


def dynamics_of(
    mass: float, friction: float, surface: float, direction: Direction = Direction.AS_BUILT
) -> HiddenDynamics:
    return HiddenDynamics({"part_mass": mass, "joint_friction": friction, "surface_friction": surface}, direction)


EASY = dynamics_of(0.2, 0.05, 1.0)
INTO = np.array([1.0, 0.0, 0.0])


def act(
    target: ArticulatedObject,
    point: tuple[float, float, float],
    primitive: PrimitiveSpec = PUSH,
    dynamics: HiddenDynamics = EASY,
    start: float = 0.0,
    approach: np.ndarray = INTO,
    forward: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Outcome:
    scene = Scene(target, dynamics, FAST, primitive)
    scene.put(np.array([start]))
    action = Action(0, np.array(point), gripper_rotation(approach, np.array(forward)))
    return Trial(scene, action, 1, primitive, FAST).run()


@dataclass(frozen=True)
class Free:
    """An object whose one part nothing hinders, and how hard it is to move.

    Attributes:
        make: makes it.
        inertia: of the part about its joint for each kg of its mass: 1 if it slides, m^2 if it turns.
    """

    make: Callable[[], ArticulatedObject]
    inertia: float


FREE = {
    "prismatic": Free(drawer, 1.0),
    # A slab of 0.6 x 0.02 about its edge.
    "revolute": Free(door, 0.6**2 / 3 + 0.02**2 / 3),
}


def move_under(
    target: ArticulatedObject,
    effort: float,
    friction: float,
    mass: float = 0.5,
    seconds: float = 0.5,
    speed: float = 0.0,
) -> np.ndarray:
    """Joint position after each step under a constant effort (N or N m) on the joint, from rest or from a speed."""
    scene = Scene(target, dynamics_of(mass, friction, 1.0), FAST, PUSH)
    scene.put(np.zeros(1))
    scene._articulation.set_qvel(np.array([speed], dtype=np.float32))
    positions = []
    for _ in range(round(seconds * FAST.approach.steps_per_second)):
        scene._articulation.set_qf(np.array([effort], dtype=np.float32))
        scene.system.step()
        positions.append(float(scene.joint_positions()[0]))
    return np.array(positions)


@pytest.mark.parametrize("kind", FREE)
def test_a_joint_stays_below_its_friction_limit_and_slides_above_it(kind: str) -> None:
    free = FREE[kind]
    assert move_under(free.make(), effort=0.95, friction=1.0)[-1] < 1e-3
    # What is left above the limit accelerates the part for half a second.
    expected = 0.5 * 0.05 / (0.5 * free.inertia) * 0.5**2
    assert move_under(free.make(), effort=1.05, friction=1.0)[-1] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("kind", FREE)
def test_twice_the_mass_halves_the_acceleration(kind: str) -> None:
    free = FREE[kind]
    light, heavy = (move_under(free.make(), effort=0.2, friction=0.0, mass=mass)[-1] for mass in (0.25, 0.5))
    assert light == pytest.approx(2 * heavy, rel=0.02)
    assert heavy == pytest.approx(0.5 * 0.2 / (0.5 * free.inertia) * 0.5**2, rel=0.02)


@pytest.mark.parametrize("kind", FREE)
def test_friction_takes_the_energy_that_it_says_and_none_is_gained(kind: str) -> None:
    free, mass, friction, speed = FREE[kind], 0.5, 0.2, 0.4
    coasting = np.diff(move_under(free.make(), 0.0, 0.0, mass, seconds=1.0, speed=speed), prepend=0.0)
    assert coasting.max() <= coasting[0] * (1 + 1e-4)
    sliding = move_under(free.make(), 0.0, friction, mass, seconds=2.0, speed=speed)
    assert np.diff(sliding).max() <= speed / FAST.approach.steps_per_second
    assert sliding[-1] == pytest.approx(0.5 * mass * free.inertia * speed**2 / friction, rel=0.05)
    assert abs(sliding[-1] - sliding[-60]) < 1e-5


def test_a_push_moves_a_free_drawer_as_far_as_the_hand_goes_and_friction_lets_it_slide() -> None:
    outcome = act(drawer(), (0.0, 0.0, 0.0))
    assert outcome.kind is OutcomeKind.OK
    assert outcome.success
    # The fingertips, 0.112 ahead of the hand, end 0.012 beyond p. The drawer comes off them at the hand's speed, and
    # slides until friction has taken its energy.
    speed = 0.05 / PUBLISHED_LEG_S * FAST.approach.pace
    slide = 0.5 * EASY["part_mass"] * speed**2 / EASY["joint_friction"]
    assert outcome.motion == pytest.approx(0.012 + slide, abs=1e-3)
    assert outcome.displacement == pytest.approx([outcome.motion, 0.0, 0.0], abs=1e-4)


def test_a_locked_joint_never_moves() -> None:
    locked = HiddenDynamics(part_mass=0.2, joint_friction=1e4, surface_friction=1.0)
    for primitive in PRIMITIVES:
        for target, point in ((drawer(), (0.0, 0.0, 0.0)), (door(), (-0.32, -0.295, 0.0))):
            outcome = act(target, point, primitive, locked)
            assert outcome.motion < 1e-3
            assert not outcome.success


def test_a_closed_door_cannot_be_pushed_open_but_an_open_one_can_be_pushed_shut() -> None:
    assert not act(door(), (-0.32, 0.0, 0.0)).success
    scene = Scene(door(), EASY, FAST, PULL)
    scene.put(np.array([0.5]))
    world = scene.body_pose(1)
    point = (world @ np.array([-0.02, -0.4, 0.0, 1.0]))[:3]
    into = world[:3, 0]
    outcome = act(door(), tuple(point), start=0.5, approach=into)
    assert outcome.success
    assert outcome.end_joint_position < outcome.start_joint_position


@pytest.mark.parametrize("hinge", [0.3, -0.3])
def test_a_pull_opens_a_door_at_its_free_edge_and_not_at_its_hinge(hinge: float) -> None:
    free, hung = -np.sign(hinge) * 0.295, np.sign(hinge) * 0.295
    at_free = act(door(hinge=hinge), (-0.32, free, 0.0), PULL)
    at_hinge = act(door(hinge=hinge), (-0.32, hung, 0.0), PULL)
    assert at_free.success
    assert at_free.displacement[0] < 0
    assert not at_hinge.success


def test_mirrored_scenes_give_mirrored_outcomes() -> None:
    for y in (0.295, -0.295):
        left = act(door(hinge=0.3), (-0.32, y, 0.05), PULL)
        right = act(door(hinge=-0.3), (-0.32, -y, 0.05), PULL)
        assert left.kind is right.kind
        assert left.success is right.success
        assert left.motion == pytest.approx(right.motion, abs=5e-3)


def test_more_joint_friction_stops_a_pull_near_the_hinge_first() -> None:
    stiff = HiddenDynamics(part_mass=0.2, joint_friction=6.0, surface_friction=1.0)
    assert act(door(), (-0.32, -0.295, 0.0), PULL, EASY).success
    assert not act(door(), (-0.32, -0.295, 0.0), PULL, stiff).success


def test_less_surface_friction_makes_a_sideways_push_slip() -> None:
    # The fingertips press 0.008 deep, with 8 N, on a face along which the drawer slides, and move along it.
    drags, slips = (
        act(
            drawer(),
            (0.2, 0.194, 0.0),
            PRIMITIVES.get("push-left"),
            dynamics_of(0.2, 1.0, friction),
            approach=np.array([0.0, -1.0, 0.0]),
            forward=(1.0, 0.0, 0.0),
        )
        for friction in (2.0, 0.05)
    )
    assert drags.success
    assert drags.motion > 0.03
    assert not slips.success
    assert slips.motion < 1e-3


def test_less_surface_friction_makes_a_slanted_push_slip() -> None:
    # The hand comes down on the top at 45 deg, aimed 0.005 below it, the way that the drawer slides.
    drags, slips = (
        act(
            drawer(),
            (0.2, 0.0, 0.195),
            dynamics=dynamics_of(0.2, 1.5, friction),
            approach=np.array([1.0, 0.0, -1.0]) / np.sqrt(2),
            forward=(1.0, 0.0, 1.0),
        )
        for friction in (2.0, 0.05)
    )
    assert drags.kind is slips.kind is OutcomeKind.OK
    assert drags.success
    assert not slips.success
    assert slips.motion < 0.2 * drags.motion


def test_a_pull_that_pinches_nothing_is_no_grasp() -> None:
    slippery = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=0.1)
    outcome = act(door(), (-0.32, 0.0, 0.0), PULL, slippery)
    assert outcome.kind is OutcomeKind.NO_GRASP
    assert outcome.grasp_opening <= 0.01
    assert outcome.motion == 0.0


def test_the_first_contact_rule() -> None:
    assert act(door(), (-0.45, 0.0, 0.0)).kind is OutcomeKind.NO_CONTACT
    # The hand starts 0.15 before p: with p well behind the door it starts inside it.
    assert act(door(), (-0.2, 0.0, 0.0)).kind is OutcomeKind.START_COLLISION
    # Aiming past the door's edge at a carcass that stands out by 0.2 beyond it touches the wrong part.
    beside = door(overhang=-0.2)
    assert act(beside, (-0.22, -0.4, 0.0), forward=(0.0, 1.0, 0.0)).kind is OutcomeKind.WRONG_PART


def test_a_start_collision_leaves_the_object_where_it_was() -> None:
    # The hand starts within the slab of a half-open door, which the engine would throw off.
    scene = Scene(door(), EASY, FAST, PULL)
    scene.put(np.array([0.5]))
    world = scene.body_pose(1)
    point = (world @ np.array([0.13, -0.4, 0.0, 1.0]))[:3]
    action = Action(0, point, gripper_rotation(world[:3, 0], np.array([0.0, 0.0, 1.0])))
    outcome = Trial(scene, action, 1, PUSH, FAST).run()
    assert outcome.kind is OutcomeKind.START_COLLISION
    assert outcome.end_joint_position == outcome.start_joint_position
    assert scene.settle(60, 480)
    assert scene.joint_positions() == pytest.approx([0.5], abs=1e-4)


def test_a_settled_scene_stays_settled() -> None:
    scene = Scene(door(), EASY, FAST, PULL)
    scene.put(np.array([0.7]))
    assert scene.settle(60, 240)
    before = scene.joint_positions()
    for _ in range(480):
        scene.system.step()
    assert scene.joint_positions() == pytest.approx(before, abs=1e-5)


def test_what_has_settled_stays_settled_whatever_it_is(tmp_path: Path) -> None:
    folders = generate(tmp_path, dict.fromkeys(("Faucet", "Microwave", "Switch", "Table", "TrashCan", "Window"), 1), 4)
    rng = np.random.default_rng(0)
    for target in map(read_object, folders):
        scene, limits = Scene(target, EASY, FAST, PULL), target.limits()
        scene.put(rng.uniform(limits[:, 0], limits[:, 1]))
        assert scene.settle(60, 960), target.ref.id
        before = scene.joint_positions()
        for _ in range(480):
            scene.system.step()
        assert scene.joint_positions() == pytest.approx(before, abs=1e-4), target.ref.id


def test_gravity_pulls_and_a_part_that_falls_is_not_settled() -> None:
    falling = drawer()
    joint = falling.parts[0].joint
    assert joint is not None
    upright = type(joint)(joint.name, joint.kind, 0, joint.parent_from_body, np.array([0.0, 0.0, -1.0]), 0.0, 0.5)
    body = falling.parts[0]
    part = type(body)(body.link, body.part_name, upright, body.visuals, body.collisions)
    scene = Scene(
        ArticulatedObject(falling.ref, (falling.bodies[0], part)),
        dynamics_of(0.2, 0.01, 1.0),
        FAST,
        PULL,
    )
    scene.put(np.zeros(1))
    assert not scene.settle(60, 60)
    assert scene.settle(60, 480)
    assert scene.joint_positions()[0] == pytest.approx(0.5, abs=1e-3)


def test_the_same_trial_gives_the_same_bits_in_a_new_scene() -> None:
    first, second = (act(door(), (-0.32, -0.295, 0.1), PULL) for _ in range(2))
    assert first.end_joint_position == second.end_joint_position
    assert np.array_equal(first.displacement, second.displacement)


def test_direction_modes_bound_the_joint_on_the_hidden_side() -> None:
    limits, here = np.array([[0.0, 1.0]]), np.array([0.25])
    assert restricted_limits(limits, here, Direction.AS_BUILT).tolist() == [[0.0, 1.0]]
    assert restricted_limits(limits, here, Direction.BOTH).tolist() == [[-0.75, 1.25]]
    assert restricted_limits(limits, here, Direction.CLOCKWISE).tolist() == [[0.25, 1.25]]
    assert restricted_limits(limits, here, Direction.COUNTER_CLOCKWISE).tolist() == [[-0.75, 0.25]]


def test_a_drawer_that_may_only_come_out_cannot_be_pushed_in() -> None:
    for direction, moves in ((Direction.CLOCKWISE, True), (Direction.COUNTER_CLOCKWISE, False)):
        scene = Scene(drawer(), dynamics_of(0.2, 0.05, 1.0, direction), FAST, PULL)
        scene.put(np.zeros(1))
        scene.restrict(np.zeros(1))
        action = Action(0, np.zeros(3), gripper_rotation(INTO, np.array([0.0, 0.0, 1.0])))
        assert Trial(scene, action, 1, PUSH, FAST).run().success is moves


def test_fast_agrees_with_the_published_timing() -> None:
    for point in ((-0.32, -0.295, 0.0), (-0.32, 0.295, 0.0), (-0.32, -0.1, 0.1)):
        for primitive in (PUSH, PULL):
            outcomes = []
            for fidelity in FIDELITIES.values():
                scene = Scene(door(), EASY, fidelity, PULL)
                scene.put(np.array([0.0]))
                action = Action(0, np.array(point), gripper_rotation(INTO, np.array([0.0, 0.0, 1.0])))
                outcomes.append(Trial(scene, action, 1, primitive, fidelity).run())
            assert outcomes[0].kind is outcomes[1].kind
            assert outcomes[0].success is outcomes[1].success


@pytest.mark.parametrize("name", PRIMITIVES.names())
def test_trajectories_are_the_published_ones(name: str) -> None:
    primitive = PRIMITIVES.get(name)
    approach = hand_pose(primitive.approach)
    reach = 0.11 if name in ("push-left", "push-up") else 0.10
    assert approach == pytest.approx([0, 0, 0.15 - reach, 0])
    if name == "push":
        assert primitive.then is None
        return
    assert primitive.then is not None
    then = hand_pose(primitive.then)
    if name == "pull":
        assert then == pytest.approx(np.zeros(4))
    else:
        assert np.linalg.norm(then - approach) == pytest.approx(0.05)
        assert primitive.intended @ (then - approach)[:3] == pytest.approx(0.05)


def test_the_hand_starts_before_the_point() -> None:
    action = Action(0, np.array([1.0, 2.0, 3.0]), gripper_rotation(INTO, np.array([0.0, 1.0, 0.0])))
    assert hand_start(action) == pytest.approx([0.85, 2.0, 3.0])
