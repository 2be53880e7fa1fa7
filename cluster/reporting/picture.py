"""Affordance from the camera's view before and after interactions: affordance.png of a run, and benchmark pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from cluster.reporting.style import hidden, verdict
from cluster.reporting.trial_sections import first_trials, most_telling
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.store import Store
from shared.types import Float, Float32, Interaction, Observation

ARROW_LENGTH = 0.25
"""Of the arrow along the approach, in the cloud's units."""
BODY_COLOUR = "0.8"
COLOURS = "viridis"


@dataclass(frozen=True, slots=True)
class Panel:
    """One cloud, coloured.

    Attributes:
        observation: the cloud.
        affordance: of its points, [N].
        title: above it.
        tried: drawn as an arrow.
    """

    observation: Observation
    affordance: Float32
    title: str
    tried: Interaction | None = None


def draw_adaptation(evaluation: Store, policy: Policy, out: Path) -> bool:
    """Draw the evaluation rollout whose affordance its interactions changed the most.

    The first panel is the affordance without interactions. Each further panel is the affordance after one more, which
    is drawn as an arrow, with its outcome in the title. Every panel shows the observation before its interaction.

    Returns:
        Whether there was any rollout to draw; if not, no file is written.
    """
    adapter = Adapter(policy)
    trial = most_telling(first_trials(evaluation), adapter)
    if trial is None:
        return False
    chosen, history = trial.rollout, trial.history
    first = history[0].observation
    panels = [Panel(first, adapter.affordance(first, []), "before any interaction")]
    for count, tried in enumerate(history, start=1):
        heat = adapter.affordance(tried.observation, history[:count])
        title = f"after interaction {count}: {verdict(tried.outcome)}"
        panels.append(Panel(tried.observation, heat, title, tried))
    title = f"{policy.task}: {chosen.object.category} {chosen.object.id}, not seen in training"
    draw_panels([panels], f"{title} (hidden: {hidden(chosen.dynamics)})", out)
    return True


def draw_panels(rows: Sequence[Sequence[Panel]], title: str, out: Path) -> None:
    """Write clouds in rows of one length, all on one scale of colours, as a PNG."""
    columns = len(rows[0])
    figure = Figure(figsize=(3.6 * columns, 4.2 * len(rows) + 0.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    figure.suptitle(title, fontsize=9, parse_math=False)
    panels = [panel for row in rows for panel in row]
    most = max(float(panel.affordance[panel.observation.movable].max()) for panel in panels)
    images = [_draw(axes, panel, most) for axes, panel in zip(grid.flat, panels, strict=True)]
    figure.colorbar(images[0], ax=grid.ravel().tolist(), shrink=0.7, label="affordance (AAP)")
    figure.savefig(out, format="png")


def _project(points: Float, observation: Observation) -> Float:
    """Image coordinates (right, up) of points [..., 3]; the camera looks along x, with y to its left and z up."""
    camera_from_world = np.linalg.inv(observation.world_from_camera)
    seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    return np.stack([-seen[..., 1] / seen[..., 0], seen[..., 2] / seen[..., 0]], axis=-1)


def _draw(axes: Axes, panel: Panel, most: float) -> PathCollection:
    """Movable points coloured by affordance, the rest grey; what is nearer is drawn over what is farther."""
    observation = panel.observation
    seen = _project(observation.points.astype(np.float64), observation)
    static = ~observation.movable
    axes.scatter(seen[static, 0], seen[static, 1], s=5, color=BODY_COLOUR, linewidths=0)
    movable = np.flatnonzero(observation.movable)
    image = axes.scatter(
        seen[movable, 0],
        seen[movable, 1],
        c=panel.affordance[movable],
        s=9,
        cmap=COLOURS,
        vmin=0,
        vmax=most,
        linewidths=0,
    )
    if panel.tried is not None:
        _draw_arrow(axes, panel.tried)
    axes.set_title(panel.title, fontsize=9, parse_math=False)
    axes.set_aspect("equal")
    axes.set_axis_off()
    return image


def _draw_arrow(axes: Axes, interaction: Interaction) -> None:
    """The approach of the interaction: the arrow's head is where the gripper touches."""
    action = interaction.action
    tail, head = _project(
        np.stack([action.point - ARROW_LENGTH * action.approach, action.point]), interaction.observation
    )
    colour = "tab:green" if interaction.outcome.success else "tab:red"
    axes.annotate("", xy=tuple(head), xytext=tuple(tail), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.5})
