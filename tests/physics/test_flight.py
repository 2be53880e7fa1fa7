"""The hand flies up to the object and not into it."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import linprog

from collector.objects.articulation import ArticulatedObject
from collector.sim.engine import Link, convex_shapes
from collector.sim.gripper import frame
from collector.sim.scene import Scene
from collector.sim.trial import CLEARANCE, Trial
from shared.config import Fidelity, FidelityVersion
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, hand_start
from shared.types import Action, Float, HiddenDynamics
from tests.support.single_door import door, drawer, latched_door

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
