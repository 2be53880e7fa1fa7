"""Compare two methods by sample-success on a few objects: `python examples/evaluate.py OBJECTS [COUNT]`.

On each simulated object, every method executes the one action that it scores highest: Where2Act without any
interaction, ours after up to two interactions that AIP chooses. `adaafford evaluate` compares all methods of the paper
in this way, with F-scores and intervals.
"""

import sys
from collections.abc import Sequence
from itertools import islice

import numpy as np

from adaafford import Adapter, AipProposer, Environment, ExploitProposer, Interaction, Proposer, load_policy, simulated

objects, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 4
TASK, BUDGET = "push-faucet", 2
adapter = Adapter(load_policy(TASK))


def interact(environment: Environment, proposer: Proposer) -> list[Interaction]:
    """Fill the set of interactions I: observe, propose, execute, until the proposer has seen enough."""
    history: list[Interaction] = []
    while (action := proposer.propose(observation := environment.observe(), history)) is not None:
        history.append(Interaction(observation, action, environment.execute(action)))
    return history


def succeeds(environment: Environment, exploit: Proposer, history: Sequence[Interaction]) -> bool:
    """Execute the action with the highest score at one of the 100 most actionable points."""
    action = exploit.propose(environment.observe(), history)
    assert action is not None, "an exploit never stops"
    return environment.execute(action).success


successes = {"where2act": 0, "ours-final": 0}
for environment in islice(simulated(objects, TASK, seed=5), count):
    rng = np.random.default_rng(7)
    start = environment.state()
    successes["where2act"] += succeeds(environment, ExploitProposer(adapter, rng, "where2act"), [])
    environment.restore(start)
    history = interact(environment, AipProposer(adapter, rng, BUDGET))
    environment.restore(start)
    successes["ours-final"] += succeeds(environment, ExploitProposer(adapter, rng, "aap"), history)
    motions = [round(each.outcome.motion, 2) for each in history]
    print(f"{environment.object.ref.id}: the interactions moved it by {motions} rad")
for method, found in successes.items():
    print(f"{method}: {found} of {count} objects")
