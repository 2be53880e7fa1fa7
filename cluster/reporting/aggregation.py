"""One table of several runs of a task, such as seeds of one campaign: pooled, run by run, beside the paper's figures.

An object that several runs were tested on counts once, with the trials of all of them.

Files: comparison.md and comparison.png for people, comparison.csv and comparison.json for programs.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pydantic import model_validator

from cluster.evaluation.published import PUBLISHED_MEASURES, STANDS_BESIDE, published_figure
from cluster.evaluation.tables import (
    BESIDE,
    BEST_METHOD,
    MEASURES,
    ORDER,
    RESULTS_FILE,
    WITHOUT_TRIES,
    ResultRows,
    beside_note,
    share_of_gap,
)
from cluster.reporting.style import COLOURS, SOFT
from cluster.runs.run_folder import RunFolder, find, read_json
from learner.evaluation.table import ORACLE_METHOD, PRIOR_METHOD, EvaluationRow, ObjectCounts
from shared.config import parse
from shared.errors import UsageError
from shared.formatting import csv_table, finite, markdown_table, number, percent
from shared.io.files import make_folder, write_atomically
from shared.io.text import markdown
from shared.store import Store

MARKDOWN_FILE, CSV_FILE, JSON_FILE, FIGURE_FILE = (f"comparison.{kind}" for kind in ("md", "csv", "json", "png"))
MOST = 1 << 40
"""Of anything that is counted."""
AVERAGED = ("best_f", "bce", "auc", "base_rate", "mix_base_rate", "mean_tries")
"""Figures that do not follow from counts: their means over runs."""

COLUMNS = (
    *("method", "interactions", "F-score", "paper", "sample-success", "paper", "from the start"),
    *("gap closed", "best F", "BCE", "AUC"),
)
"""Of the table that people see."""
_ALL_MEASURES = (*MEASURES, *BESIDE)
_COUNTED = tuple(field.name for field in fields(ObjectCounts) if field.name != "object")
_ALWAYS_COUNTED = frozenset(field.name for field in fields(ObjectCounts) if field.default is MISSING)


class _Row(EvaluationRow):
    counts: ObjectCounts

    @model_validator(mode="after")
    def _whole(self) -> "_Row":
        columns = [column for name in _COUNTED if (column := getattr(self.counts, name)) or name in _ALWAYS_COUNTED]
        if any(len(column) != len(self.counts.object) for column in columns):
            raise ValueError("counts of different lengths; evaluate again")
        if any(not 0 <= number <= MOST for column in columns for number in column):
            raise ValueError(f"counts that are not between 0 and {MOST}; evaluate again")
        return self


class _Results(ResultRows):
    seed: int
    rollouts: int
    contents: Mapping[str, str]
    rows: tuple[_Row, ...]


@dataclass(frozen=True, slots=True)
class _Tested:
    """What a run was found to do, and on what."""

    results: _Results
    novel_categories: bool


@dataclass(frozen=True, slots=True)
class PooledRow:
    """A method at a budget over all runs; shares with their 95% intervals over objects, None for no figure.

    Attributes:
        method: which method.
        budget: how many interactions.
        shares: of each of `MEASURES` and `BESIDE`: the figure, and where its interval begins and ends.
        by_run: of each of these: the figure in each run.
        paper: of each of `PUBLISHED_MEASURES`: the paper's own figure, percent; None where it has none.
        gap_closed: the share of the gap in F-score between Where2Act and the oracle.
        trials: how many actions were executed from the state that the interactions left.
        averages: of each of `AVERAGED`, the mean over runs.
    """

    method: str
    budget: int
    shares: Mapping[str, tuple[float, float, float]]
    by_run: Mapping[str, tuple[float, ...]]
    paper: Mapping[str, float | None]
    gap_closed: float
    trials: int
    averages: Mapping[str, float]

    def flat(self) -> dict[str, Any]:
        """One column each, for CSV and JSON."""
        flat: dict[str, Any] = {"method": self.method, "budget": self.budget}
        for name, (value, low, high) in self.shares.items():
            flat |= {name: value, f"{name}_low": low, f"{name}_high": high}
            flat |= {f"{name}_run_{run}": each for run, each in enumerate(self.by_run[name], start=1)}
        flat |= {f"paper_{name}": None if value is None else value / 100 for name, value in self.paper.items()}
        flat |= {"gap_closed": self.gap_closed, "trials": self.trials} | dict(self.averages)
        return {name: finite(value) for name, value in flat.items()}


@dataclass(frozen=True, slots=True)
class Comparison:
    """What came of pooling.

    Attributes:
        task: of all runs.
        seeds: of the runs' evaluations.
        rollouts: trials in all runs.
        objects: different objects that were tested on.
        novel_categories: whether nothing was trained on any of their categories.
        base_rate: of success among random interactions, mean over runs.
        exploit_share: of a cloud's points, from which actions by share were drawn; None: not in all runs.
        rows: in the order of the paper's tables.
    """

    task: str
    seeds: tuple[int, ...]
    rollouts: int
    objects: int
    novel_categories: bool
    base_rate: float
    exploit_share: float | None
    rows: tuple[PooledRow, ...]


def pool(runs: Sequence[Path], evaluation: str | None) -> Comparison:
    """Pool evaluations of several runs.

    Args:
        runs: their folders.
        evaluation: how the name of one folder in each RUN/evaluations begins; None: the evaluation that a run ends
            with.

    Raises:
        UsageError: a folder is no run or lacks the evaluation, the runs are of different tasks, share no method, or
            only some were tested on novel categories.
        StoreError: a file is damaged.
    """
    if not runs or len({path.resolve() for path in runs}) < len(runs):
        raise UsageError("name the folders of one run or several, each once")
    tested = [_tested(find(path)[0], evaluation) for path in runs]
    results = [each.results for each in tested]
    for place, each in enumerate(results):
        if each in results[:place]:
            # A copy of a run, say, or a run of the same seed: its trials would count twice.
            same = runs[results.index(each)]
            raise UsageError(f"{runs[place]} holds the very trials of {same}; name runs of different seeds, each once")
    if len({each.novel_categories for each in tested}) > 1:
        raise UsageError("only some of the runs were tested on novel categories; compare them apart")
    if len(tasks := sorted({each.task for each in results})) > 1:
        raise UsageError(f"the runs are of different tasks ({', '.join(tasks)}); give runs of one task")
    shares = {each.exploit_share for each in results}
    if len(shares - {None}) > 1:
        given = ", ".join(f"{share:g}" for share in sorted(share for share in shares if share is not None))
        raise UsageError(f"the runs were evaluated with different exploit_share ({given}); compare them apart")
    common = set.intersection(*({(row.method, row.budget) for row in each.rows} for each in results))
    if not common:
        raise UsageError("the runs share no method and budget; evaluate them alike")
    novel = tested[0].novel_categories
    rows = [_pooled(method, budget, results, novel) for method, budget in sorted(common, key=_place)]
    f_scores = {row.method: row.shares["f_score"][0] for row in reversed(rows)}
    prior, oracle = (f_scores.get(method, math.nan) for method in (PRIOR_METHOD, ORACLE_METHOD))
    return Comparison(
        task=tasks[0],
        seeds=tuple(each.seed for each in results),
        rollouts=sum(each.rollouts for each in results),
        objects=len({each.contents.get(name, name) for each in results for name in each.rows[0].counts.object}),
        novel_categories=novel,
        base_rate=rows[0].averages["base_rate"],
        exploit_share=None if None in shares else next(iter(shares)),
        rows=tuple(replace(row, gap_closed=share_of_gap(prior, row.shares["f_score"][0], oracle)) for row in rows),
    )


def _tested(run: RunFolder, evaluation: str | None) -> _Tested:
    if evaluation is None:
        folder, objects = run.training("evaluate"), run.objects_used().test
    else:
        folder = _evaluation_called(run, evaluation)
        objects = Store.open(folder / "store").setting.objects
    path = folder / RESULTS_FILE
    if not path.is_file():
        raise UsageError(f"{folder}: holds no {RESULTS_FILE}; finish the run first")
    return _Tested(parse(_Results, read_json(path), str(path)), run.are_novel(objects))


def _evaluation_called(run: RunFolder, begins: str) -> Path:
    """The one finished evaluation whose name begins so; names end in a digest that differs between seeds."""
    known = sorted(path.parent for path in run.evaluations.glob(f"*/{RESULTS_FILE}"))
    found = [path for path in known if path.name == begins] or [path for path in known if path.name.startswith(begins)]
    if len(found) != 1:
        there = f"it has {', '.join(path.name for path in known)}" if known else "evaluate the run first"
        many = "several evaluations" if found else "no finished evaluation"
        raise UsageError(f"{run.evaluations}: {many} called '{begins}'; {there}")
    return found[0]


def _place(key: tuple[str, int]) -> tuple[int, str, int]:
    method, budget = key
    return ORDER.index(method) if method in ORDER else len(ORDER), method, budget


def _pooled(method: str, budget: int, results: Sequence[_Results], novel_categories: bool) -> PooledRow:
    task = results[0].task
    rows = [next(row for row in each.rows if (row.method, row.budget) == (method, budget)) for each in results]
    counts = [row.counts for row in rows]
    # Objects are called by what they are, because runs call other objects the same.
    called = [
        tuple(of.contents.get(name, name) for name in each.object) for each, of in zip(counts, results, strict=True)
    ]
    together = _together([replace(each, object=names) for each, names in zip(counts, called, strict=True)])
    averages = {}
    for name in AVERAGED:
        known = [value for row in rows if (value := getattr(row, name)) is not None]
        averages[name] = float(np.mean(known)) if known else math.nan
    return PooledRow(
        method=method,
        budget=budget,
        shares={name: together.share(name) for name in _ALL_MEASURES},
        by_run={name: tuple(each.share(name)[0] for each in counts) for name in _ALL_MEASURES},
        paper={
            measure: published_figure(task, method, budget, measure, novel_categories=novel_categories)
            for measure in PUBLISHED_MEASURES
        },
        gap_closed=math.nan,
        trials=sum(together.trials),
        averages=averages,
    )


def _together(counts: Sequence[ObjectCounts]) -> ObjectCounts:
    """The sums over runs, by object; what one of them did not count is not counted."""
    names = sorted({name for each in counts for name in each.object})
    numbers = {name: number for number, name in enumerate(names)}
    sums: dict[str, tuple[Any, ...]] = {}
    for name in _COUNTED:
        columns = [getattr(each, name) for each in counts]
        if name in _ALWAYS_COUNTED or all(columns):
            total = np.zeros(len(names), dtype=np.result_type(*map(np.asarray, columns)))
            for each, column in zip(counts, columns, strict=True):
                np.add.at(total, [numbers[own] for own in each.object], column)
            sums[name] = tuple(total.tolist())
    return ObjectCounts(object=tuple(names), **sums)


def write_comparison(out: Path, comparison: Comparison) -> None:
    """Write the four files; comparison.json comes last. Raises as `make_folder` does."""
    make_folder(out)
    rows = [row.flat() for row in comparison.rows]
    write_atomically(out / CSV_FILE, csv_table(rows).encode())
    write_atomically(out / MARKDOWN_FILE, as_markdown(comparison).encode())
    draw_comparison(comparison, out / FIGURE_FILE)
    told = {"task": comparison.task, "seeds": comparison.seeds, "objects": comparison.objects}
    told |= {"novel_categories": comparison.novel_categories, "rows": rows}
    write_atomically(out / JSON_FILE, json.dumps(told, indent=1, allow_nan=False).encode())


def as_markdown(comparison: Comparison) -> str:
    """The pooled table beside the paper's figures, and the table run by run."""
    runs = "run (seed" if len(comparison.seeds) == 1 else "runs (seeds"
    novel = ", of categories that none saw" if comparison.novel_categories else ""
    lines = [
        f"# {markdown(comparison.task)}: all methods",
        "",
        f"{comparison.rollouts} trials on {comparison.objects} objects that no training saw{novel}, "
        f"{len(comparison.seeds)} {runs} {_seeds(comparison)}). In percent; in brackets "
        "95% bootstrap intervals over objects, all together. "
        "F-score of the critic at threshold 0.5 on random interactions, of which "
        f"{percent(comparison.base_rate)}% succeed. Sample-success: of the chosen action in the state that the "
        "interactions left, as in the paper; from the start: in the state in which they began. Gap closed: the share "
        "of the gap in F-score between Where2Act and the oracle, which is given the hidden facts. The paper's figures "
        "are of other objects and another simulator, so only rankings and trends can be compared.",
        "",
        *markdown_table(COLUMNS, map(_cells, comparison.rows)),
        "",
        *_like_for_like(comparison),
        "Run by run (F-score / sample-success / from the start):",
        "",
        *markdown_table(
            ("method", "interactions", *(f"seed {seed}" for seed in comparison.seeds)),
            ([markdown(row.method), str(row.budget), *_by_run(row)] for row in comparison.rows),
        ),
    ]
    return "\n".join(lines) + "\n"


