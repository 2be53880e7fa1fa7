"""Plans: pure functions from configuration and seed to numbered rollouts; and the records of executed rollouts.

A *setting* fixes everything that makes rows comparable; a store holds one. A *plan* adds the proposer. A *job* is a
range of a plan's rollouts and makes one *shard*. Nothing here depends on workers or on time.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import FailFast, Field, model_validator

from shared.arms.arm import ARMS, Arm
from shared.config import CollectionConfig, DynamicsRanges, StrictModel
from shared.extensions import Registry
from shared.policies.methods import BASELINES, METHODS, PROPOSERS, RANDOM, MethodName
from shared.tasks import TASKS, Task, Terms, task_named
from shared.types import Action, Float, HiddenDynamics, Observation, Order, Outcome, Role


class ObjectRef(StrictModel):
    """One object, by its identity and by the hash of the files that define it."""

    id: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")
    category: str
    content_hash: str = Field(pattern=r"^[0-9a-f]{64}$")

    @property
    def identity(self) -> tuple[str, str, str]:
        """Its identity in rows, without fields that newer software may have added."""
        return self.id, self.category, self.content_hash


def parse_plan_key(key: str) -> tuple[str, int]:
    """Proposer and policy version of a plan, by its key."""
    proposer, _, version = key.rpartition("-v")
    return proposer, int(version)


ROLLOUTS_PER_SHARD = 8
"""The default: some seconds of work, which a kill can cost at most; the commit takes a few percent of them."""
Budget = Annotated[int, Field(ge=1, le=64)]
"""A number of interactions."""


class EvaluationConfig(StrictModel):
    """Methods and budgets of an evaluation, and the number of queries."""

    methods: tuple[MethodName, ...] = ("where2act", "ours-random", "ours-final")
    budgets: tuple[Budget, ...] = Field((1, 2, 4), min_length=1)
    queries: int = Field(24, ge=1)
    """Random test interactions of each rollout, whose success the critics predict (F-score)."""
    exploit_share: float | None = Field(None, gt=0, le=1, exclude_if=lambda share: share is None)
    """Each method also acts from the start state at a point drawn from this share of the cloud, the best points; AIP
    draws its points in the same way. As published: 0.01. None: not done; documents leave it out."""
    repeats: bool = Field(False, exclude_if=lambda repeats: not repeats)
    """Each method with interactions also repeats one that succeeded, from the start state, or acts as by
    `exploit_share` where none did (see `shared.policies.proposers.RepeatProposer`)."""


class Setting(StrictModel):
    """What all rows of one store have in common."""

    kind: Literal["collection", "evaluation"] = "collection"
    task: str
    task_definition: Task | None = Field(None, exclude_if=lambda task: task is None)
    """The task itself where a file defined it, so that a store says all that was decided; None: found by its name."""
    arm_definition: Arm | None = Field(None, exclude_if=lambda arm: arm is None)
    """The arm itself where a file defined it, likewise."""
    seed: int = Field(ge=0)
    objects: Annotated[tuple[ObjectRef, ...], FailFast(), Field(min_length=1)]
    collection: CollectionConfig
    evaluation: EvaluationConfig | None = None
    extensions: tuple[str, ...] = Field((), exclude_if=lambda added: not added)
    """What other packages add of what the setting uses, such as "primitive twist: my-package 1.2"; documents leave it
    out where there is nothing (see `shared.extensions.added_by_packages`)."""

    @model_validator(mode="after")
    def _one_task(self) -> "Setting":
        if self.task_definition is not None and self.task_definition.name != self.task:
            raise ValueError(f"the task is '{self.task}', but '{self.task_definition.name}' is defined")
        return self

    @property
    def task_record(self) -> Task:
        """The task.

        Raises:
            UsageError: there is no such task; the package that adds it may not be installed.
        """
        return self.task_definition or task_named(self.task)

    @property
    def arm(self) -> Arm | None:
        """The arm that carries the hand; None: the hand flies.

        Raises:
            UsageError: there is no such arm; the package that adds it may not be installed.
        """
        name = self.collection.arm
        return self.arm_definition or (None if name is None else ARMS.get(name))

    @property
    def identities(self) -> frozenset[tuple[str, str, str]]:
        """Of all objects."""
        return frozenset(ref.identity for ref in self.objects)

    @property
    def dynamics(self) -> DynamicsRanges:
        """Ranges of the hidden parameters: the setting's, or those of its task."""
        return self.collection.dynamics or self.terms.dynamics

    @property
    def primitive(self) -> str:
        """What interactions execute; the task is looked up as for `dynamics`."""
        return self.collection.primitive or self.terms.primitive

    @property
    def terms(self) -> Terms:
        """The terms of `collection`, completed by the task.

        Raises:
            UsageError: there is no such task.
        """
        return self.task_record.terms(self.collection)


