"""Whether an arm can carry the hand along a whole primitive, clear of the floor and of the object.

The links of the arm are spheres, the object is points of its surface, and the floor is a plane. The hand is left out,
because it has to touch the object.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.arms.arm import Arm
from shared.arms.kinematics import chain_of
from shared.geometry import gripper_rotation, rotation_about_z
from shared.primitives import START_DISTANCE, PrimitiveSpec
from shared.types import Action, Float, Observation

WAYPOINT_M, WAYPOINT_RAD = 0.02, 0.1
"""The most that the hand moves and turns between two waypoints."""
ASKED_POINTS = 64
"""Of the movable points, for a heatmap."""


def base_pose(x: float, y: float, z: float, yaw: float) -> Float:
    """world_from_base, [4, 4], of an upright arm that is turned by `yaw`, rad, about z."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about_z(yaw), (x, y, z)
    return pose


class ArmReach:
    """What an arm reaches of one object in one state; implements `shared.types.Reach`.

    Args:
        arm: the arm.
        base: x, y, z and yaw of its base, world frame, m and rad.
        primitive: what is executed.
        surface: [M, 3], world frame, points of the object. The floor is as low as the lowest of these, or as the base.
    """

    def __init__(self, arm: Arm, base: Sequence[float], primitive: PrimitiveSpec, surface: Float) -> None:
        from scipy.spatial import cKDTree  # A fifth of a worker's imports, and most collections have no arm.

        self._chain = chain_of(arm)
        self._base_from_world = np.linalg.inv(base_pose(*base))
        local = surface.astype(np.float64) @ self._base_from_world[:3, :3].T + self._base_from_world[:3, 3]
        self._floor = min(0.0, float(local[:, 2].min()))
        self._tree = cKDTree(local)
        self._legs = waypoints(primitive)
        self._found: dict[bytes, Float | None] = {}

    def hands(self, action: Action) -> Float:
        """Poses of the hand at the waypoints of an action, [W, 4, 4], in the frame of the base."""
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = action.rotation, action.point
        hands: Float = self._base_from_world @ start @ self._legs
        return hands

    def trajectory(self, action: Action) -> Float | None:
        """Joint positions, [W, J], rad or m, that execute an action; None if none was found."""
        key = action.point.tobytes() + action.rotation.tobytes()
        if key not in self._found:
            self._found[key] = self._search(self.hands(action))
        return self._found[key]

    def _search(self, hands: Float) -> Float | None:
        chain = self._chain
        if np.linalg.norm(hands[:, :3, 3] - chain.first, axis=1).max() > chain.length:
            return None
        for seed in chain.seeds(hands[0]):
            path = chain.follow(hands, seed)
            if path is not None and self._is_clear(path):
                return path
        return None

    def _is_clear(self, path: Float) -> bool:
        """Whether no link touches the floor or the object; the base stands on the floor."""
        chain = self._chain
        centres = chain.spheres(path)
        if (centres[:, :, 2] - chain.radii < self._floor)[:, chain.links > 0].any():
            return False
        most = chain.radii.max(initial=0.0)
        nearest = np.asarray(self._tree.query(centres.reshape(-1, 3), distance_upper_bound=most)[0])
        return bool((nearest.reshape(centres.shape[:2]) >= chain.radii).all())


def reachable_points(observation: Observation) -> NDArray[np.bool_]:
    """Which movable points the arm of an observation reaches, straight against the surface, [N].

    A few points are asked, spread over the cloud; the others are as the nearest of these.
    """
    from scipy.spatial import cKDTree

    assert observation.reach is not None, "the observation knows an arm"
    asked = np.flatnonzero(observation.movable)[:ASKED_POINTS]
    reached = []
    for index in asked:
        point, inward = observation.points[index].astype(np.float64), -observation.normals[index].astype(np.float64)
        inward /= np.linalg.norm(inward)
        aside, up = np.eye(3)[np.argsort(np.abs(inward))[:2]]
        actions = (Action(int(index), point, gripper_rotation(inward, roll)) for roll in (aside, up))
        reached.append(any(observation.reach.trajectory(action) is not None for action in actions))
    nearest = np.asarray(cKDTree(observation.points[asked]).query(observation.points)[1])
    found: NDArray[np.bool_] = np.array(reached)[nearest] & observation.movable
    return found


def waypoints(primitive: PrimitiveSpec) -> Float:
    """Poses of the hand along a primitive, [W, 4, 4], in the start frame (see `shared.primitives`)."""
    at, turned = np.array([0.0, 0.0, -START_DISTANCE]), 0.0
    poses = [_turned(at, turned)]
    for leg in filter(None, (primitive.approach, primitive.then)):
        end = np.array(leg.end)
        steps = max(float(np.linalg.norm(end - at)) / WAYPOINT_M, abs(leg.turn_rad - turned) / WAYPOINT_RAD)
        shares = np.linspace(0.0, 1.0, max(int(np.ceil(steps - 1e-9)), 1) + 1)[1:]
        poses += [_turned(at + share * (end - at), turned + share * (leg.turn_rad - turned)) for share in shares]
        at, turned = end, leg.turn_rad
    return np.stack(poses)


def _turned(place: Float, turn_rad: float) -> Float:
    """A pose at a place, turned about z, [4, 4]."""
    x, y, z = place
    return base_pose(x, y, z, turn_rad)