def _cells(row: PooledRow) -> list[str]:
    return [
        markdown(row.method),
        str(row.budget),
        _with_limits(row.shares["f_score"]),
        _of_paper(row.paper["f_score"]),
        _with_limits(row.shares["sample_success"]),
        _of_paper(row.paper["sample_success"]),
        _with_limits(row.shares["start_success"]),
        percent(row.gap_closed),
        percent(row.averages["best_f"]),
        number(row.averages["bce"]),
        number(row.averages["auc"]),
    ]


def _like_for_like(comparison: Comparison) -> list[str]:
    """A table of what was measured as in the paper, and beside it, and an empty line; none of older versions' runs."""
    rows = comparison.rows
    measured = [name for name in BESIDE if not all(math.isnan(row.shares[name][0]) for row in rows)]
    if not measured:
        return []
    head, cells = ["method", "interactions"], [[markdown(row.method), str(row.budget)] for row in rows]
    for name in measured:
        head += [BESIDE[name], *(["paper"] if name in STANDS_BESIDE else [])]
        for row, of_row in zip(rows, cells, strict=True):
            of_row.append(_with_limits(row.shares[name]))
            if name in STANDS_BESIDE:
                of_row.append(_of_paper(row.paper[STANDS_BESIDE[name]]))
    note = beside_note(rows[0].averages["mix_base_rate"], comparison.exploit_share, measured)
    return [f"Like for like with the paper. {note}", "", *markdown_table(head, cells), ""]


