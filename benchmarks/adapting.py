"""How long does one test-time step take? AIP proposes, the outcome is added, and adapted affordance is computed.

Nothing is executed: the outcome is made up, since it costs the networks the same. Each step sees a new observation, as
after every try on a real object, so that its cloud is grouped and encoded within the step.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import torch
from pydantic import Field

from benchmarks.script import main
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from shared.errors import UsageError
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.policies.proposers import AipProposer
from shared.progress import Advance, Progress
from shared.store import Store
from shared.types import Interaction, Observation, Outcome, OutcomeKind, round_points

SIZES = (2048, 4096, 10_000)
"""Points of a cloud: as collected here, and up to what was published."""
BUDGET = 4
"""Tries in one rollout."""
SPREAD = 0.003
"""Standard deviation, in the cloud's units, of a point that is added from one that is there."""


class AdaptSettings(StoredSettings):
    """Time a test-time step: AIP proposes, the outcome is added, and the adapted affordance is computed."""

    repeats: int = Field(5, ge=1, le=1000)
    """The median of these counts."""


def measure(command: AdaptSettings) -> dict[str, Any]:
    """Measure, and print a table."""
    with stored(command) as store:
        policy = Policy.untrained(store.setting.task, NetworkConfig(), command.seed)
        benchmark = AdaptationBenchmark(store, policy, command.repeats)
        with Progress("rollouts of test-time steps", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store)
    print(f"{result['steps']} steps at each size, {result['threads']} threads; medians in ms")
    print(f"  {'points':>7}{'propose':>9}{'update':>9}{'step':>9}{'known observation':>20}")
    for size, figures in result["milliseconds"].items():
        known = figures["step_at_known_observation"]
        print(f"  {size:>7}{figures['propose']:>9.1f}{figures['update']:>9.1f}{figures['step']:>9.1f}{known:>20.1f}")
    return result


@dataclass(frozen=True, slots=True)
class AdaptationStep:
    """Seconds of one step.

    Attributes:
        propose: the cloud grouped and encoded by all three networks, and an action chosen.
        update: the outcome encoded, and affordance after it of all movable points.
        again: a whole step on an observation that was encoded before.
    """

    propose: float
    update: float
    again: float


class AdaptationBenchmark:
    """Repeated rollouts of made-up outcomes on stored observations.

    Args:
        store: where the observations are from.
        policy: whose networks; random weights take the same time as trained ones.
        repeats: rollouts of `BUDGET` steps at each size.
    """

    def __init__(self, store: Store, policy: Policy, repeats: int) -> None:
        self.steps: dict[int, list[AdaptationStep]] = {size: [] for size in SIZES}
        self.adapter = Adapter(policy.with_trained("prior").with_trained("aap").with_trained("aip"))
        self.repeats = repeats
        self._observations = observations_of(store, repeats * BUDGET)

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return self.repeats * len(SIZES)

    def run(self, advance: Advance) -> None:
        """Measure; sizes take turns, and the first rollout of each, which warms up, is not counted."""
        for turn in range(self.repeats):
            for size in SIZES:
                place = turn * BUDGET
                seen = [resized(observation, size) for observation in self._observations[place : place + BUDGET]]
                if turn == 0:
                    self._rollout(seen, turn)
                self.steps[size] += self._rollout([replace(observation) for observation in seen], turn)
                advance()

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints; medians over all steps."""
        milliseconds = {
            size: {
                "propose": 1e3 * median(step.propose for step in steps),
                "update": 1e3 * median(step.update for step in steps),
                "step": 1e3 * median(step.propose + step.update for step in steps),
                "step_at_known_observation": 1e3 * median(step.again for step in steps),
            }
            for size, steps in self.steps.items()
        }
        smallest, largest = SIZES[0], SIZES[-1]
        return {
            "step_ms": milliseconds[smallest]["step"],
            "step_ms_published_points": milliseconds[largest]["step"],
            "growth": milliseconds[largest]["step"] / milliseconds[smallest]["step"],
            "milliseconds": {str(size): figures for size, figures in milliseconds.items()},
            "threads": torch.get_num_threads(),
            "steps": self.repeats * BUDGET,
        }

    def _rollout(self, observations: Sequence[Observation], seed: int) -> list[AdaptationStep]:
        """The steps of one rollout."""
        adapter, history, steps = self.adapter, list[Interaction](), list[AdaptationStep]()
        for observation in observations:
            begun = time.perf_counter()
            tried = self._tried(observation, history, seed)
            proposed = time.perf_counter()
            adapter.affordance(observation, [*history, tried])
            updated = time.perf_counter()
            again = self._tried(observation, history, seed)
            adapter.affordance(observation, [*history, again])
            steps.append(AdaptationStep(proposed - begun, updated - proposed, time.perf_counter() - updated))
            history.append(tried)
        return steps

    def _tried(self, observation: Observation, history: Sequence[Interaction], seed: int) -> Interaction:
        """The proposed action with a made-up outcome."""
        proposer = AipProposer(self.adapter, np.random.default_rng(seed), BUDGET, at_least=BUDGET)
        action = proposer.propose(observation, history)
        assert action is not None
        return Interaction(observation, action, Outcome(OutcomeKind.OK, motion=0.1, success=True))


def observations_of(store: Store, count: int) -> list[Observation]:
    """Observations with movable points, from the beginning again where the store has too few.

    Raises:
        UsageError: it has none.
    """
    found: list[Observation] = []
    for manifest in store.committed():
        for rollout in store.read_rollouts(manifest.shard_id):
            found += [observation for observation in rollout.observations if observation.movable.any()]
        if len(found) >= count:
            break
    if not found:
        raise UsageError(f"{store.path}: holds no observation with a movable point; collect some first")
    return [found[number % len(found)] for number in range(count)]


def resized(observation: Observation, size: int) -> Observation:
    """The observation with as many points: the first ones, or more beside those there are."""
    rng = np.random.default_rng(size)
    there = len(observation.points)
    index = (
        np.arange(size) if size <= there else np.concatenate([np.arange(there), rng.integers(0, there, size - there)])
    )
    points = observation.points[index].copy()
    points[there:] += rng.normal(0.0, SPREAD, points[there:].shape).astype(np.float32)
    return replace(
        observation,
        points=round_points(points),
        normals=observation.normals[index],
        part_ids=observation.part_ids[index],
        movable=observation.movable[index],
        pixels=observation.pixels[index],
    )


if __name__ == "__main__":
    main("adapting", AdaptSettings, measure)
