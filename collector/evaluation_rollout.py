"""Evaluation rollouts: the paper's test-time procedure, for every method on the same object and hidden dynamics.

Every method starts from the same state, and its interactions continue each other. After each budget, the action that
its adapted affordance chooses is executed from the state that the interactions left (as in the paper), and the state is
restored. This action is easy if the interactions left the object in the middle of its range, where it can be moved both
ways. So another action is chosen and executed from the start state, which is the same for all methods.

With a share of points (`EvaluationConfig.exploit_share`), every method acts once more at each budget, from the start
state, as in the published code. These rows come last and draw from random generators of their own, so all other rows
are the same to the last bit with and without them.
"""

from typing import Protocol

import numpy as np

from collector.random_proposer import RandomProposer
from collector.recorder import Recorder
from shared import seeds
from shared.plan import Plan
from shared.policies.methods import MethodName, method_named
from shared.types import Float, Interaction, Proposer, Role


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
        method = method_named(name)
        version = method.policy_version(plan.policy_version)
        recorder.policy_version = version
        exploiter = make_proposer(method.critic, rng(f"exploit/{name}"), version)
        context: Proposer | None = None
        if method.tries == RandomProposer.name:
            context = RandomProposer(rng(f"context/{name}"), edge_share)
        elif method.tries is not None:
            context = make_proposer(method.tries, rng(f"context/{name}"), version)
        tried[name] = _adapt(recorder, name, context, exploiter, method.budgets(config.budgets), start)
    for name, history in tried.items() if config.exploit_share is not None else ():
        method = method_named(name)
        version = method.policy_version(plan.policy_version)
        recorder.policy_version = version
        if method.draws_tries and recorder.sound:
            environment.restore(start)
            context = make_proposer(str(method.tries), rng(f"context-by-share/{name}"), version, config.exploit_share)
            most = method.budgets(config.budgets)[-1]
            history = recorder.interact(context, most, Role.CONTEXT_BY_SHARE, method=name)
        exploiter = make_proposer(method.critic, rng(f"exploit-by-share/{name}"), version, config.exploit_share)
        _exploit_by_share(recorder, name, history, exploiter, method.budgets(config.budgets), start)


def _exploit_by_share(
    recorder: Recorder, method: str, tried: list[Interaction], exploiter: Proposer, budgets: list[int], start: Float
) -> None:
    """At each budget, execute what the method would do after its first interactions, where they began."""
    for budget in budgets:
        if not recorder.sound:
            return
        known, role = tried[:budget], Role.EXPLOIT_BY_SHARE
        recorder.interact(exploiter, 1, role, history=known, start=start, method=method, budget=budget)


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
