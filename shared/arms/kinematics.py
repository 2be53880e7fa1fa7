"""Forward and inverse kinematics of an arm, and whether it can carry the hand along a whole primitive.

A path is to be clear of the floor and of the object: the links of the arm are spheres, the object is points of its
surface, and the floor is a plane. The hand is left out, because it has to touch the object.

Numba compiles the loops, since one check of reach takes some thousand small steps. (Pinocchio's wheels bring fourteen
packages for one chain of joints, and clash with the Pinocchio that a ROS installation has on its path.)

Shapes: J joints, W waypoints, S spheres. Everything is in the frame of the arm's base.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from shared.arms.arm import Arm, Capsule, pose_of
from shared.compilation import compiled
from shared.geometry import gripper_rotation, rotation_about_z
from shared.primitives import START_DISTANCE, PrimitiveSpec
from shared.types import Action, Float, Observation

TOLERANCE_M, TOLERANCE_RAD = 2e-4, 2e-3
"""Of the pose of the hand at each waypoint."""
MAX_JOINT_STEP = 0.35
"""rad or m, between two waypoints: more is a jump to another branch of solutions."""
START_ITERATIONS, NEXT_ITERATIONS = 40, 12
TABLE, SEEDS = 4096, 32
"""Random joint positions whose hands are known; a search begins from those nearest to its start pose, one by one."""
METRES_PER_RAD = 0.3
"""How far away a turned hand counts in that table."""


class Chain:
    """An arm, ready to compute with.

    Attributes:
        arm: the same.
        lower, upper: [J], rad or m.
        length: m; the hand is never further than this from the first joint.
        links: [S], the link of each sphere: 0 the base, k what the k-th joint moves.
        centres, radii: [S, 3] and [S], spheres along the capsules, in the frames of their links.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.lower, self.upper = map(np.array, arm.limits)
        self._slides = np.array([joint.kind == "prismatic" for joint in arm.joints])
        # Frames are turned so that each joint moves about or along its own z.
        turns = [np.eye(3), *(_z_to(np.array(joint.axis)) for joint in arm.joints)]
        fixed = [pose_of(joint.xyz, joint.rpy) for joint in arm.joints] + [pose_of(arm.hand_xyz, arm.hand_rpy)]
        self._fixed = np.stack(fixed)
        for number, pose in enumerate(self._fixed):
            pose[:3] = turns[number].T @ pose[:3]
            if number < len(arm.joints):
                pose[:3, :3] = pose[:3, :3] @ turns[number + 1]
        self.first = self._fixed[0, :3, 3].copy()
        slack = np.abs(np.stack([self.lower, self.upper])).max(axis=0)[self._slides].sum()
        self.length = float(np.linalg.norm(self._fixed[1:, :3, 3], axis=1).sum() + slack)
        spheres = [
            (capsule.link, turns[capsule.link].T @ centre, capsule.radius)
            for capsule in arm.capsules
            for centre in np.linspace(capsule.start, capsule.end, _spheres_of(capsule))
        ]
        self.links = np.array([link for link, _, _ in spheres], dtype=np.int64)
        self.centres = np.array([centre for _, centre, _ in spheres]).reshape(-1, 3)
        self.radii = np.array([radius for _, _, radius in spheres])
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        self._known = np.random.default_rng(0).uniform(low, high, (TABLE, len(low)))
        self._features = _features(self.hands(self._known))
        self._lengths = (self._features**2).sum(axis=1)

    def frames(self, positions: Float) -> Float:
        """The frames of the base, of each link and of the hand, [W, J + 2, 4, 4], at joint positions [W, J]."""
        found = np.empty((len(positions), len(self.lower) + 2, 4, 4))
        found[:, 0] = np.eye(4)
        for number, at in enumerate(np.ascontiguousarray(positions, dtype=np.float64)):
            _forward(self._fixed, self._slides, at, found[number, 1:])
        return found

    def hands(self, positions: Float) -> Float:
        """Poses of the hand, [W, 4, 4], at joint positions [W, J]."""
        return self.frames(positions)[:, -1]

    def spheres(self, positions: Float) -> Float:
        """Centres of the spheres, [W, S, 3], at joint positions [W, J]."""
        frames = self.frames(positions)[:, self.links]
        placed: Float = np.einsum("wsij,sj->wsi", frames[..., :3, :3], self.centres) + frames[..., :3, 3]
        return placed

    def seeds(self, hand: Float) -> Float:
        """Joint positions, [SEEDS, J], whose hands are near to a pose [4, 4], the nearest first."""
        # Squared distances, less what is the same for all.
        away = self._lengths - 2 * (self._features @ _features(hand[None])[0])
        nearest = np.argpartition(away, SEEDS)[:SEEDS]
        return self._known[nearest[np.lexsort((nearest, away[nearest]))]]

    def follow(self, hands: Float, seed: Float) -> Float | None:
        """Joint positions, [W, J], that bring the hand to the poses [W, 4, 4] one after the other.

        Args:
            hands: the poses.
            seed: [J], where the search for the first one begins.

        Returns:
            None if there is none near the seed: within the limits, without a jump between two waypoints.
        """
        path = np.empty((len(hands), len(seed)))
        there = _follow(self._fixed, self._slides, self.lower, self.upper, np.ascontiguousarray(hands), seed, path)
        return path if there else None


@lru_cache(maxsize=8)
def chain_of(arm: Arm) -> Chain:
    """The chain of an arm, made once."""
    return Chain(arm)


def _spheres_of(capsule: Capsule) -> int:
    """How many spheres stand for a capsule: one every radius, at most 64."""
    return min(int(np.ceil(np.linalg.norm(np.subtract(capsule.end, capsule.start)) / capsule.radius)) + 1, 64)


