"""Base rates of random actions, and how often the outcome of an action depends on the hidden dynamics."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from collector.random_proposer import RandomProposer, RepeatingProposer
from collector.rollout import draw_dynamics, draw_rollout, interact, make_environment, object_of
from collector.sim.environment import SAME_STATE, SapienEnvironment, only_sapien
from collector.sim.simulator import StageClock
from shared import seeds
from shared.plan import Plan
from shared.progress import Advance
from shared.types import Action, Float, HiddenDynamics, OutcomeKind

ALL = "all"


@dataclass(frozen=True, slots=True)
class DynamicsTrial:
    """One trial under one draw of hidden dynamics.

    Attributes:
        category: of the object.
        pair: which (state, action): rollout, state and action.
        kind: how it ended.
        success: r.
    """

    category: str
    pair: tuple[int, int, int]
    kind: OutcomeKind
    success: bool


@dataclass(frozen=True, slots=True)
class CategoryDynamics:
    """The figures of one category, or of all.

    Attributes:
        trials: how many.
        base_rate: share of random actions that succeed; NaN without trials.
        outcomes: share of each outcome kind that occurred.
        pairs: (state, action) pairs that were tried under at least two draws.
        ever: pairs that succeeded under at least one of them.
        depends: those of `ever` that failed under another.
    """

    trials: int
    base_rate: float
    outcomes: dict[str, float]
    pairs: int
    ever: int
    depends: int

    @property
    def depends_share(self) -> float:
        """Share of the pairs that ever succeed whose outcome depends on the draw; NaN where none does."""
        return self.depends / self.ever if self.ever else float("nan")

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints of the category."""
        return {
            "trials": self.trials,
            "base_rate": self.base_rate,
            "outcomes": self.outcomes,
            "pairs": self.pairs,
            "pairs_that_ever_succeed": self.ever,
            "depends_on_draw": self.depends_share,
        }


def measure(
    plan: Plan, folder: Path, rollouts: int, draws: int, actions: int, advance: Advance
) -> dict[str, CategoryDynamics]:
    """Try the same random actions from the same states under several draws of hidden dynamics.

    Args:
        plan: task, objects, ranges and seed.
        folder: of the objects.
        rollouts: one object and one drawn state each.
        draws: of hidden dynamics in each rollout.
        actions: tried from each state.
        advance: called after each rollout.

    Returns:
        Figures by category, and of all under `ALL`.
    """
    trials: list[DynamicsTrial] = []
    for index in range(rollouts):
        target = load_ref(folder, object_of(plan, index), plan.setting.collection.collision)
        trials.extend(_rollout(plan, target, index, draws, actions))
        advance()
    return by_category(trials)


def by_category(trials: Sequence[DynamicsTrial]) -> dict[str, CategoryDynamics]:
    """The figures of trials, by category and of all."""
    groups: dict[str, list[DynamicsTrial]] = {ALL: list(trials)}
    for trial in trials:
        groups.setdefault(trial.category, []).append(trial)
    return {name: _summary(groups[name]) for name in [*sorted(groups.keys() - {ALL}), ALL]}


def _summary(trials: list[DynamicsTrial]) -> CategoryDynamics:
    successes: defaultdict[tuple[int, int, int], list[bool]] = defaultdict(list)
    for trial in trials:
        successes[trial.pair].append(trial.success)
    pairs = [outcomes for outcomes in successes.values() if len(outcomes) > 1]
    kinds = Counter(trial.kind.value for trial in trials)
    return CategoryDynamics(
        trials=len(trials),
        base_rate=float(np.mean([trial.success for trial in trials])) if trials else float("nan"),
        outcomes={kind: count / len(trials) for kind, count in kinds.most_common()},
        pairs=len(pairs),
        ever=sum(any(outcomes) for outcomes in pairs),
        depends=sum(any(outcomes) and not all(outcomes) for outcomes in pairs),
    )


@dataclass(frozen=True, slots=True)
class _State:
    """A state in which the object has come to rest, and what is tried from it."""

    positions: Float
    actions: tuple[Action, ...]


def _rollout(plan: Plan, target: ArticulatedObject, index: int, draws: int, actions: int) -> Iterator[DynamicsTrial]:
    """One drawn state under several draws of hidden dynamics.

    Where a draw lets the object come to rest elsewhere (a light lid stays up, a heavy one falls), the actions are
    drawn anew: its trials count for the base rate, and are pairs only with others that rest there as well.
    """
    setting, task = plan.setting, plan.setting.task_record
    rng = seeds.generator(setting.seed, "bench/dynamics", index)
    states: list[_State] = []
    for _ in range(draws):
        environment = _environment(plan, target, index, draw_dynamics(setting.terms.dynamics, task, rng))
        if not environment.reset(seeds.generator(setting.seed, f"states/{plan.key}", index, 0)):
            continue
        place = _place_of(environment, states, _proposer(plan, index), actions)
        if place is None:
            continue
        state = states[place]
        proposer, most = RepeatingProposer(state.actions), len(state.actions)
        for number, tried in enumerate(interact(environment, proposer, most, start=state.positions)):
            yield DynamicsTrial(target.ref.category, (index, place, number), tried.outcome.kind, tried.outcome.success)


def _environment(plan: Plan, target: ArticulatedObject, index: int, dynamics: HiddenDynamics) -> SapienEnvironment:
    draw = replace(draw_rollout(plan, index), dynamics=dynamics)
    return only_sapien(make_environment(plan, draw, target, StageClock()))


def _proposer(plan: Plan, index: int) -> RandomProposer:
    return RandomProposer(seeds.generator(plan.setting.seed, "bench/actions", index), plan.setting.terms.edge_share)


def _place_of(
    environment: SapienEnvironment, states: list[_State], proposer: RandomProposer, actions: int
) -> int | None:
    """Where the environment's state is among those known, to which a new one is added; None if it shows no target."""
    positions = environment.state()
    for place, known in enumerate(states):
        if np.abs(known.positions - positions).max() < SAME_STATE:
            return place
    if not environment.shows_a_target():
        return None
    observation = environment.observe()
    proposed = (proposer.propose(observation, ()) for _ in range(actions))
    states.append(_State(positions, tuple(action for action in proposed if action is not None)))
    return len(states) - 1
