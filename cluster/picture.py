"""affordance.png: one test object as the camera sees it, before and after each try, and what each try was."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from cluster.episodes import first_episodes, most_telling
from shared.adaptation import Adapter
from shared.policy import Policy
from shared.store import Store
from shared.vocabulary import Float, Float32, Interaction, Observation

ARROW_LENGTH = 0.25
"""Of the arrow along the approach, in the cloud's units."""
BODY_COLOUR = "0.8"
COLOURS = "viridis"


def draw_adaptation(evaluation: Store, policy: Policy, out: Path) -> bool:
    """Draw the evaluation rollout whose affordance its tries changed the most.

    The first panel is the affordance with no tries; each further panel is the affordance after one more, drawn with
    that try as an arrow, its outcome in the title. Every panel shows the observation that the try was chosen on.

    Returns:
        Whether there was any rollout to draw; if not, no file is written.
    """
    adapter = Adapter(policy)
    episode = most_telling(first_episodes(evaluation), adapter)
    if episode is None:
        return False
    chosen, history = episode.rollout, episode.history
    panels = len(history) + 1
    figure = Figure(figsize=(3.6 * panels, 4.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid: Sequence[Axes] = figure.subplots(1, panels, squeeze=False)[0]
    dynamics = chosen.dynamics
    figure.suptitle(
        f"{policy.task}: {chosen.object.category} {chosen.object.id}, not seen in training "
        f"(hidden: mass {dynamics.part_mass:.2f}, joint friction {dynamics.joint_friction:.2f}, "
        f"surface friction {dynamics.surface_friction:.2f}, {dynamics.direction.value})",
        fontsize=9,
        parse_math=False,
    )
    observations = [history[0].observation, *(interaction.observation for interaction in history)]
    heat = [adapter.affordance(observation, history[:count]) for count, observation in enumerate(observations)]
    most = max(float(scores[o.movable].max()) for scores, o in zip(heat, observations, strict=True))
    images = [_draw_cloud(*panel, most) for panel in zip(grid, observations, heat, strict=True)]
    for count, axes in enumerate(grid):
        if count == 0:
            axes.set_title("before any try", fontsize=9)
            continue
        outcome = history[count - 1].outcome
        _draw_arrow(axes, history[count - 1])
        verdict = "success" if outcome.success else outcome.kind.value.replace("ok", "no success")
        axes.set_title(f"after try {count}: {verdict}, moved {outcome.motion:.3f}", fontsize=9)
    figure.colorbar(images[0], ax=list(grid), shrink=0.7, label="affordance (AAP)")
    figure.savefig(out, format="png")
    return True


def _project(points: Float, observation: Observation) -> Float:
    """Image coordinates (right, up) of points [..., 3]; the camera looks along x, with y to its left and z up."""
    camera_from_world = np.linalg.inv(observation.world_from_camera)
    seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    return np.stack([-seen[..., 1] / seen[..., 0], seen[..., 2] / seen[..., 0]], axis=-1)


def _draw_cloud(axes: Axes, observation: Observation, affordance: Float32, most: float) -> PathCollection:
    """Movable points coloured by affordance, the rest grey; what is nearer is drawn over what is farther."""
    seen = _project(observation.points.astype(np.float64), observation)
    static = ~observation.movable
    axes.scatter(seen[static, 0], seen[static, 1], s=5, color=BODY_COLOUR, linewidths=0)
    movable = np.flatnonzero(observation.movable)
    image = axes.scatter(
        seen[movable, 0], seen[movable, 1], c=affordance[movable], s=9, cmap=COLOURS, vmin=0, vmax=most, linewidths=0
    )
    axes.set_aspect("equal")
    axes.set_axis_off()
    return image


def _draw_arrow(axes: Axes, interaction: Interaction) -> None:
    """The approach of the try: the arrow's head is where the gripper touches."""
    action = interaction.action
    tail, head = _project(
        np.stack([action.point - ARROW_LENGTH * action.approach, action.point]), interaction.observation
    )
    colour = "tab:green" if interaction.outcome.success else "tab:red"
    axes.annotate("", xy=tuple(head), xytext=tuple(tail), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.5})
