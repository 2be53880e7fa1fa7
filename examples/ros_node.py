"""A node of ROS 2 around a session of `adapt`: `python examples/ros_node.py FOLDER POLICY --ros-args ...`.

It needs a shell in which ROS 2 is set up, with `adaafford` in the same Python. All files are in FOLDER.

- subscribes to `cloud` (sensor_msgs/PointCloud2), or to `depth` (sensor_msgs/Image, rectified) with `camera_info`;
  `-r cloud:=/camera/points` names the topic;
- publishes `proposal` (geometry_msgs/PoseStamped: the point, with z along the approach and x the hand's forward
  direction) and `step` (std_msgs/String: the answer of `adapt` as JSON, with `do` and the number of the interaction);
- takes `outcome` (std_msgs/String: such as `{"outcome": {"motion": 0.21}, "interaction": 1}`), and then uses the next
  scan that was taken after it arrived.

Parameters `part`, as in `adapt --part`, and `budget`. Move the arm from your own node: nothing is executed here.
"""

import sys
from pathlib import Path
from typing import Any

from pydantic import Field

from adaafford import load_policy
from adaafford.columns import Columns
from adaafford.histories import TriedOutcome, parse_json
from adaafford.ros_messages import cloud_scan, depth_scan, hand_orientation, seconds
from adaafford.scans import checked_scan, npz_of
from adaafford.sessions import Session, SessionFiles, Step
from shared.config import StrictModel
from shared.errors import AdaAffordError
from shared.io.files import write_atomically


class Told(StrictModel):
    """What a message of `outcome` says."""

    outcome: TriedOutcome
    interaction: int = Field(ge=1)


class Loop:
    """The session between messages: which scan is used, and which outcome it comes with.

    Args:
        session: with its history in `folder`.
        folder: that scans are written to.
        raw: whether scans have the surroundings of the object, because the session finds the part.
    """

    def __init__(self, session: Session, folder: Path, *, raw: bool = False) -> None:
        self._session, self._folder, self._raw = session, folder, raw
        self._told: Told | None = None
        self._after: float | None = 0.0

    def wants(self, stamp: float) -> bool:
        """Whether a scan of this time, s, is to be used."""
        return self._after is not None and stamp >= self._after

    def tell(self, text: str, now: float) -> None:
        """Take an outcome, at a time, s, and want a scan from then on; it is counted once, however often it is told."""
        self._told = parse_json(Told, text.encode(), "outcome: ", 'say {"outcome": {"motion": 0.2}, "interaction": 1}')
        self._after = now

    def scan(self, columns: Columns, stamp: float) -> Step:
        """The next step, from a scan (`adaafford.ros_messages`)."""
        points, normals, movable, camera, up = map(columns.get, ("points", "normals", "movable", "camera", "up"))
        scan = checked_scan(points, normals, movable, camera, "the scan", raw=self._raw, up=up)
        path = self._folder / f"scan-{stamp:.9f}.npz"
        write_atomically(path, npz_of(scan))
        told = self._told
        step = self._session.step(path, told and told.outcome, told and told.interaction)
        self._told = self._after = None
        return step


def pose_of(step: Step, message: Any) -> Any:
    """Fill a geometry_msgs/Pose with the proposal of a step."""
    for name, value in zip("xyz", step.point, strict=True):
        setattr(message.position, name, value)
    for name, value in zip("xyzw", hand_orientation(step.approach, step.forward), strict=True):
        setattr(message.orientation, name, value)
    return message


def main() -> None:
    """Spin the node."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2
    from std_msgs.msg import String

    rclpy.init(args=sys.argv)
    node = rclpy.create_node("adaafford")
    folder, policy = Path(sys.argv[1]), sys.argv[2]
    part = node.declare_parameter("part", "").value or None
    budget = node.declare_parameter("budget", 4).value
    files, log = SessionFiles(folder / "history.json", folder / "heatmap.ply"), node.get_logger()
    session = Session(load_policy(policy), files, budget, tell=log.warning, part=part)
    loop, infos = Loop(session, folder, raw=part is not None), []
    proposal = node.create_publisher(PoseStamped, "proposal", 1)
    said = node.create_publisher(String, "step", 1)

    def use(message: Any, columns_of: Any) -> None:
        stamp = seconds(message.header.stamp)
        if not loop.wants(stamp):
            return
        try:
            step = loop.scan(columns_of(message), stamp)
        except (AdaAffordError, ValueError) as error:
            log.error(str(error), throttle_duration_sec=5.0)
            return
        proposal.publish(PoseStamped(header=message.header, pose=pose_of(step, PoseStamped().pose)))
        said.publish(String(data=step.model_dump_json()))

    def use_depth(message: Any) -> None:
        if infos:
            use(message, lambda image: depth_scan(image, infos[-1], rectified=True))

    def hear(message: Any) -> None:
        try:
            loop.tell(message.data, node.get_clock().now().nanoseconds * 1e-9)
        except AdaAffordError as error:
            log.error(str(error))

    node.create_subscription(PointCloud2, "cloud", lambda cloud: use(cloud, cloud_scan), qos_profile_sensor_data)
    node.create_subscription(Image, "depth", use_depth, qos_profile_sensor_data)
    node.create_subscription(CameraInfo, "camera_info", lambda info: infos.__setitem__(slice(None), [info]), 1)
    node.create_subscription(String, "outcome", hear, 10)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
