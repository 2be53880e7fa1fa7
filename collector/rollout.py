"""Rollouts: one object, one draw of hidden dynamics, one camera, and a sequence of interactions.

A rollout is a pure function of its plan and its number: object, hidden dynamics, camera, states and actions are drawn
from seeds that are derived from these. So it is the same for every worker and at any time.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from collector.objects.articulation import ArticulatedObject, surface_at
from collector.random_proposer import RandomProposer
from collector.recorder import Recorder
from collector.sim.armed import ArmedEnvironment
from collector.sim.simulator import SIMULATORS, SimEnvironment, StageClock
from shared import seeds
from shared.config import DynamicsRanges, Range
from shared.geometry import camera_pose
from shared.hidden import ALWAYS_DRAWN
from shared.plan import ObjectRef, Plan, RolloutRecord, RolloutStatus
from shared.policies.methods import METHODS, REPEATING, MethodName
from shared.tasks import Task
from shared.types import Float, HiddenDynamics, Interaction, Order, Proposer, Role

TRIES = 8
"""Draws of a camera and a state before a rollout is given up as showing nothing that could be acted upon."""
ARM_DISTANCE, ARM_ASIDE, ARM_TURN = (0.3, 0.6), 0.3, 0.2
"""Of the base of an arm: how far before the object's front, and aside of its middle, m, and turned off it, rad."""


class ProposerFactory(Protocol):
    """Makes proposers."""

    def __call__(self, name: str, rng: np.random.Generator, version: int, share: float | None = None, /) -> Proposer:
        """Make a proposer.

        Args:
            name: of the proposer, such as "aip".
            rng: of its random draws.
            version: of the policy.
            share: of a cloud's points, from which it draws its points, as far as it draws any; None: its own way.
        """
        ...


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


def evaluate(plan: Plan, index: int, recorder: Recorder, make_proposer: ProposerFactory) -> None:
    """Run every method of the plan on the environment's present state.

    Args:
        plan: an evaluation plan.
        index: number of the rollout.
        recorder: of the environment, in its start state.
        make_proposer: makes the proposers that the methods name.
    """
    config = plan.setting.evaluation
    assert config is not None, "an evaluation setting says what to evaluate"

    def rng(purpose: str) -> np.random.Generator:
        return seeds.generator(plan.setting.seed, f"{purpose}/{plan.key}", index)

    environment = recorder.environment
    edge_share = plan.setting.terms.edge_share
    start = environment.state()
    recorder.interact(RandomProposer(rng("queries"), edge_share), config.queries, Role.QUERY, start=start)
    if recorder.sound:
        environment.restore(start)
    tried: dict[MethodName, list[Interaction]] = {}
    for name in config.methods:
        if not recorder.sound:
            return
        environment.restore(start)
        method = METHODS.get(name)
        version = method.policy_version(plan.policy_version)
        recorder.policy_version = version
        exploiter = make_proposer(method.critic, rng(f"exploit/{name}"), version)
        context: Proposer | None = None
        if method.tries == RandomProposer.name:
            context = RandomProposer(rng(f"context/{name}"), edge_share)
        elif method.tries is not None:
            context = make_proposer(method.tries, rng(f"context/{name}"), version)
        tried[name] = _adapt(recorder, name, context, exploiter, method.budgets(config.budgets), start)

    def act_at_start(role: Role, name: MethodName, history: list[Interaction], proposer: Proposer) -> None:
        """At each budget, execute what the method would do after its first interactions, where they began."""
        for budget in METHODS.get(name).budgets(config.budgets):
            if not recorder.sound:
                return
            known = history[:budget]
            recorder.interact(proposer, 1, role, history=known, start=start, method=name, budget=budget)

    for name, history in tried.items() if config.exploit_share is not None else ():
        method = METHODS.get(name)
        version = recorder.policy_version = method.policy_version(plan.policy_version)
        if method.draws_tries and recorder.sound:
            environment.restore(start)
            context = make_proposer(str(method.tries), rng(f"context-by-share/{name}"), version, config.exploit_share)
            most = method.budgets(config.budgets)[-1]
            history = recorder.interact(context, most, Role.CONTEXT_BY_SHARE, method=name)
        exploiter = make_proposer(method.critic, rng(f"exploit-by-share/{name}"), version, config.exploit_share)
        act_at_start(Role.EXPLOIT_BY_SHARE, name, history, exploiter)
    for name, history in tried.items() if config.repeats else ():
        method = METHODS.get(name)
        if method.tries is not None:
            version = recorder.policy_version = method.policy_version(plan.policy_version)
            critic = f"{REPEATING}{method.critic}"
            repeater = make_proposer(critic, rng(f"repeat/{name}"), version, config.exploit_share)
            act_at_start(Role.REPEAT_AT_START, name, history, repeater)


def _adapt(
    recorder: Recorder,
    method: str,
    context: Proposer | None,
    exploiter: Proposer,
    budgets: list[int],
    start: Float,
) -> list[Interaction]:
    """Collect the method's interactions one at a time; at each budget, execute its action and restore the state.

    Returns:
        The interactions.
    """
    environment, history = recorder.environment, list[Interaction]()
    for budget in budgets:
        if context is not None:  # A proposer may stop before the greater budgets.
            left_to_try = budget - len(history)
            history += recorder.interact(context, left_to_try, Role.CONTEXT, history=history, method=method)
        if not recorder.sound or not environment.observe().movable.any():
            return history
        left = environment.state()
        # Without interactions, both states are the same.
        for role, state in ((Role.EXPLOIT, left), (Role.EXPLOIT_AT_START, start))[: 1 if context is None else 2]:
            recorder.interact(exploiter, 1, role, history=history, start=state, method=method, budget=budget)
            if not recorder.sound:
                return history
        environment.restore(left)
    return history
