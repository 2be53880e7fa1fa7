"""What each method knows and does after each budget of tries: the table, the adaptation curves, the first figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cluster.reporting.page import Cell, Drawing, Row, Section, Table, Tile, plain
from cluster.reporting.published import published
from cluster.reporting.style import COLOURS, SOFT, laid_out
from learner.evaluation import NO_TRIES_METHOD, ORACLE_METHOD, PRIOR_METHOD
from shared.methods import METHODS

Figures = Mapping[str, Any]
"""A row of summary.json: a method after a budget."""
WITHOUT_TRIES = (PRIOR_METHOD, NO_TRIES_METHOD, ORACLE_METHOD)
BEST_METHOD = "ours-final"
MEASURES = (("f_score", "F-score"), ("sample_success", "sample-success"))
"""Key in a row, and what people call it; both in percent on the page."""


@dataclass(frozen=True, slots=True)
class Results:
    """The results of a run.

    Attributes:
        task: what was evaluated.
        rows: of summary.json.
        novel_categories: whether the test objects are of categories that nothing was trained on.
    """

    task: str
    rows: Sequence[Figures]
    novel_categories: bool = False

    @property
    def budgets(self) -> list[int]:
        """Numbers of tries, ascending."""
        return sorted({row["budget"] for row in self.rows if row["budget"] > 0})

    @property
    def methods(self) -> list[str]:
        """In the order of the paper's table, and then what stands beside them."""
        order = [*METHODS, NO_TRIES_METHOD, ORACLE_METHOD]
        found = {row["method"] for row in self.rows}
        return [name for name in order if name in found] + sorted(found - set(order))

    def row(self, method: str, budget: int) -> Figures | None:
        """The row of a method at a budget; of those that try nothing, their only one will do."""
        own = [row for row in self.rows if row["method"] == method]
        exact = [row for row in own if row["budget"] == budget]
        if exact or method not in WITHOUT_TRIES or not own:
            return exact[0] if exact else None
        return own[0]

    def of_paper(self, method: str, budget: int, measure: str) -> float | None:
        """The paper's own figure, percent; of methods in one shot only where we have a row as well."""
        told = {str(name): each for name, each in published(self.task, novel_categories=self.novel_categories).items()}
        if method not in told or self.row(method, budget) is None:
            return None
        pair = told[method].at(budget)
        return None if pair is None else pair[measure == "sample_success"]


def results_section(results: Results) -> Section:
    """The table and the curves."""
    lead: tuple[str, ...] = (
        "F-score: whether the critic tells, at the threshold 0.5, which random interactions with unseen objects "
        "succeed. Sample-success: whether what the adapted affordance chooses succeeds when it is executed. In percent; "
        "the small figures are the limits of the 95% interval over objects. Bold: the best of a column, the oracle left "
        "out, which is told the hidden facts.",
    )
    if published(results.task, novel_categories=results.novel_categories):
        lead += (
            "In italics: the paper's own figures. Its objects, physics and random draws were others, so that orders "
            "and trends can be compared, but not single figures.",
        )
    return Section("results", "Methods and budgets", lead, (_table(results), _details(results)), (_curves(results),))


def tiles(results: Results) -> tuple[Tile, ...]:
    """What matters most, at the greatest budget."""
    if not results.budgets:
        return ()
    budget = results.budgets[-1]
    rows = {name: results.row(name, budget) for name in (PRIOR_METHOD, BEST_METHOD, ORACLE_METHOD)}
    made, prior, oracle = rows[BEST_METHOD], rows[PRIOR_METHOD], rows[ORACLE_METHOD]
    shown = []
    if made is not None:
        after = f"after {budget} tries" if budget != 1 else "after one try"
        shown.append(Tile(_percent(made["f_score"]), f"F-score of {BEST_METHOD} {after}"))
        shown.append(Tile(_percent(made["sample_success"]), f"sample-success of {BEST_METHOD} {after}"))
    if prior is not None:
        without = f"{_percent(prior['f_score'])} / {_percent(prior['sample_success'])}"
        shown.append(Tile(without, f"F-score / sample-success of {PRIOR_METHOD}, which tries nothing"))
    closed = _closed(prior, made, oracle)
    if closed is not None:
        shown.append(Tile(f"{100 * closed:.0f}%", "of the gap in cross entropy between it and the oracle closed"))
    return tuple(shown)


def _closed(prior: Figures | None, made: Figures | None, oracle: Figures | None) -> float | None:
    """The share of the gap in cross entropy that is closed; None where something is missing or there is no gap."""
    if prior is None or made is None or oracle is None:
        return None
    gap = prior["bce"] - oracle["bce"]
    return (prior["bce"] - made["bce"]) / gap if gap > 0 else None


