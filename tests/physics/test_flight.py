"""The hand flies up to the object and not into it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from collector.objects.articulation import ArticulatedObject, Body, Joint
from collector.sim.engine import Link, convex_shapes
from collector.sim.flight import FreeSpace, pieces_of
from collector.sim.gripper import convex, frame
from collector.sim.scene import Scene
from collector.sim.trial import CLEARANCE, Trial
from shared.config import Fidelity, FidelityVersion
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, hand_start
from shared.types import Action, Float, HiddenDynamics
from tests.support.single_door import base_with, box, door, drawer, latched_door

EASY = HiddenDynamics({"part_mass": 0.2, "joint_friction": 0.05, "surface_friction": 1.0})
UP: Float = np.array([0.0, 0.0, 1.0])


def tilted(point: tuple[float, float, float], approach: tuple[float, float, float], forward: Float) -> Action:
    along = np.array(approach) / np.linalg.norm(approach)
    across = forward - (forward @ along) * along
    return Action(0, np.array(point), gripper_rotation(along, across / np.linalg.norm(across)))


SLANTED = tilted((-0.32, -0.306, -0.3), (0.8397, 0.495, -0.2234), np.array([-0.5391, 0.8093, -0.2333]))
"""A corner of the door. Where the fingers are within 2 cm of it, the engine lists no contact in some steps."""


def landings(version: FidelityVersion) -> list[float]:
    """The clearance after each flight of a pull at that corner, as the engine lists it."""
    fidelity, spec = Fidelity(version=version), PRIMITIVES.get("pull")
    scene = Scene(door(), EASY, fidelity, spec)
    scene.put(np.zeros(1))
    flights: list[float] = []
    shift, step = scene.gripper.shift, scene.step
    flew = [False]

    def shifted(place: Float, velocity: Float) -> None:
        shift(place, velocity)
        flew[0] = True

    def stepped() -> None:
        step()
        if flew[0]:
            flights.append(scene.contact().clearance)
            flew[0] = False

    scene.gripper.shift, scene.step = shifted, stepped  # type: ignore[method-assign]
    Trial(scene, SLANTED, 1, spec, fidelity).run()
    return flights


def test_a_hand_does_not_fly_into_what_the_engine_does_not_list() -> None:
    assert min(landings(3)) < -0.001
    assert min(landings(4)) > 0.0


def overlap(scene: Scene, world_from_hand: Float) -> bool:
    """Whether the hand would overlap the object with its palm at `world_from_hand`."""
    hand = [scene.gripper.palm, *scene.gripper.fingers]
    there = world_from_hand @ np.linalg.inv(hand[0].entity_pose.to_transformation_matrix())
    ours = [piece for link in hand for piece in placed(link, there)]
    others = [link for link in scene.system.articulation_link_components if link not in hand]
    return any(meet(one, other) for link in others for other in placed(link, np.eye(4)) for one in ours)


def placed(link: Link, moved: Float) -> list[Float]:
    matrix = moved @ link.entity_pose.to_transformation_matrix()
    return [piece.vertices @ matrix[:3, :3].T + matrix[:3, 3] for piece in convex_shapes(link)]


def meet(one: Float, other: Float) -> bool:
    """Whether two convex hulls have a point in common: weights of the corners of both that give the same point."""
    if (one.min(axis=0) > other.max(axis=0)).any() or (other.min(axis=0) > one.max(axis=0)).any():
        return False
    same = np.concatenate([one, -other]).T
    sums = np.zeros((2, len(one) + len(other)))
    sums[0, : len(one)] = sums[1, len(one) :] = 1.0
    found = linprog(np.zeros(sums.shape[1]), A_eq=np.concatenate([same, sums]), b_eq=[0.0, 0.0, 0.0, 1.0, 1.0])
    return bool(found.status == 0)


@pytest.mark.parametrize(("make", "face"), [(door, -0.32), (drawer, 0.0), (latched_door, -0.32)])
@pytest.mark.parametrize("opened", [False, True], ids=["closed fingers", "open fingers"])
def test_free_space_ends_where_the_hand_would_touch(
    make: Callable[[], ArticulatedObject], face: float, opened: bool
) -> None:
    """The hand overlaps nothing at the end of its free way, and something a millimetre after it."""
    rng = np.random.default_rng(5)
    scene = Scene(make(), EASY, Fidelity(version=4), PRIMITIVES.get("pull"))
    scene.put(np.zeros(len(scene.joints)))
    for _ in range(4):
        y, z, left, up = (float(value) for value in rng.uniform(-0.1, 0.1, 4))
        action = tilted((face, y, z), (1.0, 6 * left, 6 * up), rng.normal(size=3))
        start = frame(action.rotation, hand_start(action))
        scene.gripper.place(action.rotation, hand_start(action), opened=opened)
        stride = 2e-4
        steps = scene.free_space.steps(start, np.array([0.0, 0.0, stride]), 1000, CLEARANCE)
        assert 0 < steps < 1000
        assert not overlap(scene, start @ frame(np.eye(3), (0.0, 0.0, steps * stride)))
        assert overlap(scene, start @ frame(np.eye(3), (0.0, 0.0, steps * stride + 0.001)))


def test_free_space_counts_the_margin_and_what_the_hand_comes_nearer() -> None:
    """Straight before a face, from 0.15 to the end of closed fingers at 0.1124."""
    scene = Scene(drawer(), EASY, Fidelity(version=4), PRIMITIVES.get("push"))
    scene.put(np.zeros(1))
    action = tilted((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), UP)
    start = frame(action.rotation, hand_start(action))
    scene.gripper.place(action.rotation, hand_start(action), opened=False)
    room = 0.15 - 0.1124
    for margin in (0.0, 0.001, 0.01):
        steps = scene.free_space.steps(start, np.array([0.0, 0.0, 1e-3]), 1000, margin)
        assert steps == int((room - margin) / 1e-3)
    assert scene.free_space.steps(start, np.array([0.0, 0.0, -1e-3]), 70, 0.001) == 70
    assert scene.free_space.steps(start, np.array([0.0, 0.0, 1e-3]), 1000, 0.04) == 0


def scattered(rng: np.random.Generator, count: int) -> ArticulatedObject:
    """Hulls of eight points, 4 to 20 cm large, around the way of the hand, each a part of its own."""
    bodies = []
    for k in range(count):
        corners = rng.uniform(-1.0, 1.0, (8, 3)) * rng.uniform(0.02, 0.1, 3)
        shape = convex([(float(x), float(y), float(z)) for x, y, z in corners])
        along, across = rng.normal(size=(2, 3))
        at = frame(gripper_rotation(along / np.linalg.norm(along), across), rng.uniform(-0.2, 0.2, 3))
        joint = Joint(f"slide-{k}", "prismatic", 0, at, np.array([1.0, 0.0, 0.0]), 0.0, 0.1)
        bodies.append(Body(f"block-{k}", "drawer", joint, (shape,), (shape,)))
    base = base_with(box((2.0, 0.0, 0.0), (2.1, 0.1, 0.1)), bodies[0])
    return replace(base, bodies=(base.bodies[0], *bodies))


@pytest.mark.parametrize("opened", [False, True], ids=["closed fingers", "open fingers"])
def test_free_space_among_many_pieces_ends_before_the_nearest_one(opened: bool) -> None:
    """What is not looked at closely decides nothing: all pieces together give the least that any gives alone."""
    rng = np.random.default_rng(7)
    spec, ended = PRIMITIVES.get("pull"), 0
    for _ in range(2):
        target = scattered(rng, 60)
        scene = Scene(target, EASY, Fidelity(version=4), spec)
        scene.put(np.zeros(len(target.parts)))
        hand = [scene.gripper.palm, *scene.gripper.fingers]
        apart = [FreeSpace(hand, [link], pieces_of([link])) for link in scene.links]
        for _ in range(30):
            action = tilted((0.0, 0.0, 0.0), tuple(rng.normal(size=3)), rng.normal(size=3))
            origin = hand_start(action) - 0.25 * action.approach
            scene.gripper.place(action.rotation, origin, opened=opened)
            start = frame(action.rotation, origin)
            stride = rng.normal(size=3) * 1e-5 + np.array([0.0, 0.0, 1e-4])
            steps = scene.free_space.steps(start, stride, 5000, CLEARANCE)
            assert steps == min(space.steps(start, stride, 5000, CLEARANCE) for space in apart)
            if steps:
                assert not overlap(scene, start @ frame(np.eye(3), steps * stride))
            ended += 0 < steps < 5000
    assert ended > 10


def test_scenes_of_an_object_share_what_flights_look_at() -> None:
    target, spec = door(), PRIMITIVES.get("pull")
    first, second = (Scene(target, EASY, Fidelity(version=4), spec).free_space for _ in range(2))
    assert first.pieces is second.pieces
    assert first.pieces is not Scene(door(), EASY, Fidelity(version=4), spec).free_space.pieces
