"""Records: an executed rollout as the collector gives it to the store, with all data for a replay."""

from dataclasses import dataclass
from enum import StrEnum

from shared.plan import ObjectRef
from shared.types import Action, Float, HiddenDynamics, Observation, Order, Outcome, Role


@dataclass(frozen=True, slots=True)
class InteractionRecord:
    """One row: enough to replay the interaction alone, and what happened.

    Attributes:
        step: number within the rollout.
        observation: index into `RolloutRecord.observations`.
        action: p and R, world frame.
        outcome: its outcome.
        normal: [3], world frame, surface normal at p.
        primitive: name of the executed primitive.
        order: whether the next interaction starts from the same state or from where this one ended.
        role: what the interaction is for.
        proposer: name of the proposer of the action.
        policy_version: the policy that it used; 0 for none.
        method: evaluation only: the method of a context or an exploit, otherwise "".
        budget: evaluation only: number of interactions before an exploit, otherwise -1.
        target_part: 1-based movable part that p lies on.
        target_link: its link's name in the URDF.
        target_joint: its joint's name in the URDF.
        joint_names: of all movable joints in the URDF, in part order.
        joint_positions: theirs at the start.
        joint_limits: [parts, 2], the limits that were used (the direction modes change them).
        joint_twist: [6], hidden: (w, v) of the target joint at the start, world frame. A point p of the part starts to
            move by w x p + v a unit of joint position, so w is a hinge's signed axis, and v a slide's.
        hand_start: [7], world pose of the hand frame at the start, xyz then quaternion wxyz.
        seconds: wall time; not part of the content digest.
    """

    step: int
    observation: int
    action: Action
    outcome: Outcome
    normal: Float
    primitive: str
    order: Order
    role: Role
    proposer: str
    policy_version: int
    method: str
    budget: int
    target_part: int
    target_link: str
    target_joint: str
    joint_names: tuple[str, ...]
    joint_positions: Float
    joint_limits: Float
    joint_twist: Float
    hand_start: Float
    seconds: float


class RolloutStatus(StrEnum):
    """Whether a rollout was executed, and if not, why."""

    OK = "ok"
    NOTHING_TO_ACT_ON = "nothing-to-act-on"
    """No draw of a camera and a state came to rest and showed a part that the task may act on."""
    NEVER_AT_REST = "never-at-rest"
    """No draw came to rest at all, so that none could be looked at: parts push each other, say."""
    QUARANTINED = "quarantined"
    """Its execution crashed, hung or failed again and again; the shard's manifest says how. Never a label."""


@dataclass(frozen=True, slots=True)
class RolloutRecord:
    """One object, one draw of hidden dynamics, one camera, and a sequence of interactions.

    Attributes:
        index: number within the plan.
        plan_key: the plan.
        object: which object.
        dynamics: the hidden draw.
        azimuth_deg: of the camera.
        elevation_deg: of the camera.
        seed: the plan's seed, from which all of the rollout was drawn.
        fidelity: name of the fidelity preset.
        status: whether it was executed; there are neither observations nor interactions if not.
        observations: each one once, for any number of actions.
        interactions: in the order they were executed.
        arm_base: [4], x, y, z and yaw, world frame, of the base of the arm; empty: the hand flies.
    """

    index: int
    plan_key: str
    object: ObjectRef
    dynamics: HiddenDynamics
    azimuth_deg: float
    elevation_deg: float
    seed: int
    fidelity: str
    status: RolloutStatus
    observations: tuple[Observation, ...]
    interactions: tuple[InteractionRecord, ...]
    arm_base: tuple[float, ...] = ()
