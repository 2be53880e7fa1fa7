"""Hidden facts are truly hidden: twins that no camera tells apart come out the opposite way when they are tried."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.objects.model import ObjectModel
from collector.objects.procedural import build
from collector.objects.procedural.cabinets import storage_furniture
from collector.objects.procedural.shapes import normalised
from collector.objects.readers import read_object
from collector.objects.writing import write_object
from collector.random_proposer import RandomProposer
from collector.sim.environment import SapienEnvironment
from collector.sim.simulator import StageClock
from shared.config import CameraConfig, CollectionConfig
from shared.geometry import camera_pose, gripper_rotation
from shared.tasks import Task, task_named
from shared.types import Action, Direction, HiddenDynamics, Observation

CAMERA = CameraConfig(image_size=256, points=1024, candidates=8000)
EASY = HiddenDynamics(part_mass=0.1, joint_friction=0.1, surface_friction=2.0)
HOLDS = HiddenDynamics(part_mass=0.05, joint_friction=0.05, surface_friction=6.0)
"""Fingers that hold on even to an edge that overhangs by a finger's breadth only."""
PUSHES = 40
"""Random pushes tried on each faucet: some hit its switch from either side."""


def environment_of(
    target: ArticulatedObject, task: Task, azimuth_deg: float, dynamics: HiddenDynamics = EASY
) -> SapienEnvironment:
    """The object closed and at rest, seen from the front."""
    pose = camera_pose(azimuth_deg, 40.0, CAMERA.distance)
    rng = np.random.default_rng(7)
    made = SapienEnvironment(target, task, CollectionConfig(camera=CAMERA), dynamics, pose, rng, StageClock())
    assert made.reset(np.random.default_rng(7))
    return made


def same_cloud(one: Observation, other: Observation) -> bool:
    """Whether two observations agree to the last bit, whatever is in them."""
    fields = ("points", "normals", "part_ids", "movable", "pixels")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in fields)


def successes(environment: SapienEnvironment, actions: Sequence[Action]) -> list[bool]:
    """What comes of each action from the state in which the environment is."""
    start, found = environment.state(), []
    for action in actions:
        environment.restore(start)
        environment.observe()
        found.append(environment.execute(action).success)
    return found


@pytest.fixture(scope="module", params=range(4))
def cabinets(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[ArticulatedObject]:
    """One cabinet with a closed overlay door, hung on its left and on its right."""
    rng = np.random.default_rng(request.param)
    width, depth, height = rng.uniform([0.8, 0.5, 0.8], [1.2, 0.8, 1.4])
    overhang, folder = float(rng.uniform(0.02, 0.04)), tmp_path_factory.mktemp("cabinets")
    sides: tuple[Literal["left", "right"], ...] = ("left", "right")
    return [
        read_object(write_object(folder / side, normalised(storage_furniture(side, width, depth, height, overhang))))
        for side in sides
    ]


@pytest.mark.parametrize("azimuth_deg", [150.0, 210.0])
def test_closed_doors_look_the_same_and_open_at_opposite_edges(
    cabinets: list[ArticulatedObject], azimuth_deg: float
) -> None:
    twins = [environment_of(target, task_named("pull-closed-door"), azimuth_deg, HOLDS) for target in cabinets]
    seen = [twin.observe() for twin in twins]
    assert same_cloud(*seen)
    # The left of someone who stands before the door is at +y: the twin that hangs there opens at the other edge.
    for side, opens in ((-1, 0), (1, 1)):
        actions = list(pulls_at_edge(seen[0], side))
        outcomes = [successes(twin, actions) for twin in twins]
        assert sum(outcomes[opens]) >= len(actions) / 2
        assert not any(outcomes[1 - opens])


def pulls_at_edge(seen: Observation, side: int) -> Iterator[Action]:
    """Straight pulls at the door's vertical edge on one side (the sign of y), at four heights."""
    face = np.flatnonzero(seen.movable & (seen.normals[:, 0] < -0.99))
    points = seen.points[face].astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    edge = high[1] if side > 0 else low[1]
    for height in (0.3, 0.45, 0.6, 0.75):
        wanted = np.array([low[0], edge, low[2] + height * (high[2] - low[2])])
        index = face[np.argmin(np.linalg.norm(points - wanted, axis=1))]
        rotation = gripper_rotation(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        yield Action(int(index), np.array([wanted[0], edge, wanted[2]]), rotation)


@pytest.fixture(scope="module", params=[1, 2, 5])
def faucets(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[ArticulatedObject]:
    """One faucet, and the same whose switches turn the other way."""
    made, folder = build("Faucet", 3, request.param), tmp_path_factory.mktemp("faucets")
    return [
        read_object(write_object(folder / name, assembly))
        for name, assembly in (("as-drawn", made), ("reversed", reversed_switches(made)))
    ]


def reversed_switches(made: ObjectModel) -> ObjectModel:
    """The assembly with every switch's axis turned round."""
    parts = (
        replace(part, axis=(-part.axis[0], -part.axis[1], -part.axis[2])) if part.name == "switch" else part
        for part in made.parts
    )
    return replace(made, parts=tuple(parts))


def turning_sense(target: ArticulatedObject, seen: Observation, action: Action) -> float:
    """Which way a push turns the switch that it hits: positive towards greater joint positions."""
    part = int(seen.part_ids[action.point_index])
    joint = target.bodies[part].joint
    assert joint is not None
    pose = target.body_poses(np.zeros(len(target.parts)))[part]
    moment = np.cross(action.point - pose[:3, 3], action.approach)
    return float(moment @ (pose[:3, :3] @ joint.axis))


def assert_opposite(targets: Sequence[ArticulatedObject], twins: Sequence[SapienEnvironment]) -> None:
    """Twins give the same cloud; pushes that work on either alone occur, and turn it the way that it is free to."""
    seen = [twin.observe() for twin in twins]
    assert same_cloud(*seen)
    proposer = RandomProposer(np.random.default_rng(11))
    actions = [action for _ in range(PUSHES) if (action := proposer.propose(seen[0], ())) is not None]
    first, second = (np.array(successes(twin, actions)) for twin in twins)
    only_first, only_second = first & ~second, second & ~first
    assert only_first.sum() >= 2
    assert only_second.sum() >= 2
    assert (first & second).sum() <= 0.15 * (first | second).sum()
    senses = np.array([turning_sense(targets[0], seen[0], action) for action in actions])
    assert (senses[only_first] > 0).mean() >= 0.8
    assert (senses[only_second] < 0).mean() >= 0.8


def test_faucets_look_the_same_and_turn_opposite_ways(faucets: list[ArticulatedObject]) -> None:
    assert_opposite(faucets, [environment_of(target, task_named("push-faucet"), 190.0) for target in faucets])


def test_the_hidden_direction_of_one_faucet_makes_twins_of_it(faucets: list[ArticulatedObject]) -> None:
    target, task = faucets[0], task_named("push-faucet")
    modes = (Direction.CLOCKWISE, Direction.COUNTER_CLOCKWISE)
    twins = [environment_of(target, task, 190.0, replace(EASY, direction=mode)) for mode in modes]
    assert_opposite([target, target], twins)
