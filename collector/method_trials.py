"""What the methods of an evaluation do in a rollout: each adapts from the same state, and acts after each budget."""

from typing import TYPE_CHECKING, Protocol

import numpy as np

from collector.random_proposer import RandomProposer
from shared import seeds
from shared.plan import Plan
from shared.policies.methods import METHODS, REPEATING, MethodName
from shared.types import Float, Interaction, Proposer, Role

if TYPE_CHECKING:
    from collector.rollout import Recorder


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


def evaluate(plan: Plan, index: int, recorder: "Recorder", make_proposer: ProposerFactory) -> None:
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
    recorder: "Recorder",
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
