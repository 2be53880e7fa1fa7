"""Clouds that turn under the mouse: points coloured by what a network says of them, and actions as arrows.

Shapes: N points of a cloud.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from cluster.reporting.style import FAILURE, PROPOSED, SOFT, SUCCESS, laid_out
from shared.types import Action, Float, Float32, Interaction, Observation

MOVABLE_POINTS, STATIC_POINTS = 1200, 600
"""Kept of a cloud. Any prefix of a cloud in furthest-point order covers the object."""
ARROW_LENGTH = 0.32
"""Of an approach, in the cloud's units."""
HEAD = 0.3
"""Of an arrow's head, as a share of its length."""
BODY_COLOUR = "#c9ced4"
COLOURS = "Viridis"
TANGENT, PANEL_WIDTH = 0.414, 0.8
"""Of half plotly's vertical field of view, 45 deg; and how wide a panel is at the least, in heights."""
PANEL_HEIGHT = 330


@dataclass(frozen=True, slots=True)
class Arrow:
    """An action, drawn along its approach with the head where the gripper touches."""

    action: Action
    colour: str


@dataclass(frozen=True, slots=True)
class CloudView:
    """One cloud.

    Attributes:
        title: above it; went through `plain`, and may hold <br>.
        observation: the cloud.
        values: of every point, [N]; only movable points are coloured.
        arrows: the actions.
        scale: number of the colour scale; panels of one number can be compared by colour.
    """

    title: str
    observation: Observation
    values: Float32
    arrows: tuple[Arrow, ...] = ()
    scale: int = 0


def tried(interaction: Interaction) -> Arrow:
    """The arrow of an executed action: green where it succeeded, else red."""
    return Arrow(interaction.action, SUCCESS if interaction.outcome.success else FAILURE)


def proposed(action: Action) -> Arrow:
    """The arrow of an action that is yet to be executed."""
    return Arrow(action, PROPOSED)


def draw_panels(panels: Sequence[CloudView], columns: int, scales: Sequence[str]) -> go.Figure:
    """Clouds side by side, all in the same frame and seen from where the camera of the first stood."""
    rows = -(-len(panels) // columns)
    figure = make_subplots(
        rows,
        columns,
        specs=[[{"type": "scene"}] * columns for _ in range(rows)],
        subplot_titles=[panel.title for panel in panels],
        horizontal_spacing=0.01,
        vertical_spacing=0.12 / rows if rows > 1 else 0.0,
    )
    for place, panel in enumerate(panels):
        for trace in _traces(panel):
            figure.add_trace(trace, place // columns + 1, place % columns + 1)
    frame = _frame(panels)
    figure.update_scenes(**frame)
    figure.update_annotations(font_size=13)
    height = PANEL_HEIGHT * rows + 70
    laid_out(figure, height, margin={"l": 0, "r": 0, "t": 80, "b": 0}, showlegend=False, hovermode="closest")
    figure.update_layout(modebar={"bgcolor": "rgba(0,0,0,0)", "color": "#b0b6bd", "activecolor": SOFT})
    for number, name in enumerate(scales):
        values = [panel.values[panel.observation.movable] for panel in panels if panel.scale == number]
        figure.update_layout({_axis(number): _colour_axis(name, values, number, len(scales))})
    return figure


def _traces(panel: CloudView) -> list[Any]:
    observation = panel.observation
    movable = np.flatnonzero(observation.movable)[:MOVABLE_POINTS]
    static = np.flatnonzero(~observation.movable)[:STATIC_POINTS]
    traces = [
        _points(observation, static, {"color": BODY_COLOUR, "size": 2.2}, hoverinfo="skip"),
        _points(
            observation,
            movable,
            {"color": panel.values[movable].astype(np.float32), "coloraxis": _axis(panel.scale), "size": 3.2},
            hovertemplate="%{marker.color:.3f}<extra></extra>",
        ),
    ]
    for arrow in panel.arrows:
        traces += _arrow(arrow)
    return traces


def _points(observation: Observation, index: NDArray[np.int64], marker: dict[str, Any], **rest: Any) -> go.Scatter3d:
    x, y, z = observation.points[index].astype(np.float32).T.copy()
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker={"line": {"width": 0}, **marker}, **rest)


def _arrow(arrow: Arrow) -> list[Any]:
    approach, tip = arrow.action.approach, arrow.action.point
    tail, neck = tip - ARROW_LENGTH * approach, tip - 0.5 * HEAD * ARROW_LENGTH * approach
    shaft = np.stack([tail, neck], axis=1).tolist()
    u, v, w = approach.tolist()
    return [
        go.Scatter3d(
            x=shaft[0], y=shaft[1], z=shaft[2], mode="lines", line={"color": arrow.colour, "width": 7}, hoverinfo="skip"
        ),
        go.Cone(
            x=[tip[0]],
            y=[tip[1]],
            z=[tip[2]],
            u=[u],
            v=[v],
            w=[w],
            anchor="tip",
            sizemode="absolute",
            sizeref=HEAD * ARROW_LENGTH,
            colorscale=[[0, arrow.colour], [1, arrow.colour]],
            showscale=False,
            hoverinfo="skip",
        ),
    ]


def _frame(panels: Sequence[CloudView]) -> dict[str, Any]:
    """What all scenes have in common: the box around everything that is drawn, and the eye."""
    reach = [panel.observation.points.astype(np.float64) for panel in panels]
    for panel in panels:
        reach += [_ends(arrow) for arrow in panel.arrows]
    everything = np.concatenate(reach)
    low, high = everything.min(axis=0), everything.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    axis = {"visible": False, "showspikes": False}
    ratio = dict(zip("xyz", (size / size.max()).tolist(), strict=True))
    eye = _eye((everything - (low + high) / 2) / size.max(), panels[0].observation.world_from_camera)
    ranges = {
        f"{name}axis": {**axis, "range": [float(a), float(b)]} for name, a, b in zip("xyz", low, high, strict=True)
    }
    return {
        **ranges,
        "aspectmode": "manual",
        "aspectratio": ratio,
        "dragmode": "orbit",
        "camera": {"eye": dict(zip("xyz", eye.tolist(), strict=True)), "up": {"x": 0, "y": 0, "z": 1}},
    }


def _eye(points: Float, world_from_camera: Float) -> Float:
    """Where the eye stands, [3]: in the direction of the camera, as near as shows all points, [N, 3]."""
    forward, left, up = world_from_camera[:3, :3].T
    reach = np.maximum(np.abs(points @ left) / PANEL_WIDTH, np.abs(points @ up)) / TANGENT
    eye: Float = -forward * float((reach - points @ forward).max())
    return eye


def _ends(arrow: Arrow) -> Float:
    tip = arrow.action.point
    return np.stack([tip, tip - ARROW_LENGTH * arrow.action.approach])


def _axis(number: int) -> str:
    return "coloraxis" if number == 0 else f"coloraxis{number + 1}"


def _colour_axis(name: str, values: Sequence[Float32], number: int, count: int) -> dict[str, Any]:
    """One scale from what is lowest to what is highest in any of its panels, so that their colours compare."""
    everything = np.concatenate(list(values))
    low, high = (float(everything.min()), float(everything.max())) if len(everything) else (0.0, 1.0)
    share = 1.0 / count
    return {
        "colorscale": COLOURS,
        "cmin": low,
        "cmax": max(high, low + 1e-6),
        "colorbar": {
            "title": {"text": name, "side": "right"},
            "thickness": 12,
            "len": 0.8 * share,
            "y": 1.0 - share * (number + 0.5),
            "tickformat": ".3~g",
            "nticks": 5,
        },
    }
