"""Adaptation curves of finished trainings, as curve.json, curve.csv, curve.md, and curve.png to look at."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from learner.evaluation.curve import CurveRow, ProposalGain
from shared.formatting import csv_table, finite, markdown_table, percent
from shared.io.files import make_folder, write_atomically
from shared.io.text import markdown

JSON_FILE, CSV_FILE, MARKDOWN_FILE, FIGURE_FILE = "curve.json", "curve.csv", "curve.md", "curve.png"
CRITICS = {
    "where2act": "Where2Act",
    "random": "AAP, random interactions",
    "aip": "AAP, interactions by AIP",
    "information": "AAP, interactions by expected information",
    "oracle": "oracle, given the hidden facts",
}
COLUMNS = (
    *("training", "critic", "interactions", "F-score", "gap closed", "best F", "BCE", "AUC", "ECE"),
    "from no interactions",
)
GAIN_COLUMNS = (
    "interactions",
    "by a random one",
    "by AIP's choice",
    "by the best, in hindsight",
    "loss before",
    "correlation",
)
_STYLES = {"random": ("tab:blue", "o"), "aip": ("tab:orange", "s"), "information": ("tab:green", "^")}
_LINES = ("-", "--", ":", "-.")


@dataclass(frozen=True, slots=True)
class Curves:
    """What came of judging some trainings on a store.

    Attributes:
        task: of the store.
        digest: of the store's content.
        rollouts: how many were judged on, of objects that no training had seen.
        left_out: rollouts of the store that were not, for their objects had been seen.
        draws: how often interactions and questions were drawn from each rollout.
        rows: of all trainings.
        gains: of the first run of each training that has an AIP, by its name.
    """

    task: str
    digest: str
    rollouts: int
    left_out: int
    draws: int
    rows: tuple[CurveRow, ...]
    gains: Mapping[str, Sequence[ProposalGain]]


def write_curves(out: Path, curves: Curves) -> None:
    """Write the four files; curve.json comes last. Raises as `make_folder` does."""
    make_folder(out)
    write_atomically(out / CSV_FILE, csv_table(as_json(curves)["rows"]).encode())
    write_atomically(out / MARKDOWN_FILE, as_markdown(curves).encode())
    draw_curves(curves, out / FIGURE_FILE)
    write_atomically(out / JSON_FILE, json.dumps(as_json(curves), indent=1, allow_nan=False).encode())


def as_json(curves: Curves) -> dict[str, Any]:
    """All of it as JSON has it; null for no figure."""
    found: dict[str, Any] = finite(asdict(curves))
    return found


def as_markdown(curves: Curves) -> str:
    """Tables of all runs together, and what each next interaction tells."""
    pooled = [row for row in curves.rows if not row.run]
    base_rate = pooled[0].base_rate
    lines = [
        f"# {markdown(curves.task)}: what critics know after some interactions",
        "",
        f"{curves.rollouts} stored rollouts on {pooled[0].objects} objects that no training saw, each drawn "
        f"{curves.draws} times: half of its interactions are candidates for the context, the other half are queries; "
        f"{100 * base_rate:.1f}% of these succeed. F-score at threshold 0.5. Gap closed: of that in cross entropy "
        "between Where2Act and the oracle, which is given the hidden facts; in the last column, between AAP without "
        "interactions and the oracle. In brackets: 95% bootstrap intervals over objects, all seeds together. Digest of "
        f"the interactions: `{curves.digest[:16]}`.",
        "",
        *markdown_table(COLUMNS, map(_cells, pooled), left=2),
    ]
    lines += ["", "By run (F-score / gap closed):", "", *_by_run(curves.rows)]
    for name, gains in curves.gains.items():
        lines += [
            "",
            f"Drop of the loss on the queries by the next interaction, in thousandths of a nat ({markdown(name)}, its "
            "first run):",
            "",
            *markdown_table(GAIN_COLUMNS, map(_gain_cells, gains), left=0),
        ]
    return "\n".join(lines) + "\n"


def _cells(row: CurveRow) -> list[str]:
    return [
        markdown(row.name),
        CRITICS[row.critic],
        str(row.tries),
        percent(row.f_score, (row.f_score_low, row.f_score_high)),
        percent(row.closed, (row.closed_low, row.closed_high)),
        percent(row.best_f_score),
        f"{row.bce:.4f}",
        f"{row.auc:.3f}",
        f"{row.calibration_error:.3f}",
        percent(row.closed_from_none),
    ]


def _gain_cells(gain: ProposalGain) -> list[str]:
    drops = [f"{1e3 * drop:.1f}" for drop in (gain.random, gain.aip, gain.greedy)]
    return [str(gain.before), *drops, f"{1e3 * gain.loss:.0f}", f"{gain.correlation:.2f}"]


def _by_run(rows: Sequence[CurveRow]) -> list[str]:
    """A line for each run, a column for each critic and number of interactions."""
    asked = list(dict.fromkeys((row.critic, row.tries) for row in rows))
    runs = list(dict.fromkeys((row.name, row.run) for row in rows if row.run))
    found = {(row.name, row.run, row.critic, row.tries): row for row in rows}
    table = []
    for name, run in runs:
        cells = [markdown(name), markdown(run)]
        for critic, tries in asked:
            row = found.get((name, run, critic, tries))
            cells.append("-" if row is None else f"{percent(row.f_score)} / {percent(row.closed)}")
        table.append(cells)
    return markdown_table(("training", "run", *(f"{critic} {tries}" for critic, tries in asked)), table, left=2)


def draw_curves(curves: Curves, path: Path) -> None:
    """F-score and share of the gap that is closed by number of interactions, with intervals over objects."""
    figure = Figure(figsize=(10, 5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    pooled = [row for row in curves.rows if not row.run]
    names = list(dict.fromkeys(row.name for row in pooled))
    for place, name in enumerate(names):
        own = [row for row in pooled if row.name == name]
        line = _LINES[place % len(_LINES)]
        for critic, (colour, marker) in _STYLES.items():
            made = [row for row in own if row.critic == critic]
            if not made:
                continue
            tries, label = [row.tries for row in made], f"{CRITICS[critic]} ({name})"
            for axes, figure_name in ((left, "f_score"), (right, "closed")):
                low, high = ([getattr(row, f"{figure_name}_{end}") for row in made] for end in ("low", "high"))
                axes.plot(
                    tries, [getattr(row, figure_name) for row in made], line, color=colour, marker=marker, label=label
                )
                axes.fill_between(tries, low, high, color=colour, alpha=0.12, linewidth=0)
    for row in pooled:
        if row.name == names[0] and row.critic in ("where2act", "oracle"):  # Level lines.
            colour = "0.5" if row.critic == "where2act" else "black"
            left.axhline(row.f_score, color=colour, linewidth=1, label=CRITICS[row.critic])
    right.axhline(0.0, color="0.5", linewidth=1)
    right.axhline(1.0, color="black", linewidth=1)
    left.set_ylabel("F-score at threshold 0.5")
    right.set_ylabel("closed share of the gap in cross entropy")
    for axes in (left, right):
        axes.set_xlabel("interactions")
        axes.grid(alpha=0.3)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(f"{curves.task}: {pooled[0].objects} objects not seen in training", fontsize=10)
    figure.savefig(path, format="png")
