"""Rollouts: one object, one draw of hidden dynamics, one camera, and a sequence of interactions that are recorded.

A rollout is a pure function of its plan and its number: object, hidden dynamics, camera, states and actions are drawn
from seeds that are derived from these. So it is the same for every worker and at any time.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from collector.method_trials import ProposerFactory, evaluate
from collector.objects.articulation import ArticulatedObject, surface_at
from collector.random_proposer import RandomProposer
from collector.sim.armed import ArmedEnvironment
from collector.sim.simulator import SIMULATORS, SimEnvironment, StageClock
from shared import seeds
from shared.config import DynamicsRanges, Range
from shared.geometry import camera_pose, quaternion_from_rotation
from shared.hidden import ALWAYS_DRAWN
from shared.plan import InteractionRecord, ObjectRef, Plan, RolloutRecord, RolloutStatus
from shared.primitives import hand_start
from shared.tasks import Task
from shared.types import (
    Action,
    Float,
    HiddenDynamics,
    Interaction,
    Observation,
    Order,
    Outcome,
    OutcomeKind,
    Proposer,
    Role,
)

TRIES = 8
"""Draws of a camera and a state before a rollout is given up as showing nothing that could be acted upon."""
ARM_DISTANCE, ARM_ASIDE, ARM_TURN = (0.3, 0.6), 0.3, 0.2
"""Of the base of an arm: how far before the object's front, and aside of its middle, m, and turned off it, rad."""


def run_rollout(
    plan: Plan, index: int, target: ArticulatedObject, make_proposer: ProposerFactory, clock: StageClock
) -> RolloutRecord:
    """Execute one rollout of a plan.

    Args:
        plan: the plan.
        index: number of the rollout.
        target: the object that `object_of` gives.
        make_proposer: makes the proposers of the plan.
        clock: sums wall time by stage.
    """
    start, base = begin(plan, index, target, clock), draw_arm_base(plan, index, target)
    if isinstance(start, RolloutStatus):
        return _record(plan, draw_rollout(plan, index, TRIES - 1), start, None, base)
    recorder = Recorder(start.environment, plan.policy_version, clock)
    if plan.setting.kind == "evaluation":
        evaluate(plan, index, recorder, make_proposer)
    else:
        collect(plan, index, recorder, start.states, make_proposer)
    return _record(plan, start.draw, RolloutStatus.OK, recorder, base)


def quarantined_rollout(plan: Plan, index: int) -> RolloutRecord:
    """The record of a quarantined rollout, which has only its draw."""
    return _record(plan, draw_rollout(plan, index), RolloutStatus.QUARANTINED, None)


@dataclass(frozen=True, slots=True)
class Draw:
    """The draw of one rollout: object, hidden dynamics and camera."""

    index: int
    object: ObjectRef
    dynamics: HiddenDynamics
    azimuth_deg: float
    elevation_deg: float


def draw_rollout(plan: Plan, index: int, attempt: int = 0) -> Draw:
    """The draw of rollout `index`; a further `attempt` draws another camera only."""
    setting = plan.setting
    ranges = setting.dynamics
    rng = seeds.generator(setting.seed, f"dynamics/{plan.key}", index)
    dynamics = draw_dynamics(ranges, setting.task_record, rng)
    for name in ranges.added:
        # A separate generator, so that the other draws do not depend on it.
        rng = seeds.generator(setting.seed, f"dynamics/{name}/{plan.key}", index)
        dynamics = replace(dynamics, values={**dynamics.values, name: draw_range(ranges[name], rng)})
    camera = setting.collection.camera
    rng = seeds.generator(setting.seed, f"camera/{plan.key}", index, attempt)
    return Draw(
        index,
        object_of(plan, index),
        dynamics,
        draw_range(camera.azimuth_deg, rng),
        draw_range(camera.elevation_deg, rng),
    )


def object_of(plan: Plan, index: int) -> ObjectRef:
    """Every object once, in a random order, before any comes again."""
    objects = plan.setting.objects
    turn, place = divmod(index, len(objects))
    order = seeds.generator(plan.setting.seed, f"objects/{plan.key}", turn).permutation(len(objects))
    return objects[int(order[place])]


def draw_dynamics(ranges: DynamicsRanges, task: Task, rng: np.random.Generator) -> HiddenDynamics:
    """The hidden parameters that are always drawn, within `ranges`, with one of the task's direction modes."""
    values = {name: draw_range(ranges[name], rng) for name in ALWAYS_DRAWN}
    return HiddenDynamics(values, task.directions[int(rng.integers(len(task.directions)))])


