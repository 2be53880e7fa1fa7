"""Rollouts: one object, one draw of hidden dynamics, one camera, and a sequence of interactions."""

from dataclasses import dataclass

import numpy as np

from collector.domain_randomisation import Draw, draw_arm_base, draw_rollout
from collector.evaluation_rollout import ProposerFactory, evaluate
from collector.objects.articulation import ArticulatedObject
from collector.random_proposer import RandomProposer
from collector.recorder import Recorder
from collector.sim.armed import ArmedEnvironment
from collector.sim.simulator import SIMULATORS, SimEnvironment
from collector.stopwatch import StageClock
from shared import seeds
from shared.geometry import camera_pose
from shared.plan import Plan, RolloutRecord, RolloutStatus
from shared.types import Order, Proposer, Role

TRIES = 8
"""Draws of a camera and a state before a rollout is given up as showing nothing that could be acted upon."""


def run_rollout(
    plan: Plan, index: int, target: ArticulatedObject, make_proposer: ProposerFactory, clock: StageClock
) -> RolloutRecord:
    """Execute one rollout of a plan.

    Args:
        plan: the plan.
        index: number of the rollout.
        target: the object that `collector.domain_randomisation.object_of` gives.
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


def quarantined_rollout(plan: Plan, index: int) -> RolloutRecord:
    """The record of a quarantined rollout, which has only its draw."""
    return _record(plan, draw_rollout(plan, index), RolloutStatus.QUARANTINED, None)


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
        if not _next_state(environment, states):
            break


def _next_state(environment: SimEnvironment, states: np.random.Generator) -> bool:
    """Draw states until one is at rest and shows a target; whether one was found."""
    return any(environment.reset(states) and environment.shows_a_target() for _ in range(TRIES))


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