def _table(results: Results) -> Table:
    budgets = results.budgets
    has_paper = bool(published(results.task, novel_categories=results.novel_categories))
    columns = [(measure, budget) for measure, _ in MEASURES for budget in budgets]
    width = 2 if has_paper else 1
    first: Row = (Cell("method", kind="name"), *(Cell(name, span=width * len(budgets)) for _, name in MEASURES))
    second: Row = (Cell("tries", kind="name"),)
    for _, budget in columns:
        second += (Cell(str(budget)),) + ((Cell("paper", kind="paper"),) if has_paper else ())
    best = {column: _best(results, *column) for column in columns}
    body = []
    for method in results.methods:
        cells: Row = (Cell(method, kind="name"),)
        for measure, budget in columns:
            to_beat = None if method == ORACLE_METHOD else best[measure, budget]
            cells += (_cell(results.row(method, budget), measure, to_beat),)
            if has_paper:
                paper = results.of_paper(method, budget, measure)
                cells += (Cell("" if paper is None else f"{paper:.1f}", kind="paper"),)
        body.append(cells)
    return Table((first, second), tuple(body))


def _best(results: Results, measure: str, budget: int) -> float | None:
    rows = [results.row(method, budget) for method in results.methods if method != ORACLE_METHOD]
    return max((row[measure] for row in rows if row is not None and row[measure] is not None), default=None)


def _cell(row: Figures | None, measure: str, best: float | None) -> Cell:
    if row is None or row[measure] is None:
        return Cell("")
    value, interval = row[measure], _interval(row, measure)
    note = "" if interval is None else f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f}"
    return Cell(f"{100 * value:.1f}", note, "best" if value == best else "")


def _interval(row: Figures, measure: str) -> tuple[float, float] | None:
    """Limits of a row's interval; None where it has none, as in runs of earlier software."""
    low, high = row.get(f"{measure}_low"), row.get(f"{measure}_high")
    return None if low is None or high is None else (low, high)


def _details(results: Results) -> Table:
    judged = ("budget", "f_score", "best_f", "bce", "auc", "base_rate", "queries")
    names = (*judged, "sample_success", "trials", "mean_tries")
    head: Row = (Cell("method", kind="name"), *(Cell(name.replace("_", " ")) for name in names))
    body = tuple(
        (Cell(row["method"], kind="name"), *(Cell(_number(row.get(name))) for name in names)) for row in results.rows
    )
    return Table((head,), body, "All figures of all rows", folded=True)


def _curves(results: Results) -> Drawing:
    figure = make_subplots(1, 2, subplot_titles=[f"{name} (%)" for _, name in MEASURES], horizontal_spacing=0.09)
    for column, (measure, _) in enumerate(MEASURES, start=1):
        for method in results.methods:
            _add_curve(figure, column, results, method, measure)
        paper = [(b, results.of_paper(BEST_METHOD, b, measure)) for b in results.budgets]
        known = [(budget, value) for budget, value in paper if value is not None]
        if known:
            _add_paper(figure, column, known)
    figure.update_xaxes(title_text="tries", tickmode="array", tickvals=[0, *results.budgets], range=[-0.3, None])
    figure.update_yaxes(rangemode="tozero")
    laid_out(figure, 430, legend={"orientation": "h", "y": -0.2, "x": 0.5, "xanchor": "center"})
    return Drawing(
        figure,
        "What tries teach. Level lines: what tries nothing, and the oracle. Bars: 95% intervals over objects. Click a "
        "name to hide it; double-click to see it alone.",
    )


def _add_curve(figure: go.Figure, column: int, results: Results, method: str, measure: str) -> None:
    level = method in WITHOUT_TRIES
    points = [(budget, row) for budget in results.budgets if (row := results.row(method, budget)) is not None]
    points = [(budget, row) for budget, row in points if row[measure] is not None]
    if not points:
        return
    if level:
        values = [row[measure] for _, row in points]
        points = [(budget, {measure: sum(values) / len(values)}) for budget in (0, results.budgets[-1])]
    limits = [_interval(row, measure) or (row[measure], row[measure]) for _, row in points]
    pairs = list(zip(points, limits, strict=True))
    figure.add_trace(
        go.Scatter(
            x=[budget for budget, _ in points],
            y=[100 * row[measure] for _, row in points],
            error_y={
                "type": "data",
                "array": [100 * (high - row[measure]) for (_, row), (_, high) in pairs],
                "arrayminus": [100 * (row[measure] - low) for (_, row), (low, _) in pairs],
                "thickness": 1,
                "width": 3,
                "visible": not level and method == BEST_METHOD,
            },
            name=plain(method),
            legendgroup=plain(method),
            showlegend=column == 1,
            mode="lines" if level else "lines+markers",
            line={
                "color": COLOURS.get(method, SOFT),
                "dash": "dash" if level else "solid",
                "width": 3.5 if method == BEST_METHOD else 1.8,
            },
            marker={"size": 9 if method == BEST_METHOD else 7},
            hovertemplate="%{y:.1f}",
        ),
        1,
        column,
    )


def _add_paper(figure: go.Figure, column: int, points: Sequence[tuple[int, float]]) -> None:
    figure.add_trace(
        go.Scatter(
            x=[budget for budget, _ in points],
            y=[value for _, value in points],
            name=f"the paper's {BEST_METHOD}",
            legendgroup="paper",
            showlegend=column == 1,
            mode="lines+markers",
            line={"color": COLOURS[BEST_METHOD], "dash": "dot", "width": 1.2},
            marker={"symbol": "circle-open", "size": 8},
            hovertemplate="%{y:.1f}",
        ),
        1,
        column,
    )


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _number(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
