"""The vocabulary: what crosses a boundary between the collector, the store, the learner and a robot.

One loop serves collection, evaluation and a real robot:

    observation = environment.observe()
    action = proposer.propose(observation, history)      # None: the proposer has seen enough
    outcome = environment.execute(action)
    history.append(Interaction(observation, action, outcome))

Frames. *World*: the object's root link at the origin, z up, SI units. *Camera*: x forward, y left, z up, at the
camera's centre. *View*: the world turned about z until the camera looks along +x (see `shared.geometry`);
networks see this frame.

Shapes: N points of a cloud.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.hidden import ALWAYS_DRAWN

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

MAX_GRASP_WIDTH = 0.5
"""Metres; no hand opens further."""
NORMAL_STEPS = 127
"""Normals are kept as three signed bytes of 1/127, within half a degree; points as float16, about 0.5 mm at 1 unit."""


class OutcomeKind(StrEnum):
    """How a trial ended. Every kind but `ABANDONED` is an outcome of physics and so a label."""

    OK = "ok"
    """The primitive ran to its end; `Outcome.success` says whether it moved the part as intended."""
    NO_CONTACT = "no-contact"
    """It ran to its end and touched nothing."""
    NO_GRASP = "no-grasp"
    """The closed hand holds nothing: its fingers are together open by at most 0.01, or its suction cup did not seal."""
    START_COLLISION = "start-collision"
    """The hand was in collision at the very first step."""
    WRONG_PART = "wrong-part"
    """Under the first-contact rule: a finger first touched a part other than the target."""
    HAND_CONTACT = "hand-contact"
    """Under the first-contact rule: the palm touched anything before or at the first contact."""
    UNSTABLE = "unstable"
    """The simulation diverged (not a number, or a joint far outside its limits)."""
    UNREACHABLE = "unreachable"
    """The arm cannot carry the hand along the primitive, so nothing was executed."""
    UNKNOWN = "unknown"
    """Nobody said how it ended, as a robot's history may leave it; no simulator gives this."""
    ABANDONED = "abandoned"
    """Infrastructure failed (a crash, a hang); says nothing of the action and is never a label."""

    @property
    def is_label(self) -> bool:
        """Whether a learner may use the row."""
        return self is not OutcomeKind.ABANDONED

    @property
    def was_executed(self) -> bool:
        """Whether the trial was simulated, so that it can be again."""
        return self not in (OutcomeKind.ABANDONED, OutcomeKind.UNREACHABLE)

    @property
    def is_valid(self) -> bool:
        """Whether the primitive ran to its end: what the hand closed on was held, and no contact was refused."""
        return self in (OutcomeKind.OK, OutcomeKind.NO_CONTACT)


class Direction(StrEnum):
    """In which directions a joint can turn from its start position; hidden (the task "pushing faucet" of the paper)."""

    AS_BUILT = "as-built"
    """The joint's own limits."""
    BOTH = "both"
    CLOCKWISE = "clockwise"
    COUNTER_CLOCKWISE = "counter-clockwise"


class Order(StrEnum):
    """How the interactions of a rollout follow each other."""

    RESTART = "restart"
    """Several actions are executed from one observed state, which is restored before each."""
    CONTINUE = "continue"
    """Each interaction starts where the last one left the object (the paper's test time)."""


class Role(StrEnum):
    """What an interaction is for."""

    COLLECT = "collect"
    """Training data."""
    QUERY = "query"
    """A random test interaction whose success critics predict (F-score)."""
    CONTEXT = "context"
    """A test-time interaction, part of the set I."""
    EXPLOIT = "exploit"
    """The final action of a method, in the state that its interactions left (sample-success)."""
    EXPLOIT_AT_START = "exploit-at-start"
    """The final action in the start state, which is the same for all methods (start-success)."""
    CONTEXT_BY_SHARE = "context-by-share"
    """An interaction whose point was drawn from the best share of the cloud instead of being the best of all."""
    EXPLOIT_BY_SHARE = "exploit-by-share"
    """The final action in the start state, at a point drawn from the best share of the cloud."""
    REPEAT_AT_START = "repeat-at-start"
    """The final action in the start state, near an interaction that succeeded, and turned as that was."""


@dataclass(frozen=True, slots=True, init=False)
class HiddenDynamics:
    """Hidden dynamics, drawn once for each rollout and applied to every movable part.

    Example:
        dynamics = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=1.0)
        dynamics["part_mass"]

    Attributes:
        values: numbers by the names of their parameters (see `shared.hidden`).
        direction: which ways joints turn.
    """

    values: Mapping[str, float]
    direction: Direction

    def __init__(
        self, values: Mapping[str, float] | None = None, direction: Direction = Direction.AS_BUILT, **named: float
    ) -> None:
        object.__setattr__(self, "values", {**(values or {}), **named})
        object.__setattr__(self, "direction", direction)

    def __getitem__(self, name: str) -> float:
        """The number of one parameter."""
        return self.values[name]

    @property
    def added(self) -> tuple[str, ...]:
        """The parameters that not every store has, in order of name."""
        return tuple(sorted(self.values.keys() - ALWAYS_DRAWN.keys()))