def draw_arm_base(plan: Plan, index: int, target: ArticulatedObject) -> tuple[float, ...]:
    """Where the base of the arm stands in a rollout: x, y, z and yaw, world frame; empty without an arm.

    It is in front of the object (objects face -x), turned to it, on the floor that the object stands on.
    """
    if plan.setting.collection.arm is None:
        return ()
    rng = seeds.generator(plan.setting.seed, f"arm/{plan.key}", index)
    surface = surface_at(target, target.limits()[:, 0])
    low, high = surface.min(axis=0), surface.max(axis=0)
    middle = (low + high) / 2
    x, y = low[0] - rng.uniform(*ARM_DISTANCE), middle[1] + rng.uniform(-ARM_ASIDE, ARM_ASIDE)
    yaw = np.arctan2(middle[1] - y, middle[0] - x) + rng.uniform(-ARM_TURN, ARM_TURN)
    return float(x), float(y), float(low[2]), float(yaw)


def draw_range(interval: Range, rng: np.random.Generator) -> float:
    """A number within an interval."""
    if interval.log:
        return float(np.exp(rng.uniform(np.log(interval.low), np.log(interval.high))))
    return float(rng.uniform(interval.low, interval.high))


@dataclass(frozen=True, slots=True)
class Start:
    """A rollout before its first interaction.

    Attributes:
        draw: its object, hidden dynamics and camera.
        environment: the object is at rest and shows a part that the task may act on.
        states: draws its further start states.
    """

    draw: Draw
    environment: SimEnvironment
    states: np.random.Generator


def begin(plan: Plan, index: int, target: ArticulatedObject, clock: StageClock) -> Start | RolloutStatus:
    """Draw cameras and states until a rollout can begin; arguments as for `run_rollout`.

    Returns:
        The start, or why there is none.
    """
    rested = False
    for attempt in range(TRIES):
        draw = draw_rollout(plan, index, attempt)
        environment = make_environment(plan, draw, target, clock, attempt)
        states = seeds.generator(plan.setting.seed, f"states/{plan.key}", index, attempt)
        if not environment.reset(states):
            continue
        rested = True
        if environment.shows_a_target():
            return Start(draw, environment, states)
    return RolloutStatus.NOTHING_TO_ACT_ON if rested else RolloutStatus.NEVER_AT_REST


def draws_at_rest(plan: Plan, index: int, target: ArticulatedObject) -> int:
    """How many of the draws of a rollout come to rest."""
    clock = StageClock()
    environments = [make_environment(plan, draw_rollout(plan, index, k), target, clock, k) for k in range(TRIES)]
    states = [seeds.generator(plan.setting.seed, f"states/{plan.key}", index, k) for k in range(TRIES)]
    return sum(environment.reset(rng) for environment, rng in zip(environments, states, strict=True))


def make_environment(
    plan: Plan, draw: Draw, target: ArticulatedObject, clock: StageClock, attempt: int = 0
) -> SimEnvironment:
    """The simulated environment of one rollout, behind its arm if there is one."""
    setting = plan.setting
    environment = SIMULATORS.get(setting.collection.simulator).make(
        target,
        setting.task_record,
        setting.collection,
        draw.dynamics,
        camera_pose(draw.azimuth_deg, draw.elevation_deg, setting.collection.camera.distance),
        seeds.generator(setting.seed, f"pixels/{plan.key}", draw.index, attempt),
        clock,
    )
    arm, base = setting.arm, draw_arm_base(plan, draw.index, target)
    return environment if arm is None else ArmedEnvironment(environment, arm, base, setting.collection.arm_known, clock)


def interact(
    environment: SimEnvironment,
    proposer: Proposer,
    most: int,
    *,
    history: Sequence[Interaction] = (),
    start: Float | None = None,
    execute: Callable[[Observation, Action], Outcome] | None = None,
    clock: StageClock | None = None,
) -> Iterator[Interaction]:
    """The paper's test-time loop: observe, propose, execute, extend the history.

    It ends after `most` interactions, or earlier if the proposer stops, if no point that the task may act on is visible
    (a part can move out of the camera's view), or if the simulation has diverged.

    Args:
        environment: to act in.
        proposer: chooses the actions.
        most: number of interactions.
        history: earlier interactions; the proposer receives these and those of this loop.
        start: [parts], a state that is restored before each interaction; None: each continues from the last.
        execute: executes an action instead of the environment, so that the caller can record it.
        clock: sums wall time by stage.
    """
    clock = clock or StageClock()
    known = list(history)
    for _ in range(most):
        if start is not None:
            environment.restore(start)
        observation = environment.observe()
        if not observation.movable.any():
            return
        with clock.stage("propose"):
            action = proposer.propose(observation, known)
        if action is None:
            return
        outcome = execute(observation, action) if execute else environment.execute(action)
        known.append(Interaction(observation, action, outcome))
        yield known[-1]
        if outcome.kind is OutcomeKind.UNSTABLE:
            return  # Later states of this scene are not valid.


