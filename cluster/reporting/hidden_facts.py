"""Affordance under hidden facts: friction, mass, direction and hinge side, one at a time (AdaAfford, Fig. 4)."""

from collections.abc import Callable, Sequence

from cluster.reporting.clouds import CloudView, draw_panels, tried
from cluster.reporting.counterfactuals import TRIES, Counterfactuals, Posterior, variations
from cluster.reporting.page import Drawing, Section, plain, shortened
from cluster.reporting.words import after
from collector.objects.articulation import ArticulatedObject
from shared.policies.adaptation import Adapter


def hidden_facts_section(
    counterfactuals: Counterfactuals,
    target: ArticulatedObject | None,
    twins: Sequence[ArticulatedObject],
    say: Callable[[str], None],
) -> Section:
    """The figure: a tab for each hidden fact, a cloud for each of its values."""
    key, title = "hidden-facts", "Affordance under hidden facts"
    if target is None:
        return Section(key, title, ("No test object of the run can be read any more, so nothing was simulated.",))
    found = variations(counterfactuals.setting, target, twins)
    drawings = []
    for number, variation in enumerate(found, start=1):
        say(f"simulating hidden facts, {number} of {len(found)}: {variation.name}")
        posteriors = counterfactuals.posteriors(variation)
        if posteriors:
            drawings.append(_drawing(variation.name, posteriors, counterfactuals.adapter))
    if not drawings:
        return Section(key, title, (f"No interaction with {target.ref.id} was possible.",))
    lead = (
        f"{shortened(target.ref.category)} {target.ref.id}, not seen in training"
        + (" (for the hinge's side: one cabinet, hung on its left and on its right)" if twins else "")
        + f". The first cloud is before any interaction. The others are after the same {TRIES} interactions under each "
        "value (green: success, red: failure), with all other hidden facts at the middle of their range. The camera "
        "sees the same in every cloud of a row, so differences in colour were learned from the interactions. Drag a "
        "cloud to turn all.",
    )
    return Section(key, title, lead, drawings=tuple(drawings))


def _drawing(name: str, posteriors: Sequence[Posterior], adapter: Adapter) -> Drawing:
    first = posteriors[0].observation
    panels = [CloudView(f"{after(0)}<br>&nbsp;", first, adapter.affordance(first, []))]
    panels += [
        CloudView(
            f"{plain(each.label)}<br>{_successes(each)}",
            each.observation,
            each.affordance,
            tuple(tried(interaction) for interaction in each.history),
        )
        for each in posteriors
    ]
    return Drawing(draw_panels(panels, len(panels), ("AAP: affordance",)), tab=name, solid=True)


def _successes(posterior: Posterior) -> str:
    count = sum(interaction.outcome.success for interaction in posterior.history)
    return f"{count} of {len(posterior.history)} interactions succeeded"