def _features(hands: Float) -> Float:
    """Poses [W, 4, 4] as [W, 12], so that their distance counts both place and rotation."""
    turned = METRES_PER_RAD / np.sqrt(2) * hands[:, :3, :3].reshape(-1, 9)
    return np.concatenate([hands[:, :3, 3], turned], axis=1)


def _z_to(axis: Float) -> Float:
    """A rotation, [3, 3], that turns z to an axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[1 if abs(z[1]) < 0.9 else 0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


@compiled()
def _forward(fixed: Float, slides: Float, q: Float, frames: Float) -> None:
    """Write the frames of the links and of the hand, [J + 1, 4, 4]."""
    count = len(q)
    for k in range(count + 1):
        for i in range(3):
            for j in range(4):
                if k == 0:
                    frames[k, i, j] = fixed[k, i, j]
                else:
                    total = frames[k - 1, i, 3] if j == 3 else 0.0
                    for m in range(3):
                        total += frames[k - 1, i, m] * fixed[k, m, j]
                    frames[k, i, j] = total
            if k == count:
                continue
            if slides[k]:
                frames[k, i, 3] += q[k] * frames[k, i, 2]
            else:
                sine, cosine = np.sin(q[k]), np.cos(q[k])
                x, y = frames[k, i, 0], frames[k, i, 1]
                frames[k, i, 0] = cosine * x + sine * y
                frames[k, i, 1] = cosine * y - sine * x
        frames[k, 3, 0] = frames[k, 3, 1] = frames[k, 3, 2] = 0.0
        frames[k, 3, 3] = 1.0


@compiled()
def _error(hand: Float, target: Float, error: Float) -> None:
    """Write what is missing from the hand to its target, [6]: m, then the rotation vector."""
    turn = np.empty((3, 3))
    for i in range(3):
        error[i] = target[i, 3] - hand[i, 3]
        for j in range(3):
            turn[i, j] = target[i, 0] * hand[j, 0] + target[i, 1] * hand[j, 1] + target[i, 2] * hand[j, 2]
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    scale = 0.5 if sine < 1e-9 else angle / sine
    error[3], error[4], error[5] = scale * x, scale * y, scale * z


@compiled()
def _approach(
    fixed: Float, slides: Float, lower: Float, upper: Float, target: Float, q: Float, frames: Float, most: int
) -> bool:
    """Move `q` until the hand is at its target (Levenberg-Marquardt; damping as Sugihara, T-RO 2011)."""
    count = len(q)
    jacobian, normal, step, error = np.empty((6, count)), np.empty((count, count)), np.empty(count), np.empty(6)
    for turn in range(most + 1):
        _forward(fixed, slides, q, frames)
        _error(frames[count], target, error)
        away = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
        turned = np.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
        if away < TOLERANCE_M and turned < TOLERANCE_RAD:
            return True
        if turn == most:
            return False
        for k in range(count):
            a, b, c = frames[k, 0, 2], frames[k, 1, 2], frames[k, 2, 2]
            if slides[k]:
                jacobian[0, k], jacobian[1, k], jacobian[2, k] = a, b, c
                jacobian[3, k] = jacobian[4, k] = jacobian[5, k] = 0.0
            else:
                x = frames[count, 0, 3] - frames[k, 0, 3]
                y = frames[count, 1, 3] - frames[k, 1, 3]
                z = frames[count, 2, 3] - frames[k, 2, 3]
                jacobian[0, k], jacobian[1, k], jacobian[2, k] = b * z - c * y, c * x - a * z, a * y - b * x
                jacobian[3, k], jacobian[4, k], jacobian[5, k] = a, b, c
        damping = 0.5 * (away**2 + turned**2) + 1e-6
        for i in range(count):
            step[i] = 0.0
            for m in range(6):
                step[i] += jacobian[m, i] * error[m]
            if (q[i] <= lower[i] and step[i] < 0.0) or (q[i] >= upper[i] and step[i] > 0.0):
                # The others have to do it without a joint that is pressed against its limit.
                step[i], jacobian[:, i] = 0.0, 0.0
            for j in range(i + 1):
                total = damping if i == j else 0.0
                for m in range(6):
                    total += jacobian[m, i] * jacobian[m, j]
                normal[i, j] = total
        # Cholesky: normal = L L^T, then two triangular solutions.
        for i in range(count):
            for j in range(i + 1):
                total = normal[i, j]
                for m in range(j):
                    total -= normal[i, m] * normal[j, m]
                normal[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / normal[j, j]
        for i in range(count):
            for m in range(i):
                step[i] -= normal[i, m] * step[m]
            step[i] /= normal[i, i]
        largest = 0.5
        for back in range(count):
            i = count - 1 - back
            for m in range(i + 1, count):
                step[i] -= normal[m, i] * step[m]
            step[i] /= normal[i, i]
            largest = max(largest, abs(step[i]))
        for i in range(count):
            q[i] = min(max(q[i] + step[i] * 0.5 / largest, lower[i]), upper[i])
    return False


@compiled()
def _follow(fixed: Float, slides: Float, lower: Float, upper: Float, targets: Float, seed: Float, path: Float) -> bool:
    """See `Chain.follow`; writes the path."""
    q, frames = seed.copy(), np.empty((len(seed) + 1, 4, 4))
    for number in range(len(targets)):
        most = START_ITERATIONS if number == 0 else NEXT_ITERATIONS
        if not _approach(fixed, slides, lower, upper, targets[number], q, frames, most):
            return False
        for k in range(len(q)):
            if number > 0 and abs(q[k] - path[number - 1, k]) > MAX_JOINT_STEP:
                return False
            path[number, k] = q[k]
    return True


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