@dataclass(slots=True)
class Recorder:
    """Records what a rollout does: interactions in order, and every observation once."""

    environment: SimEnvironment
    policy_version: int
    clock: StageClock
    observations: list[Observation] = field(default_factory=list)
    interactions: list[InteractionRecord] = field(default_factory=list)

    def interact(
        self,
        proposer: Proposer,
        most: int,
        role: Role,
        *,
        history: Sequence[Interaction] = (),
        start: Float | None = None,
        method: str = "",
        budget: int = -1,
    ) -> list[Interaction]:
        """Run the loop and write down every interaction; see the function `interact`.

        Args:
            proposer: chooses the actions.
            most: interactions.
            role: what the interactions are for.
            history: interactions that the proposer knows already.
            start: [parts], a state that is put back before each interaction. None: each continues from the last.
            method: whose interactions these are, in evaluation.
            budget: how many interactions the method had before, in evaluation.

        Returns:
            The interactions of this loop.
        """
        order = Order.CONTINUE if start is None else Order.RESTART

        def execute(observation: Observation, action: Action) -> Outcome:
            return self._execute(observation, action, proposer.name, order, role, method, budget)

        loop = interact(
            self.environment, proposer, most, history=history, start=start, execute=execute, clock=self.clock
        )
        return list(loop)

    @property
    def sound(self) -> bool:
        """Whether the simulation has not diverged; nothing that follows could be believed."""
        return not self.interactions or self.interactions[-1].outcome.kind is not OutcomeKind.UNSTABLE

    def _execute(
        self,
        observation: Observation,
        action: Action,
        proposer: str,
        order: Order,
        role: Role,
        method: str,
        budget: int,
    ) -> Outcome:
        """Execute an action and record the interaction."""
        environment = self.environment
        part = int(observation.part_ids[action.point_index])
        body = environment.object.bodies[part]
        assert body.joint is not None
        state = environment.privileged(part)
        begun = time.perf_counter()
        outcome = environment.execute(action)
        self.interactions.append(
            InteractionRecord(
                step=len(self.interactions),
                observation=self._place_of(observation),
                action=action,
                outcome=outcome,
                normal=observation.normals[action.point_index].astype(np.float64),
                primitive=environment.primitive,
                order=order,
                role=role,
                proposer=proposer,
                policy_version=0 if proposer == RandomProposer.name else self.policy_version,
                method=method,
                budget=budget,
                target_part=part,
                target_link=body.link,
                target_joint=body.joint.name,
                joint_names=tuple(each.joint.name for each in environment.object.parts if each.joint is not None),
                joint_positions=state.joint_positions,
                joint_limits=state.joint_limits,
                joint_twist=state.joint_twist,
                hand_start=np.concatenate([hand_start(action), quaternion_from_rotation(action.rotation)]),
                seconds=time.perf_counter() - begun,
            )
        )
        return outcome

    def _place_of(self, observation: Observation) -> int:
        """Where the observation is kept; a new one is added."""
        for place, kept in enumerate(self.observations):
            if kept is observation:
                return place
        self.observations.append(observation)
        return len(self.observations) - 1


def collect(
    plan: Plan, index: int, recorder: Recorder, states: np.random.Generator, make_proposer: ProposerFactory
) -> None:
    """Collect training data: first interactions that continue, by the policy if there is one, then random ones."""
    rollout = plan.setting.collection.rollout
    rng = seeds.generator(plan.setting.seed, f"actions/{plan.key}", index)
    random: Proposer = RandomProposer(rng, plan.setting.terms.edge_share)
    environment = recorder.environment
    if plan.proposer != RandomProposer.name:
        rng = seeds.generator(plan.setting.seed, f"policy/{plan.key}", index)
        first, most = make_proposer(plan.proposer, rng, plan.policy_version), rollout.context
    else:
        first, most = random, rollout.interactions if rollout.order is Order.CONTINUE else rollout.continued
    start = environment.state()
    if most:
        recorder.interact(first, min(most, rollout.interactions), Role.COLLECT)
        if recorder.sound:
            environment.restore(start)
    while recorder.sound and (left := rollout.interactions - len(recorder.interactions)) > 0:
        one_state = plan.setting.task_record.closed  # Every draw of a state would give the same one.
        count = left if one_state else min(left, rollout.actions_per_state)
        state = environment.state()
        done = recorder.interact(random, count, Role.COLLECT, start=state)
        if one_state or not recorder.sound:
            break
        assert done, "a state without targets is never used"
        environment.restore(state)
        if not any(environment.reset(states) and environment.shows_a_target() for _ in range(TRIES)):
            break


def _record(
    plan: Plan, draw: Draw, status: RolloutStatus, recorder: Recorder | None, arm_base: tuple[float, ...] = ()
) -> RolloutRecord:
    return RolloutRecord(
        index=draw.index,
        plan_key=plan.key,
        object=draw.object,
        dynamics=draw.dynamics,
        azimuth_deg=draw.azimuth_deg,
        elevation_deg=draw.elevation_deg,
        seed=plan.setting.seed,
        fidelity=plan.setting.collection.fidelity.name,
        status=status,
        observations=tuple(recorder.observations) if recorder else (),
        interactions=tuple(recorder.interactions) if recorder else (),
        arm_base=arm_base,
    )
