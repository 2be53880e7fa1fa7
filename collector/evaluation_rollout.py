"""Evaluation rollouts: the paper's test-time procedure, for every method on the same object and hidden dynamics.

Every method starts from the same state, and its interactions continue each other. After each budget, the action that
its adapted affordance chooses is executed from the state that the interactions left (as in the paper), and the state is
restored. This action is easy if the interactions left the object in the middle of its range, where it can be moved both
ways. So another action is chosen and executed from the start state, which is the same for all methods.
"""

from collections.abc import Callable

import numpy as np

from collector.random_proposer import RandomProposer
from collector.recorder import Recorder
from shared import seeds
from shared.plan import Plan
from shared.policies.methods import method_named
from shared.types import Float, Interaction, Proposer, Role

ProposerFactory = Callable[[str, np.random.Generator, int], Proposer]
"""Makes a proposer from its name, such as "aip", a random generator, and a policy version."""


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
    for name in config.methods:
        if not recorder.sound:
            return
        environment.restore(start)
        method = method_named(name)
        version = method.policy_version(plan.policy_version)
        recorder.policy_version = version
        exploiter = make_proposer(method.critic, rng(f"exploit/{name}"), version)
        context: Proposer | None = None
        if method.tries == RandomProposer.name:
            context = RandomProposer(rng(f"context/{name}"), edge_share)
        elif method.tries is not None:
            context = make_proposer(method.tries, rng(f"context/{name}"), version)
        _adapt(recorder, name, context, exploiter, method.budgets(config.budgets), start)


def _adapt(
    recorder: Recorder,
    method: str,
    context: Proposer | None,
    exploiter: Proposer,
    budgets: list[int],
    start: Float,
) -> None:
    """Collect the method's interactions one at a time; at each budget, execute its action and restore the state."""
    environment, history = recorder.environment, list[Interaction]()
    for budget in budgets:
        if context is not None:  # A proposer may stop before the greater budgets.
            left_to_try = budget - len(history)
            history += recorder.interact(context, left_to_try, Role.CONTEXT, history=history, method=method)
        if not recorder.sound or not environment.observe().movable.any():
            return
        left = environment.state()
        # Without interactions, both states are the same.
        for role, state in ((Role.EXPLOIT, left), (Role.EXPLOIT_AT_START, start))[: 1 if context is None else 2]:
            recorder.interact(exploiter, 1, role, history=history, start=state, method=method, budget=budget)
            if not recorder.sound:
                return
        environment.restore(left)