def _by_run(row: PooledRow) -> list[str]:
    each = zip(*(row.by_run[name] for name in MEASURES), strict=True)
    return [" / ".join(map(percent, values)) for values in each]


def draw_comparison(comparison: Comparison, path: Path) -> None:
    """Each measure against the number of interactions; methods without interactions are horizontal lines."""
    figure = Figure(figsize=(13, 5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(MEASURES))
    methods = list(dict.fromkeys(row.method for row in comparison.rows))
    colours = {method: COLOURS.get(method, SOFT) for method in methods}
    for axes, (measure, name) in zip(panels, MEASURES.items(), strict=True):
        for method in methods:
            rows = [row for row in comparison.rows if row.method == method]
            values = [100 * row.shares[measure][0] for row in rows]
            budgets = [row.budget for row in rows]
            if method in WITHOUT_TRIES:
                axes.axhline(values[0], color=colours[method], linestyle="--", linewidth=1.2, label=method)
                continue
            ours = method == BEST_METHOD
            axes.plot(budgets, values, "o-", color=colours[method], linewidth=3 if ours else 1.3, label=method)
            if ours:
                low, high = ([100 * row.shares[measure][end] for row in rows] for end in (1, 2))
                axes.fill_between(budgets, low, high, color=colours[method], alpha=0.15, linewidth=0)
        axes.set_title(f"{name} (%)", fontsize=10)
        axes.set_xlabel("interactions")
        axes.set_xticks(sorted({row.budget for row in comparison.rows if row.budget}))
        axes.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    title = f"{comparison.task}: {comparison.objects} unseen objects, seed {_seeds(comparison)}"
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, format="png")


def _seeds(comparison: Comparison) -> str:
    return ", ".join(map(str, comparison.seeds))


def _with_limits(share: tuple[float, float, float]) -> str:
    return percent(share[0], share[1:], decimals=0)


def _of_paper(figure: float | None) -> str:
    return "" if figure is None else f"*{figure:.1f}*"
