"""Failures worth a look: exploits that the adapted critic believed in and that came to nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

from cluster.evaluation.trials import EvaluationTrial
from cluster.reporting.clouds import Arrow, CloudView, draw_panels
from cluster.reporting.page import Drawing, Section, plain
from cluster.reporting.style import FAILURE
from cluster.reporting.words import hidden, verdict
from shared.policies.adaptation import Adapter
from shared.records import InteractionRecord

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
    key, title = "failures", "FailedExploit gallery"
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