class DenseGeometry(Protocol):
    """The surface of an object at a finer resolution than the points of its cloud."""

    def points(self) -> Float32:
        """The surface at the full resolution of its sensor, [M, 3], world frame."""
        ...


class Reach(Protocol):
    """What the arm in front of an object can do."""

    def trajectory(self, action: "Action") -> Float | None:
        """Joint positions, [W, J], rad or m, that execute an action; None if there are none."""
        ...


@dataclass(frozen=True, slots=True)
class Observation:
    """A partial cloud of one object from one camera, in furthest-point order: any prefix covers the object.

    Points and normals are rounded to what the store keeps (`round_points`, `round_normals`), so that a proposer sees
    exactly what a learner will.
    """

    points: Float32
    """[N, 3], world frame, exactly representable in float16."""
    normals: Float32
    """[N, 3], world frame, unit length up to rounding, facing the camera."""
    part_ids: NDArray[np.uint8]
    """[N], 0 for the static body, k for the k-th movable part (1-based)."""
    movable: NDArray[np.bool_]
    """[N], whether the point is on the part that is to be moved; a rollout is about one part."""
    pixels: NDArray[np.uint32]
    """[N], row * image width + column of the ray that hit the point."""
    world_from_camera: Float
    """[4, 4], rigid."""
    dense: DenseGeometry | None = None
    """The whole of what the sensor measured, where it was kept: `collection.camera.keep_depth`, or a robot's scan."""
    reach: Reach | None = None
    """The arm that will execute the action, where the proposer is to know it; it then proposes what the arm reaches."""


def round_points(points: Float | Float32) -> Float32:
    """Points, [..., 3], rounded to float16."""
    return points.astype(np.float16).astype(np.float32)


def round_normals(normals: Float | Float32) -> Float32:
    """Unit normals, [..., 3], with each component at the nearest multiple of 1/127."""
    return unpack_normals(pack_normals(normals))


def pack_normals(normals: Float | Float32) -> NDArray[np.int8]:
    """Unit normals, [..., 3], as signed bytes."""
    packed: NDArray[np.int8] = np.rint(np.clip(normals, -1.0, 1.0) * NORMAL_STEPS).astype(np.int8)
    return packed


def unpack_normals(packed: NDArray[np.int8]) -> Float32:
    """The normals, [..., 3], that `pack_normals` kept."""
    return packed.astype(np.float32) / np.float32(NORMAL_STEPS)


@dataclass(frozen=True, slots=True)
class Action:
    """u = (p, R): the interaction point and the gripper orientation."""

    point_index: int
    """Index of p in the observation's cloud."""
    point: Float
    """p, [3], world frame."""
    rotation: Float
    """R, [3, 3], world frame; columns forward, left, up, where *up* is the approach direction."""

    @property
    def approach(self) -> Float:
        """Approach direction d, [3], world frame."""
        return self.rotation[:, 2]

    @property
    def forward(self) -> Float:
        """Forward direction, [3], world frame."""
        return self.rotation[:, 0]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of an action: m, r, and how it ended. A robot only needs to fill the first three fields.

    NaN stands for what was not measured.
    """

    kind: OutcomeKind
    motion: float
    """m, how far the target joint moved: rad or length, never negative; 0 for a trial that was not valid."""
    success: bool
    """r, by the success rule of the primitive."""
    start_joint_position: float = float("nan")
    end_joint_position: float = float("nan")
    displacement: Float = field(default_factory=lambda: np.full(3, np.nan))
    """[3], world frame, of the touched point of the target part."""
    grasp_opening: float = float("nan")
    """How far both fingers together stayed open when they had closed, m, of primitives that close them; else NaN. Of a
    suction cup its diameter where it sealed, and 0 where it did not."""
    steps: int = 0
    """Physics steps simulated."""


@dataclass(frozen=True, slots=True)
class Interaction:
    """I = (O, p, R, m): an observation, an action and its outcome."""

    observation: Observation
    action: Action
    outcome: Outcome


class Environment(Protocol):
    """An object that can be observed and acted on: in SAPIEN, or in front of a real robot."""

    def observe(self) -> Observation:
        """Observe the object in its present state."""
        ...

    def execute(self, action: Action) -> Outcome:
        """Execute the action at one of the points of the last observation, and change the state of the object.

        A physical failure is an outcome, not an exception.
        """
        ...


class Proposer(Protocol):
    """Chooses the next action u = (p, R), such as AIP (AdaAfford, Next-step Interaction Action Proposal)."""

    @property
    def name(self) -> str:
        """Its name in rows of a store: "random", "aip", ..."""
        ...

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next action, or None to stop.

        Args:
            observation: of the present state.
            history: the interactions with this object so far, in their order.

        Raises:
            UsageError: the observation has no movable point, or lacks what the proposer needs.
        """
        ...
