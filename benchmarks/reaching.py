"""What does an arm cost? The share of random actions out of reach, and the processor time of a check and of a step.

The objects, their states and the bases of the arm are those of `adaafford collect` with the same seed. Every trajectory
of a proposal is checked again by a fresh `ArmReach`, by forward kinematics and against the joint limits.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
from pydantic import Field

from adaafford.pretrained import load_policy
from benchmarks.script import main
from cluster.cli.commands.bench import BenchSettings, planned
from cluster.reporting.collecting import wilson
from collector.objects.articulation import surface_at
from collector.objects.catalogue import ObjectCache
from collector.random_proposer import RandomProposer
from collector.rollout import Start, begin, object_of
from collector.sim.armed import ArmedEnvironment
from collector.sim.simulator import StageClock
from shared.arms.arm import Arm
from shared.arms.kinematics import MAX_JOINT_STEP, ArmReach, chain_of, reachable_points
from shared.policies.adaptation import Adapter
from shared.policies.proposers import AipProposer, ExploitProposer
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, Observation, Proposer


class ReachSettings(BenchSettings):
    """Print what an arm reaches of objects, and the time that this takes."""

    task: str = "pull-closed-door"
    """A task that the policy was trained for."""
    policy: str = "pull-closed-door"
    """A bundled policy, or a folder."""
    arm: str = "panda"
    """The arm."""
    rollouts: int = Field(20, ge=1, le=100_000)
    """Objects with freshly drawn states and bases."""
    actions: int = Field(50, ge=1, le=10_000)
    """Random actions of each."""
    proposals: int = Field(4, ge=1, le=10_000)
    """Of AIP and of the final action, each, in each rollout."""


def measure(command: ReachSettings) -> dict[str, Any]:
    """Measure, and print a summary."""
    adapter = Adapter(load_policy(command.policy))
    collection = adapter.policy.collection_for(command.collection.model_copy(update={"arm": command.arm}))
    command = command.model_copy(update={"collection": collection})
    times: dict[str, list[float]] = {name: [] for name in ("check", "step", "step_without_arm", "marks")}
    random = reached = proposed = none_reached = without_reach = wrong = 0
    with planned(command) as (plan, folder):
        cache = ObjectCache(folder)
        for index in range(command.rollouts):
            start = begin(plan, index, cache.load(object_of(plan, index), "hulls"), StageClock())
            if not isinstance(start, Start) or not isinstance(start.environment, ArmedEnvironment):
                continue
            environment, rng = start.environment, np.random.default_rng([command.seed, index])
            seen = environment.observe()
            assert plan.setting.arm is not None and seen.reach is not None
            reach = _fresh(plan.setting.arm, environment)
            for _ in range(command.actions):
                action = RandomProposer(rng, plan.setting.terms.edge_share).propose(seen, [])
                assert action is not None
                begun = time.process_time()
                reached += reach.trajectory(action) is not None
                times["check"].append(time.process_time() - begun)
                random += 1
            for k in range(command.proposals):
                for make in (_aip, _exploit):
                    reach_now = partial(_fresh, plan.setting.arm, environment)
                    seconds, _ = _step(seen, None, make(adapter, rng), adapter)
                    times["step_without_arm"].append(seconds)
                    seconds, action = _step(seen, reach_now, make(adapter, rng), adapter)
                    times["step"].append(seconds)
                    path = reach.trajectory(action)
                    proposed += 1
                    none_reached += path is None
                    wrong += path is not None and not _executes(plan.setting.arm, reach, action, path)
                    free = make(adapter, rng).propose(replace(seen, reach=None), []) if k == 0 else None
                    without_reach += free is not None and reach.trajectory(free) is None
            begun = time.process_time()
            reachable_points(replace(seen, reach=_fresh(plan.setting.arm, environment)))
            times["marks"].append(time.process_time() - begun)
    low, high = wilson(random - reached, random)
    share, known = 1 - reached / random, 2 * len(times["marks"])
    print(f"{random} random actions: {100 * share:.0f}% [{100 * low:.0f}, {100 * high:.0f}] out of reach")
    for name, taken in times.items():
        middle, slow = 1e3 * median(taken), 1e3 * float(np.quantile(taken, 0.95))
        print(f"{name}: median {middle:.2f} ms, 95% below {slow:.2f} ms")
    print(f"{proposed} proposals: {none_reached} where the arm reaches none, {wrong} with a wrong trajectory")
    print(f"first proposals of a policy that does not know the arm: {without_reach} of {known} out of reach")
    return {
        "random_actions": random,
        "unreachable_share": share,
        "milliseconds": {name: 1e3 * median(taken) for name, taken in times.items()},
        "proposals": proposed,
        "none_reached": none_reached,
        "wrong": wrong,
        "unaware_unreachable": without_reach,
        "unaware_proposals": known,
    }


def _aip(adapter: Adapter, rng: np.random.Generator) -> Proposer:
    return AipProposer(adapter, rng, budget=4, share=0.05)


def _exploit(adapter: Adapter, rng: np.random.Generator) -> Proposer:
    return ExploitProposer(adapter, rng)


def _fresh(arm: Arm, environment: ArmedEnvironment) -> ArmReach:
    surface = surface_at(environment.object, environment.privileged(1).joint_positions)
    return ArmReach(arm, environment.base, PRIMITIVES.get(environment.primitive), surface)


def _step(
    seen: Observation, reach: Callable[[], ArmReach] | None, proposer: Proposer, adapter: Adapter
) -> tuple[float, Action]:
    """Processor time, s, of a step on an observation that is new to the networks and to the arm, and its action."""
    begun = time.process_time()
    new = replace(seen, reach=None if reach is None else reach())
    action = proposer.propose(new, [])
    adapter.affordance(new, [])
    assert action is not None
    return time.process_time() - begun, action


def _executes(arm: Arm, reach: ArmReach, action: Action, path: Float) -> bool:
    """Whether a trajectory takes the hand along an action: 1 mm, 0.5 deg, limits, no jump."""
    chain = chain_of(arm)
    hands, wanted = chain.hands(path), reach.hands(action)
    away = np.linalg.norm(hands[:, :3, 3] - wanted[:, :3, 3], axis=1).max()
    cosine = (np.einsum("wij,wij->w", hands[:, :3, :3], wanted[:, :3, :3]) - 1) / 2
    turned = np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max()
    kept = (path >= chain.lower).all() and (path <= chain.upper).all()
    steady = np.abs(np.diff(path, axis=0)).max(initial=0.0) <= MAX_JOINT_STEP
    return bool(away < 1e-3 and turned < 0.5 and kept and steady)


if __name__ == "__main__":
    main("reaching", ReachSettings, measure)
