"""Evaluation rollouts as one method lived them (its interactions in order, and what it did in the end), as clouds.

The sections show what AIP proposes, and exploits that were believed in and that failed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import plotly.graph_objects as go

from cluster.reporting.clouds import Arrow, CloudView, draw_panels, proposed, tried
from cluster.reporting.page import Drawing, Section, plain, shortened
from cluster.reporting.style import FAILURE, after, hidden, verdict
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.adaptation import Adapter, movable_points
from shared.policies.methods import MethodName
from shared.store import Store
from shared.types import Float32, Interaction, Observation, Role

TOLD: MethodName = "ours-final"
"""The method whose episodes pictures show."""
MOST_TRIALS = 60
"""Looked at for pictures, at the most: each holds all clouds of its rollout, some megabytes."""
CANDIDATES = 40
"""Episodes among them that are asked for what their interactions changed."""


@dataclass(frozen=True, slots=True)
class EvaluationTrial:
    """What one method did with one object.

    Attributes:
        rollout: where it comes from.
        tries: rows of its interactions.
        exploits: rows of what its adapted affordance chose, one a budget.
    """

    rollout: RolloutRecord
    tries: tuple[InteractionRecord, ...]
    exploits: tuple[InteractionRecord, ...]

    @property
    def history(self) -> list[Interaction]:
        """The interactions as a proposer is told them."""
        return [Interaction(self.seen_by(row), row.action, row.outcome) for row in self.tries]

    def seen_by(self, row: InteractionRecord) -> Observation:
        """The observation that a row's action was chosen on."""
        return self.rollout.observations[row.observation]

    def before(self, exploit: InteractionRecord) -> list[Interaction]:
        """The interactions that came before an exploit."""
        return self.history[: exploit.budget]


def first_trials(evaluation: Store, most: int = MOST_TRIALS) -> list[EvaluationTrial]:
    """The first episodes of the method that pictures show; raises as `trials` does."""
    return list(islice(trials(evaluation, TOLD), most))


def trials(evaluation: Store, method: MethodName) -> Iterator[EvaluationTrial]:
    """The episodes of a method that tried anything, in order.

    Raises:
        StoreError: a shard is damaged or foreign.
    """
    for part in evaluation.parts():
        for rollout in evaluation.rollouts_of(part):
            own = [row for row in rollout.interactions if row.method == method]
            tries = tuple(row for row in own if row.role is Role.CONTEXT)
            if tries:
                yield EvaluationTrial(rollout, tries, tuple(row for row in own if row.role is Role.EXPLOIT))


def most_telling(found: list[EvaluationTrial], adapter: Adapter) -> EvaluationTrial | None:
    """The episode whose affordance its interactions changed the most; None where there is none."""
    return max(found[:CANDIDATES], key=lambda trial: _change(trial, adapter), default=None)


def _change(trial: EvaluationTrial, adapter: Adapter) -> float:
    """How much the interactions changed the affordance of movable points; more where an interaction succeeded."""
    history = trial.history
    observation = history[0].observation
    before, after = adapter.affordance(observation, []), adapter.affordance(observation, history)
    moved = np.abs(after - before)[observation.movable]
    return float(moved.mean()) + 0.1 * any(interaction.outcome.success for interaction in history)


SHOWN = 4
LOOKED_AT = 60
"""Failures that the critic is asked about, at the most."""


@dataclass(frozen=True, slots=True)
class FailedExploit:
    """An exploit that failed, and how much the critic believed in it."""

    trial: EvaluationTrial
    row: InteractionRecord
    belief: float


def failures_section(trials: Sequence[EvaluationTrial], adapter: Adapter) -> Section:
    """The failures at the greatest budget, one of each kind before any kind comes again."""
    key, title = "failures", "Failure gallery"
    last = [(trial, trial.exploits[-1]) for trial in trials if trial.exploits]
    failed = [(trial, row) for trial, row in last if not row.outcome.success]
    counted = f"{len(failed)} of the {len(last)} exploits that were looked at, at the greatest budget, failed."
    if not failed:
        return Section(key, title, (counted if last else "Nothing was exploited.",))
    chosen = varied([_believed(trial, row, adapter) for trial, row in failed[:LOOKED_AT]])
    lead = (
        f"{counted} Here those that the critic believed in most, one of each kind of failure before any comes again: "
        "the adapted affordance, and the action that it chose (red).",
    )
    figure = draw_panels([_panel(failure, adapter) for failure in chosen], len(chosen), ("AAP: affordance",))
    caption = "; ".join(
        f"{failure.trial.rollout.object.id}: {hidden(failure.trial.rollout.dynamics)}" for failure in chosen
    )
    return Section(key, title, lead, drawings=(Drawing(figure, f"Hidden facts. {caption}.", solid=True),))


