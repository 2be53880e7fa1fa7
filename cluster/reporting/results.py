"""The results of each method after each number of interactions: table, adaptation curves, main figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cluster.evaluation.published import STANDS_BESIDE, published, published_figure
from cluster.evaluation.tables import (
    BESIDE,
    BEST_METHOD,
    MEASURES,
    ORDER,
    WITHOUT_TRIES,
    Measure,
    ResultRows,
    beside_note,
)
from cluster.reporting.page import Cell, Drawing, Row, Section, Table, Tile, plain, shortened
from cluster.reporting.style import COLOURS, SOFT, laid_out
from cluster.runs.run_folder import read_json
from learner.evaluation.table import ORACLE_METHOD, PRIOR_METHOD, EvaluationRow
from shared.config import parse
from shared.formatting import number, percent


class Results(ResultRows):
    """The results of one evaluation.

    Attributes:
        novel_categories: whether the test objects are of categories that nothing was trained on.
    """

    novel_categories: bool = False

    @property
    def budgets(self) -> list[int]:
        """Numbers of interactions, ascending."""
        return sorted({row.budget for row in self.rows if row.budget > 0})

    @property
    def methods(self) -> list[str]:
        """In the order of the paper's table, and then what stands beside them."""
        found = {row.method for row in self.rows}
        return [name for name in ORDER if name in found] + sorted(found - set(ORDER))

    @property
    def has_paper(self) -> bool:
        """Whether the paper has figures for the task."""
        return bool(published(self.task, novel_categories=self.novel_categories))

    def row(self, method: str, budget: int) -> EvaluationRow | None:
        """The row of a method at a budget; methods without interactions have a single row."""
        own = [row for row in self.rows if row.method == method]
        exact = next((row for row in own if row.budget == budget), None)
        return own[0] if exact is None and own and method in WITHOUT_TRIES else exact

    def of_paper(self, method: str, budget: int, measure: Measure) -> float | None:
        """The paper's own figure, percent, where we have a row as well."""
        if self.row(method, budget) is None:
            return None
        return published_figure(self.task, method, budget, measure, novel_categories=self.novel_categories)

    def best(self, measure: Measure, budget: int) -> float | None:
        """The highest figure of a column, the oracle's left out."""
        rows = [self.row(method, budget) for method in self.methods if method != ORACLE_METHOD]
        return max((value for row in rows if row and (value := row.value(measure)) is not None), default=None)


def read_results(path: Path, task: str = "", *, novel_categories: bool = False) -> Results:
    """The results in a file that an evaluation wrote.

    Args:
        path: results.json.
        task: what was evaluated, where the file does not say so itself.
        novel_categories: see `Results`.

    Raises:
        StoreError: the file is missing or no JSON.
        UsageError: it does not hold results.
    """
    read = parse(Results, read_json(path), str(path))
    return read.model_copy(update={"task": read.task or task, "novel_categories": novel_categories})


def results_section(results: Results) -> Section:
    """The table and the curves of the run's own evaluation."""
    lead: tuple[str, ...] = (
        "F-score: of the critic at threshold 0.5, for the success of random interactions with unseen objects. "
        "Sample-success: of the action that the adapted affordance chooses, executed in the state that the "
        "interactions left, as in the paper; from the start: in the state in which they began, which all methods "
        "share. In percent; the small figures are the limits of the 95% interval over objects. Bold: the best of a "
        "column, without the oracle, which is given the hidden facts.",
    )
    if results.has_paper:
        lead += (
            "In italics: the paper's own figures. Its objects, physics and random draws differ, so rankings and trends "
            "can be compared, but not single figures.",
        )
    tables = (table_of(results), *like_for_like(results), details_of(results))
    return Section("results", "Methods and budgets", lead, tables=tables, drawings=(_curves(results),))


def further_section(evaluations: Sequence[tuple[str, Results]]) -> Section:
    """Tables of evaluations on other objects, by their names."""
    tables: list[Table] = []
    for name, results in evaluations:
        tables += [table_of(results, f"{shortened(name)}: {shortened(results.task)}"), *like_for_like(results)]
    return Section(
        "further", "Further evaluations", ("Of the same policy, by `adaafford evaluate`.",), tables=tuple(tables)
    )


def tiles(results: Results) -> tuple[Tile, ...]:
    """What matters most, at the greatest budget."""
    if not results.budgets:
        return ()
    budget = results.budgets[-1]
    made, prior = results.row(BEST_METHOD, budget), results.row(PRIOR_METHOD, budget)
    shown = []
    if made is not None:
        after = f"after {budget} interactions" if budget != 1 else "after one interaction"
        shown.append(Tile(percent(made.f_score), f"F-score of {BEST_METHOD} {after}"))
        shown.append(Tile(percent(made.sample_success), f"sample-success of {BEST_METHOD} {after}"))
    if prior is not None:
        without = f"{percent(prior.f_score)} / {percent(prior.sample_success)}"
        shown.append(Tile(without, f"F-score / sample-success of {PRIOR_METHOD}, without interactions"))
    if made is not None and made.gap_closed is not None:
        label = f"of the gap in F-score between {PRIOR_METHOD} and the oracle closed"
        shown.append(Tile(f"{100 * made.gap_closed:.0f}%", label))
    return tuple(shown)


def like_for_like(results: Results) -> tuple[Table, ...]:
    """The table of what was measured as in the paper, and beside it; none for files that older versions wrote."""
    found = {name for name in BESIDE for row in results.rows if row.value(name) is not None}
    measured = {name: shown for name, shown in BESIDE.items() if name in found}
    if not measured:
        return ()
    base_rate = next((row.mix_base_rate for row in results.rows), None)
    note = beside_note(base_rate, results.exploit_share, measured)
    return (table_of(results, f"Like for like with the paper. {note}", measured),)


