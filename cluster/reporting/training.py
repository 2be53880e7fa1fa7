"""Training curves, from the metrics.jsonl that every stage of training leaves."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cluster.reporting.page import Drawing, Section, plain
from cluster.reporting.style import SEQUENCE, laid_out
from shared.errors import StoreError
from shared.io.documents import json_lines
from shared.io.files import read_bounded

METRICS_FILE = "metrics.jsonl"
MAX_METRICS_BYTES = 16 << 20
MAX_STAGES = 40
COLUMNS = 4
ROW_HEIGHT = 230
AFTER_TRIES = (("bce", "cross entropy (nats)"), ("f_score", "F-score"))
"""Validation measures of AAP that exist for each number of interactions, by the prefix of their names."""

Entry = Mapping[str, float]
"""A line of metrics: the finite numbers in it, "step" among them."""
Curve = Mapping[str, tuple[list[float], list[float]]]
"""Steps and values by the name of what was measured."""


def training_section(folder: Path, order: Sequence[str]) -> Section:
    """The curves of all stages below a run's folder of trainings.

    Args:
        folder: of the trainings.
        order: names of the run's stages in order of time, such as "train-prior".

    Raises:
        StoreError: a file is too large to be ours.
    """
    entries = {name: read_entries(path) for name, path in _metrics_files(folder, order).items()}
    curves = {name: curve for name, each in entries.items() if (curve := curves_of(each))}
    if not curves:
        return Section("training", "Training", ("No stage of training left metrics.",))
    lead = (
        "Losses on the training rows, and the score on held-out objects by which the best weights are chosen, against "
        "steps: the lower, the better. Each stage starts from the weights of the one before.",
    )
    last = {name: each[-1] for name, each in entries.items() if each}
    known = {name: {kind: after_tries(entry, kind) for kind, _ in AFTER_TRIES} for name, entry in last.items()}
    adapted = {name: each for name, each in known.items() if all(each.values())}
    drawings = [_drawing(curves), *([_adaptation(adapted)] if adapted else [])]
    return Section("training", "Training", lead, drawings=tuple(drawings))


def read_entries(path: Path) -> list[Entry]:
    """The lines of a file of metrics; those that a kill tore, or that are none of ours, are left out.

    Raises:
        StoreError: the file is too large to be ours.
    """
    entries: list[Entry] = []
    for entry in json_lines(read_bounded(path, MAX_METRICS_BYTES).splitlines()):
        numbers = {name: number for name, value in entry.items() if math.isfinite(number := _number(value))}
        if "step" in numbers:
            entries.append(numbers)
    return entries


def _number(value: object) -> float:
    """A number of JSON; NaN for what is none, or too large to be one."""
    try:
        return float(value) if isinstance(value, int | float) else math.nan
    except OverflowError:
        return math.nan


def curves_of(entries: Sequence[Entry]) -> Curve:
    """The losses and the score of a stage."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for entry in entries:
        for name, value in entry.items():
            if name == "score" or name.startswith("loss_"):
                steps, values = curves.setdefault(name, ([], []))
                steps.append(entry["step"])
                values.append(value)
    return curves


def after_tries(entry: Entry, kind: str) -> list[tuple[int, float]]:
    """A measure of a validation by number of interactions, such as `bce_after_4`."""
    matches = ((re.fullmatch(rf"{kind}_after_([0-9]{{1,4}})", name), value) for name, value in entry.items())
    return sorted((int(match[1]), value) for match, value in matches if match)


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
            trace = go.Scatter(
                x=steps,
                y=values,
                name=plain("score (held out)" if name == "score" else name.replace("_", " ")),
                legendgroup=plain(name),
                showlegend=name not in told,
                mode="lines+markers" if len(steps) < 8 else "lines",
                line={"color": colours[name], "width": 2.4 if name == "score" else 1.4},
                marker={"size": 5},
                hovertemplate="step %{x}: %{y:.4f}",
            )
            figure.add_trace(trace, place // COLUMNS + 1, place % COLUMNS + 1)
            told.add(name)
    figure.update_annotations(font_size=13)
    figure.update_yaxes(nticks=5, exponentformat="e")
    figure.update_xaxes(nticks=5)
    legend = {"orientation": "h", "y": -0.28 / rows, "x": 0.5, "xanchor": "center", "yanchor": "top"}
    return Drawing(laid_out(figure, ROW_HEIGHT * rows + 90, legend=legend, margin={"l": 45, "r": 20, "t": 40, "b": 90}))


def _adaptation(adapted: Mapping[str, Mapping[str, list[tuple[int, float]]]]) -> Drawing:
    """Measures of AAP on held-out objects by number of random interactions, at the end of each training."""
    figure = make_subplots(1, 2, subplot_titles=[title for _, title in AFTER_TRIES], horizontal_spacing=0.09)
    for place, (stage, known) in enumerate(adapted.items()):
        for column, (kind, _) in enumerate(AFTER_TRIES, start=1):
            trace = go.Scatter(
                x=[tries for tries, _ in known[kind]],
                y=[value for _, value in known[kind]],
                name=plain(stage),
                legendgroup=plain(stage),
                showlegend=column == 1,
                mode="lines+markers",
                line={"color": SEQUENCE[place % len(SEQUENCE)], "width": 2},
                marker={"size": 7},
                hovertemplate="%{x} interactions: %{y:.3f}",
            )
            figure.add_trace(trace, 1, column)
    figure.update_xaxes(title_text="interactions")
    laid_out(figure, 340, showlegend=True, legend={"orientation": "h", "y": -0.25, "x": 0.5, "xanchor": "center"})
    return Drawing(
        figure, "AAP's critic on held-out objects by number of random interactions, at the end of each training."
    )
