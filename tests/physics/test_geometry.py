"""Laws of frames, rotations and seeds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from collector.objects.articulation import joint_motion
from shared.geometry import camera_pose, gripper_rotation, quaternion_from_rotation, view_from_world
from shared.plan import covered, missing_jobs
from shared.seeds import generator, torch_seed
from tests.support.single_door import door

angles = st.floats(-720, 720)
unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)


@given(angles, st.floats(-85, 85), st.floats(0.5, 20))
def test_a_camera_looks_at_the_origin_and_stands_upright(azimuth: float, elevation: float, distance: float) -> None:
    pose = camera_pose(azimuth, elevation, distance)
    assert pose[:3, :3].T @ pose[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert pose[:3, 3] + distance * pose[:3, 0] == pytest.approx(np.zeros(3), abs=1e-9)
    assert pose[2, 1] == pytest.approx(0, abs=1e-9)
    assert pose[2, 2] > 0
    ahead = view_from_world(pose) @ pose[:3, 0]
    assert ahead[1] == pytest.approx(0, abs=1e-9)
    assert ahead[0] > 0


def test_a_camera_that_looks_straight_down_still_has_a_view_frame() -> None:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    view = view_from_world(pose)
    assert view @ view.T == pytest.approx(np.eye(3))
    assert view @ pose[:3, 2] == pytest.approx([1, 0, 0])


@given(unit, unit)
def test_gripper_rotations_are_rotations_along_the_approach(approach: tuple, roll: tuple) -> None:
    up = np.array(approach) / np.linalg.norm(approach)
    if np.linalg.norm(np.cross(up, roll)) < 1e-3:
        return
    rotation = gripper_rotation(up, np.array(roll))
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert rotation[:, 2] == pytest.approx(up)
    assert rotation[:, 0] @ np.array(roll) > 0
    again = Rotation.from_quat(quaternion_from_rotation(rotation), scalar_first=True).as_matrix()
    assert again == pytest.approx(rotation, abs=1e-9)


@given(st.floats(-3, 3))
def test_a_joint_moves_about_its_axis_and_back(position: float) -> None:
    joint = door().parts[0].joint
    assert joint is not None
    there, back = joint_motion(joint, position), joint_motion(joint, -position)
    assert there @ back == pytest.approx(np.eye(4), abs=1e-12)
    assert there[:3, :3] @ joint.axis == pytest.approx(joint.axis)


def test_seeds_depend_on_the_purpose_and_on_nothing_else() -> None:
    draw = generator(7, "camera", 3).random()
    assert generator(7, "camera", 3).random() == draw
    others = [generator(7, "dynamics", 3), generator(8, "camera", 3), generator(7, "camera", 4), generator(7, "camera")]
    assert len({draw, *(other.random() for other in others)}) == 5
    assert 0 <= torch_seed(7, "aap") < 2**63


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(1, 9))))
def test_what_ranges_cover_is_counted_once(ranges: list[tuple[int, int]]) -> None:
    halves = [(low, low + width) for low, width in ranges]
    assert covered(halves) == len({index for low, high in halves for index in range(low, high)})


@given(st.integers(0, 60), st.sets(st.integers(0, 11)), st.integers(1, 9))
def test_missing_jobs_cover_what_is_missing_once(rollouts: int, shards: set[int], per_shard: int) -> None:
    done = [(5 * k, 5 * k + 5) for k in shards]
    jobs = missing_jobs("random-v0", rollouts, done, per_shard)
    given_out = [index for job in jobs for index in range(job.start, job.stop)]
    have = {index for low, high in done for index in range(low, high)}
    assert sorted(given_out) == sorted(set(range(rollouts)) - have)
    assert all(0 < job.stop - job.start <= per_shard for job in jobs)