def found_by_name(task: Task, evaluation: EvaluationConfig | None) -> list[tuple[Registry[Any], str]]:
    """The task, methods, proposers and baselines that a setting uses, each with the registry that knows it."""
    used: list[tuple[Registry[Any], str]] = [(TASKS, task.name)] if task.name in TASKS.names() else []
    for name in () if evaluation is None else evaluation.methods:
        method = METHODS.get(name)
        used.append((METHODS, name))
        used += [(PROPOSERS, method.tries)] if method.tries is not None and method.tries != RANDOM else []
        used += [(BASELINES, method.critic)] if method.critic in BASELINES.names() else []
    return list(dict.fromkeys(used))


class Plan(StrictModel):
    """A setting with a proposer and a policy version."""

    setting: Setting
    proposer: str = Field("random", pattern=r"^[a-z][a-z0-9-]{0,30}$")
    policy_version: int = Field(0, ge=0)
    """The policy that the proposer uses; 0 is no policy at all."""

    @property
    def key(self) -> str:
        """Name of the plan within its store, such as "random-v0"."""
        return f"{self.proposer}-v{self.policy_version}"

    @property
    def most_tries(self) -> int:
        """How many interactions a policy may propose in one rollout."""
        evaluation = self.setting.evaluation
        return max(evaluation.budgets) if evaluation is not None else self.setting.collection.rollout.context


@dataclass(frozen=True, slots=True)
class Job:
    """Rollouts `start` (included) to `stop` (not included) of a plan."""

    plan_key: str
    start: int
    stop: int

    @property
    def shard_id(self) -> str:
        """The shard that the job makes."""
        return f"{self.plan_key}-{self.start:08d}-{self.stop:08d}"


def missing_ranges(rollouts: int, done: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Half-open ranges of [0, `rollouts`) that no range in `done` covers, ascending; ranges in `done` may overlap."""
    gaps, start = [], 0
    for low, high in sorted(done):
        gaps.append((start, min(low, rollouts)))
        start = max(start, high)
    return [(begin, stop) for begin, stop in [*gaps, (start, rollouts)] if begin < stop]


def covered(ranges: Iterable[tuple[int, int]]) -> int:
    """How many numbers are in some half-open ranges, which may overlap."""
    count = end = 0
    for low, high in sorted(ranges):
        count += max(high - max(low, end), 0)
        end = max(end, high)
    return count


def missing_jobs(plan_key: str, rollouts: int, done: list[tuple[int, int]], per_shard: int) -> list[Job]:
    """Jobs for the rollouts in [0, `rollouts`) that no committed range in `done` covers.

    Args:
        plan_key: the plan.
        rollouts: how many there should be in total.
        done: committed half-open ranges.
        per_shard: the most rollouts that one job may hold.
    """
    return [
        Job(plan_key, first, min(first + per_shard, stop))
        for begin, stop in missing_ranges(rollouts, done)
        for first in range(begin, stop, per_shard)
    ]


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
