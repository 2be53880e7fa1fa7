"""Training curves, from the metrics.jsonl that every stage of training leaves."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cluster.reporting.page import Drawing, Section, plain
from cluster.reporting.style import SEQUENCE, laid_out
from shared.errors import StoreError
from shared.files import read_bounded

METRICS_FILE = "metrics.jsonl"
MAX_METRICS_BYTES = 16 << 20
MAX_STAGES = 40
COLUMNS = 4
ROW_HEIGHT = 230

Curve = Mapping[str, tuple[list[int], list[float]]]
"""Steps and values by the name of what was measured."""


def training_section(folder: Path, order: Sequence[str]) -> Section:
    """The curves of all stages below a run's folder of trainings.

    Args:
        folder: of the trainings.
        order: names of the run's stages in order of time, such as "train-prior".

    Raises:
        StoreError: a file is too large to be ours.
    """
    curves = {name: read_metrics(path) for name, path in _metrics_files(folder, order).items()}
    curves = {name: curve for name, curve in curves.items() if curve}
    if not curves:
        return Section("training", "Training", ("No stage of training left metrics.",))
    lead = (
        "Losses on the training rows, and the score on held-out objects by which the best weights are chosen, against "
        "steps: the lower, the better. Each stage starts from the weights of the one before.",
    )
    return Section("training", "Training", lead, drawings=(_drawing(curves),))


def read_metrics(path: Path) -> Curve:
    """The losses and the score in a file of metrics; lines that a kill tore, or that are none of ours, are left out.

    Raises:
        StoreError: the file is too large to be ours.
    """
    curve: dict[str, tuple[list[int], list[float]]] = {}
    for line in read_bounded(path, MAX_METRICS_BYTES).splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(entry, dict) or not isinstance(entry.get("step"), int):
            continue
        for name, value in entry.items():
            shown = name == "score" or name.startswith("loss_")
            if shown and isinstance(value, int | float) and math.isfinite(value):
                steps, values = curve.setdefault(name, ([], []))
                steps.append(entry["step"])
                values.append(float(value))
    return curve


def _metrics_files(folder: Path, order: Sequence[str]) -> dict[str, Path]:
    """Files of metrics by stage, in order of time; what a stage trains last comes last."""
    found = [path for depth in ("*", "*/*") for path in folder.glob(f"{depth}/{METRICS_FILE}") if path.is_file()]
    if len(found) > 10 * MAX_STAGES:
        raise StoreError(f"{folder}: holds {len(found)} files of metrics, which no run leaves")
    times = {stage: place for place, stage in enumerate(order)}

    def place(path: Path) -> tuple[int, int, str]:
        stage, *inner = path.parent.relative_to(folder).parts
        within = 1 if not inner else 2 if inner == ["affordance"] else 0
        return times.get(f"train-{stage}", len(times)), within, str(path)

    return {str(path.parent.relative_to(folder)): path for path in sorted(found, key=place)[:MAX_STAGES]}


def _drawing(curves: Mapping[str, Curve]) -> Drawing:
    rows = -(-len(curves) // COLUMNS)
    figure = make_subplots(
        rows,
        COLUMNS,
        subplot_titles=[plain(name) for name in curves],
        horizontal_spacing=0.055,
        vertical_spacing=0.34 / rows,
    )
    names = sorted({name for curve in curves.values() for name in curve})
    colours = {name: SEQUENCE[place % len(SEQUENCE)] for place, name in enumerate(names)}
    told: set[str] = set()
    for place, curve in enumerate(curves.values()):
        for name, (steps, values) in curve.items():
            figure.add_trace(
                go.Scatter(
                    x=steps,
                    y=values,
                    name=plain("score (held out)" if name == "score" else name.replace("_", " ")),
                    legendgroup=plain(name),
                    showlegend=name not in told,
                    mode="lines+markers" if len(steps) < 8 else "lines",
                    line={"color": colours[name], "width": 2.4 if name == "score" else 1.4},
                    marker={"size": 5},
                    hovertemplate="step %{x}: %{y:.4f}",
                ),
                place // COLUMNS + 1,
                place % COLUMNS + 1,
            )
            told.add(name)
    figure.update_annotations(font_size=13)
    figure.update_yaxes(nticks=5, exponentformat="e")
    figure.update_xaxes(nticks=5)
    legend = {"orientation": "h", "y": -0.28 / rows, "x": 0.5, "xanchor": "center", "yanchor": "top"}
    return Drawing(laid_out(figure, ROW_HEIGHT * rows + 90, legend=legend, margin={"l": 45, "r": 20, "t": 40, "b": 90}))
