"""Catches and latches: what holds a joint where it is closed, until it is pulled hard enough or its handle is moved.

What a mechanism does depends on the joint positions alone, which are the whole state of an object: so it needs no state
to be stored, restored or replayed. A part is closed at the lower limit of its joint, as objects are made.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from collector.objects.articulation import ArticulatedObject
from collector.sim.engine import physx
from shared.types import Float

FRICTION_DAMPING = 1e5
"""Damping of the force-limited drive that stands for Coulomb friction: below its limit a joint creeps by at most
limit / damping a second."""
HANDLE_WORDS = ("handle", "button", "knob", "lever")
"""A part with one of these in its semantic name works the latch of a part that has none."""
CLOSED_RANGE = 1e-3
"""rad or length: a joint nearer to its closed position is held there."""
CATCH_STIFFNESS, CATCH_DAMPING = 1e7, 1e5
"""Of the force-limited drive that stands for a catch: it gives by 1e-7 for each N m or N until it lets go. In a trial a
force grows by 3.3 N a step at most, so that a held joint counts as one at rest, as the end of a hold asks for."""
LOCK = (1e9, 1e7, 1e8)
"""Stiffness, damping and force limit of a locked joint: 100 N m or N move it by 1e-7."""
RETURN_FORCE = 0.5
"""N m or N: what returns a handle of a latch to its lower limit; twice as much at its upper limit."""
RETURN_TIME = 0.1
"""s, time constant of that return."""
AJAR, AJAR_SPEED, AJAR_FORCE = 0.06, 0.1, 2.0
"""A released latch moves its part this far open, in rad or length, at this speed a second, with this much force beyond
what friction and catch take."""


def handles_of(target: ArticulatedObject) -> Mapping[int, tuple[int, ...]]:
    """The handles of each part that has any: of those mounted on it, and of those on the body that are nearest to it.

    Parts are 1-based.
    """
    bodies = target.bodies
    handles = [k for k in range(1, len(bodies)) if any(word in bodies[k].part_name for word in HANDLE_WORDS)]
    doors = [k for k in range(1, len(bodies)) if k not in handles]
    if not doors or not handles:
        return {}
    poses = target.body_poses(target.limits()[:, 0])
    middles = {k: _middle(target, k, poses[k]) for k in (*doors, *handles)}
    found: dict[int, tuple[int, ...]] = {}
    for handle in handles:
        carrier = handle
        while carrier in handles:
            joint = bodies[carrier].joint
            carrier = joint.parent if joint is not None else 0
        if carrier == 0:
            carrier = min(doors, key=lambda door: float(np.linalg.norm(middles[door] - middles[handle])))
        found[carrier] = (*found.get(carrier, ()), handle)
    return found


def _middle(target: ArticulatedObject, part: int, world_from_body: Float) -> Float:
    """The middle of a part's bounding box, [3], in its own axes, in the world."""
    body = target.bodies[part]
    meshes = body.visuals or body.collisions
    vertices = np.concatenate([mesh.vertices for mesh in meshes]) if meshes else np.zeros((1, 3))
    middle: Float = (
        world_from_body[:3, :3] @ ((vertices.min(axis=0) + vertices.max(axis=0)) / 2) + world_from_body[:3, 3]
    )
    return middle


class Holds:
    """What resists the motion of each joint of an object: friction anywhere; a catch and a latch where it is closed.

    Call it with the joint positions, [parts], before each step of the engine. Without a catch and a latch it need not
    be called.

    Args:
        target: the object.
        joints: of its movable parts, in part order.

    Attributes:
        friction: N m or N, of every joint.
        catch: N m or N beyond friction at which a closed joint that is no handle comes free; 0: there is no catch.
        latch_travel: share of its range that a handle must have moved for its part to come free; 1 or more: the part
            never does; 0: there is no latch.
        latch_handle: which of the handles of a part works its latch, from 0 for the first to 1 for the last.
    """

    def __init__(self, target: ArticulatedObject, joints: Sequence[physx.PhysxArticulationJoint]) -> None:
        limits = target.limits()
        self.friction = self.catch = self.latch_travel = self.latch_handle = 0.0
        self._closed, self._span = limits[:, 0], limits[:, 1] - limits[:, 0]
        self._joints = joints
        self._handles = handles_of(target)
        self._door = {handle: door for door, handles in self._handles.items() for handle in handles}
        self._driven: list[tuple[float, ...]] = [()] * len(joints)

    def judged(self, part: int) -> int:
        """The part whose motion counts when `part` is touched: where there is a latch, that of a handle is its door."""
        return self._door.get(part, part) if self.latch_travel > 0 else part

    def target_of(self, part: int) -> tuple[int, ...]:
        """The parts that are one target with `part`: where there is a latch, a door and its handles."""
        door = self.judged(part)
        return (door, *self._handles.get(door, ())) if self.latch_travel > 0 else (part,)

    def __call__(self, positions: Float) -> None:
        """Set the drive of each joint to what holds it at these positions."""
        opened = np.abs(positions - self._closed)
        for k, joint in enumerate(self._joints):
            drive = self._drive(k, opened)
            if drive != self._driven[k]:
                self._driven[k] = drive
                stiffness, damping, limit, at, speed = drive
                joint.set_drive_property(stiffness, damping, force_limit=limit)
                joint.set_drive_target(at)
                joint.set_drive_velocity_target(speed)

    def _drive(self, k: int, opened: Float) -> tuple[float, float, float, float, float]:
        """Stiffness, damping, force limit, target and speed of joint `k`, from how far each joint is open, [parts]."""
        closed, part = float(self._closed[k]), k + 1
        catch = 0.0 if part in self._door else self.catch
        if self.latch_travel > 0:
            if part in self._door and self._span[k] > 0:
                span = float(self._span[k])
                stiffness = RETURN_FORCE / span
                return stiffness, stiffness * RETURN_TIME, LOCK[2], closed - span, 0.0
            released = self._released(part, opened)
            if released is False and opened[k] < CLOSED_RANGE:
                return *LOCK, closed, 0.0
            if released and opened[k] < AJAR:
                return 0.0, FRICTION_DAMPING, self.friction + catch + AJAR_FORCE, 0.0, AJAR_SPEED
        if catch > 0 and opened[k] < CLOSED_RANGE:
            return CATCH_STIFFNESS, CATCH_DAMPING, self.friction + catch, closed, 0.0
        return 0.0, FRICTION_DAMPING, self.friction, 0.0, 0.0

    def _released(self, door: int, opened: Float) -> bool | None:
        """Whether the handle of a door is moved far enough; None: it has none, and is not locked for good."""
        if self.latch_travel >= 1:
            return None if door in self._door else False
        handles = self._handles.get(door)
        if not handles:
            return None
        handle = handles[min(int(self.latch_handle * len(handles)), len(handles) - 1)] - 1
        return bool(opened[handle] >= self.latch_travel * self._span[handle])
