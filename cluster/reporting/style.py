"""How the figures of a page look (one colour a method, one typeface, no ornament), and its words for hidden facts."""

from typing import Any

import plotly.graph_objects as go

from shared.hidden import hidden_parameter
from shared.types import Direction, HiddenDynamics, Outcome

FONT = 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif'
INK, SOFT, GRID = "#1d2530", "#5c6672", "#e6eaef"
ACCENT, SECOND = "#b3123c", "#2b6cb0"
SUCCESS, FAILURE, PROPOSED = "#148a3d", "#d11f2f", "#111111"
COLOURS = {
    "ours-final": ACCENT,
    "ours-no-iteration": "#e07b39",
    "ours-spread": "#e35d7c",
    "ours-gain": "#8c6d1f",
    "ours-value": "#c9a227",
    "ours-fps": SECOND,
    "ours-argfps": "#63a4d9",
    "ours-purefps": "#9cc3e6",
    "ours-random": "#2a9d8f",
    "where2act-adaptation": "#8a63b8",
    "where2act-interaction": "#c39bd9",
    "where2act": "#7a828c",
    "aap-no-tries": "#b0b6bd",
    "oracle": "#000000",
}
"""Of the methods, and of what stands beside them."""
SEQUENCE = (SECOND, ACCENT, "#2a9d8f", "#e07b39", "#8a63b8", "#7a828c")
"""Of lines that are no methods."""


def laid_out(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """The figure with what all have in common, at a height in pixels."""
    figure.update_layout(
        height=height,
        template="none",
        font={"family": FONT, "size": 13, "color": INK},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        margin={"l": 60, "r": 20, "t": 40, "b": 50},
        hoverlabel={"font": {"family": FONT}},
    )
    axis = {"gridcolor": GRID, "linecolor": SOFT, "zeroline": False, "ticks": "outside", "tickcolor": GRID}
    figure.update_xaxes(automargin=True, **axis)
    figure.update_yaxes(automargin=True, **axis)
    figure.update_layout(**layout)
    return figure


def hidden(dynamics: HiddenDynamics) -> str:
    """Hidden dynamics in words."""
    text = ", ".join(number(name, f"{value:.2f}") for name, value in dynamics.values.items())
    return text if dynamics.direction is Direction.AS_BUILT else f"{text}, {turning(dynamics.direction)}"


def number(name: str, value: str) -> str:
    """A hidden parameter with its value, and its unit where the package that adds it is installed."""
    parameter = hidden_parameter(name)
    unit = "" if parameter is None or not parameter.unit else f" {parameter.unit}"
    return f"{name.replace('_', ' ')} {value}{unit}"


def turning(direction: Direction) -> str:
    """Which way a joint turns."""
    return "turns both ways" if direction is Direction.BOTH else f"turns {direction.value}"


def verdict(outcome: Outcome) -> str:
    """The outcome of an interaction in a few words."""
    result = "success" if outcome.success else outcome.kind.value.replace("ok", "no success")
    return f"{result}, moved {outcome.motion:.3f}"


def after(tries: int) -> str:
    """After how many interactions something holds."""
    return "before any interaction" if tries == 0 else f"after {tries} interaction{'' if tries == 1 else 's'}"