def table_of(results: Results, caption: str = "", measures: Mapping[Measure, str] = MEASURES) -> Table:
    """Methods by budgets, beside the paper's."""
    columns = [(measure, budget) for measure in measures for budget in results.budgets]
    beside = {measure for measure in measures if results.has_paper and measure in STANDS_BESIDE}
    second: Row = (Cell("interactions", kind="name"),)
    for measure, budget in columns:
        second += (Cell(str(budget)), *([Cell("paper", kind="paper")] if measure in beside else []))
    body = []
    for method in results.methods:
        cells: Row = (Cell(method, kind="name"),)
        for measure, budget in columns:
            to_beat = None if method == ORACLE_METHOD else results.best(measure, budget)
            cells += (_cell(results.row(method, budget), measure, to_beat),)
            if measure in beside:
                paper = results.of_paper(method, budget, measure)
                cells += (Cell("" if paper is None else f"{paper:.1f}", kind="paper"),)
        body.append(cells)
    spans = [(name, (2 if measure in beside else 1) * len(results.budgets)) for measure, name in measures.items()]
    first: Row = (Cell("method", kind="name"), *(Cell(name, span=span) for name, span in spans))
    return Table((first, second), tuple(body), caption)


def details_of(results: Results) -> Table:
    """Everything that is known of every row."""
    names = [name for name in EvaluationRow.model_fields if name not in ("task", "method", "counts")]
    head: Row = (Cell("method", kind="name"), *(Cell(name.replace("_", " ")) for name in names))
    body = tuple(
        (Cell(row.method, kind="name"), *(Cell(number(getattr(row, name))) for name in names)) for row in results.rows
    )
    return Table((head,), body, "All figures of all rows", folded=True)


def _cell(row: EvaluationRow | None, measure: Measure, best: float | None) -> Cell:
    if row is None or (value := row.value(measure)) is None:
        return Cell("")
    interval = row.interval(measure)
    note = "" if interval is None else f"{100 * interval[0]:.0f}\u2013{100 * interval[1]:.0f}"
    return Cell(f"{100 * value:.1f}", note, "best" if value == best and value > 0 else "")


def _curves(results: Results) -> Drawing:
    titles = [f"{name} (%)" for name in MEASURES.values()]
    figure = make_subplots(1, len(MEASURES), subplot_titles=titles, horizontal_spacing=0.06)
    for column, measure in enumerate(MEASURES, start=1):
        for method in results.methods:
            curve = _level(results, method, measure) if method in WITHOUT_TRIES else _curve(results, method, measure)
            if curve is not None:
                figure.add_trace(curve.update(showlegend=column == 1), 1, column)
        paper = [
            (b, value) for b in results.budgets if (value := results.of_paper(BEST_METHOD, b, measure)) is not None
        ]
        if paper:
            figure.add_trace(_paper_curve(paper).update(showlegend=column == 1), 1, column)
    figure.update_xaxes(title_text="interactions", tickmode="array", tickvals=[0, *results.budgets], range=[-0.3, None])
    figure.update_yaxes(rangemode="tozero")
    laid_out(figure, 460, legend={"orientation": "h", "y": -0.3, "x": 0.5, "xanchor": "center"})
    return Drawing(
        figure,
        "Results by number of interactions. Horizontal lines: methods without interactions, and the oracle. Bars: 95% "
        "intervals over objects. Click a name to hide it; double-click to see it alone.",
    )


def _level(results: Results, method: str, measure: Measure) -> go.Scatter | None:
    """A horizontal line at the mean of a method without interactions."""
    rows = [row for budget in results.budgets if (row := results.row(method, budget)) is not None]
    values = [value for row in rows if (value := row.value(measure)) is not None]
    if not values:
        return None
    mean = 100 * sum(values) / len(values)
    line = {"color": COLOURS.get(method, SOFT), "dash": "dash", "width": 1.8}
    return _line(method, [0, results.budgets[-1]], [mean, mean], line).update(mode="lines")


def _curve(results: Results, method: str, measure: Measure) -> go.Scatter | None:
    rows = [row for budget in results.budgets if (row := results.row(method, budget)) is not None]
    points = [(row.budget, value, row.interval(measure)) for row in rows if (value := row.value(measure)) is not None]
    if not points:
        return None
    ours = method == BEST_METHOD
    line = {"color": COLOURS.get(method, SOFT), "width": 3.5 if ours else 1.8}
    curve = _line(method, [budget for budget, _, _ in points], [100 * value for _, value, _ in points], line)
    curve.update(marker={"size": 9 if ours else 7})
    if ours:
        limits = [(value, interval or (value, value)) for _, value, interval in points]
        above, below = [100 * (high - v) for v, (_, high) in limits], [100 * (v - low) for v, (low, _) in limits]
        curve.update(error_y={"type": "data", "array": above, "arrayminus": below, "thickness": 1, "width": 3})
    return curve


def _paper_curve(points: Sequence[tuple[int, float]]) -> go.Scatter:
    line = {"color": COLOURS[BEST_METHOD], "dash": "dot", "width": 1.2}
    name = f"the paper's {BEST_METHOD}"
    curve = _line(name, [budget for budget, _ in points], [value for _, value in points], line)
    return curve.update(marker={"symbol": "circle-open", "size": 8})


def _line(name: str, x: Sequence[int], y: Sequence[float], line: Mapping[str, object]) -> go.Scatter:
    label = plain(name)
    return go.Scatter(
        x=x, y=y, name=label, legendgroup=label, mode="lines+markers", line=dict(line), hovertemplate="%{y:.1f}"
    )
