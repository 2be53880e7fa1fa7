"""What the example of a ROS 2 node does between its messages; rclpy itself is not needed."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation

from adaafford.histories import read_history
from adaafford.ros_messages import cloud_scan, depth_scan, seconds
from adaafford.sessions import Session, SessionFiles
from shared.errors import UsageError
from tests.support.ros_recordings import Messages
from tests.support.small_policies import policy_of

NODE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "ros_node.py"), run_name="ros_node")


def recorded(ros: Messages, message: Any) -> Any:
    """A message after it went through the wire."""
    kind = message.__msgtype__
    return ros.store.deserialize_cdr(ros.store.serialize_cdr(message, kind), kind)


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_scans_and_outcomes_of_messages_become_poses(store: Stores, tmp_path: Path) -> None:
    ros, rng = Messages(store), np.random.default_rng(0)
    session = Session(policy_of(), SessionFiles(tmp_path / "history.json", None), points=128)
    loop = NODE["Loop"](session, tmp_path)
    clouds = [recorded(ros, ros.cloud(rng.uniform(0.8, 1.0, (300, 3)), stamp=k + 0.5)) for k in range(3)]
    depths = recorded(ros, ros.image(rng.integers(800, 1000, (30, 40)).astype("<u2"), stamp=9.0))
    info = recorded(ros, ros.camera_info((30, 40), (60, 60, 20, 15)))

    assert loop.wants(0.5)
    step = loop.scan(cloud_scan(clouds[0]), 0.5)
    assert (step.do, step.interaction) == ("try", 1) and not loop.wants(1.5), "an outcome is missing"
    place, turn = (ros.make(f"geometry_msgs/msg/{kind}", *[0.0] * n) for kind, n in (("Point", 3), ("Quaternion", 4)))
    pose = recorded(ros, NODE["pose_of"](step, ros.make("geometry_msgs/msg/Pose", place, turn)))
    assert (pose.position.x, pose.position.y, pose.position.z) == step.point
    told = pose.orientation
    hand = Rotation.from_quat([told.x, told.y, told.z, told.w]).as_matrix()
    np.testing.assert_allclose(hand[:, 2], step.approach, atol=1e-5)
    np.testing.assert_allclose(hand[:, 0], step.forward, atol=1e-5)

    with pytest.raises(UsageError, match="outcome: interaction: Field required"):
        loop.tell('{"outcome": {"motion": 0.2}}', 2.0)
    for _ in range(2):
        loop.tell('{"outcome": {"motion": 0.2}, "interaction": 1}', 2.0)
    assert not loop.wants(seconds(clouds[1].header.stamp)), "which was taken before the outcome"
    assert loop.wants(seconds(clouds[2].header.stamp))
    assert loop.scan(cloud_scan(clouds[2]), 2.5).tries == 1
    loop.tell('{"outcome": {"motion": 0.2}, "interaction": 1}', 8.0)
    assert loop.scan(depth_scan(depths, info, rectified=False), 9.0).tries == 1, "it is counted once"
    assert [each.cloud for each in read_history(tmp_path / "history.json").interactions] == [
        "scan-0.500000000.npz",
        "scan-9.000000000.npz",
    ]
