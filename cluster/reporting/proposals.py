"""The interactions that AIP proposes, and how each changes the affordance, step by step (AdaAfford, Fig. 5)."""

import numpy as np
import plotly.graph_objects as go

from cluster.evaluation.trials import EvaluationTrial
from cluster.reporting.clouds import CloudView, draw_panels, proposed, tried
from cluster.reporting.page import Drawing, Section, plain, shortened
from cluster.reporting.words import after, hidden, verdict
from shared.policies.adaptation import Adapter, movable_points
from shared.types import Float32, Interaction, Observation

MOST_TRIES = 3
"""Two clouds a step; a browser draws no more than about sixteen at once."""


def proposals_section(trial: EvaluationTrial | None, adapter: Adapter) -> Section:
    """The evaluation trial whose interactions changed the affordance most."""
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