def varied(failures: Sequence[FailedExploit]) -> list[FailedExploit]:
    """Some failures in order of belief, each kind of outcome once before any comes again."""
    turns: dict[str, int] = {}
    ranked = []
    for failure in sorted(failures, key=lambda each: -each.belief):
        kind = failure.row.outcome.kind.value
        turns[kind] = turns.get(kind, -1) + 1
        ranked.append((turns[kind], failure))
    return [failure for _, failure in sorted(ranked, key=lambda pair: pair[0])][:SHOWN]


def _believed(trial: EvaluationTrial, row: InteractionRecord, adapter: Adapter) -> FailedExploit:
    score = adapter.score(trial.seen_by(row), [row.action], trial.before(row))
    return FailedExploit(trial, row, float(score[0]))


def _panel(failure: FailedExploit, adapter: Adapter) -> CloudView:
    trial, row = failure.trial, failure.row
    observation = trial.seen_by(row)
    title = f"{plain(trial.rollout.object.id)}: believed {100 * failure.belief:.0f}%<br>{verdict(row.outcome)}"
    values = adapter.affordance(observation, trial.before(row))
    return CloudView(title, observation, values, (Arrow(row.action, FAILURE),))


MOST_TRIES = 3
"""Two clouds a step; a browser draws no more than about sixteen at once."""


def proposals_section(trial: EvaluationTrial | None, adapter: Adapter) -> Section:
    """What AIP proposes in a trial, and how each interaction changes the affordance (AdaAfford, Fig. 5)."""
    key, title = "proposals", "What AIP proposes, and how each interaction changes the affordance"
    if trial is None:
        return Section(key, title, ("AIP proposed no interaction in the evaluation.",))
    rollout, history = trial.rollout, trial.history[:MOST_TRIES]
    lead = (
        f"{shortened(rollout.object.category)} {rollout.object.id}, not seen in training; hidden: "
        f"{hidden(rollout.dynamics)}. This is the trial whose affordance its interactions changed most.",
        "Above: AIP's actionability, scaled from the least to the most of each cloud, and the interaction that it "
        "proposes (black). Below: the affordance after that many interactions, with the last one (green: success, red: "
        "failure). Static parts are grey. Drag a cloud to turn all.",
    )
    return Section(key, title, lead, drawings=(Drawing(_figure(history, adapter), solid=True),))


def _figure(history: list[Interaction], adapter: Adapter) -> go.Figure:
    observations = [interaction.observation for interaction in history]
    observations.append(observations[-1])
    above, below = [], []
    for count, observation in enumerate(observations):
        before = history[:count]
        arrows = (proposed(history[count].action),) if count < len(history) else ()
        values = information(observation, before, adapter)
        title = f"AIP, {after(count)}: at most {values[observation.movable].max():.2g}"
        title += f"<br>proposes interaction {count + 1}" if arrows else "<br>&nbsp;"
        above.append(CloudView(title, observation, _stretched(values, observation), arrows))
        shown = observations[count - 1] if count else observation
        title = f"affordance, {after(count)}<br>" + (plain(verdict(before[-1].outcome)) if before else "&nbsp;")
        arrows = (tried(before[-1]),) if before else ()
        below.append(CloudView(title, shown, adapter.affordance(shown, before), arrows, scale=1))
    return draw_panels([*above, *below], len(observations), ("AIP: least to most", "AAP: affordance"))


def information(observation: Observation, history: list[Interaction], adapter: Adapter) -> Float32:
    """The AIP actionability of every point, [N]; 0 for points that may not be acted on."""
    values = np.zeros(len(observation.points), np.float32)
    candidates = movable_points(observation)
    values[candidates] = adapter.information(observation, candidates, adapter.z(history))
    return values


def _stretched(values: Float32, observation: Observation) -> Float32:
    """Values of movable points from 0 for the least to 1 for the most: which point AIP prefers, however little."""
    own = values[observation.movable]
    low, high = own.min(initial=np.inf), own.max(initial=-np.inf)
    stretched: Float32 = (values - low) / max(high - low, 1e-12)
    return stretched
