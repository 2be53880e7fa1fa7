"""The table of an evaluation as files: results.json for programs, table.csv for spreadsheets, table.md for people.

They hold nothing of when, where and by how many workers they were made, so that an evaluation that was killed and run
again leaves the same bytes.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from learner.evaluation.table import NO_TRIES_METHOD, ORACLE_METHOD, PRIOR_METHOD
from shared.formatting import csv_table, markdown_table, percent
from shared.io.files import make_folder, write_atomically
from shared.io.text import markdown
from shared.policies.methods import METHODS, MethodName

RESULTS_FILE, CSV_FILE, MARKDOWN_FILE = "results.json", "table.csv", "table.md"

Measure = Literal["f_score", "sample_success", "start_success", "mix_f_score", "shifted_f_score", "share_success"]
MEASURES: Mapping[Measure, str] = {
    "f_score": "F-score",
    "sample_success": "sample-success",
    "start_success": "from the start",
}
"""What methods are compared by, and what people call it; the paper has no figures of the last."""
LIKE_FOR_LIKE: Mapping[Measure, str] = {
    "mix_f_score": "F, published mix",
    "shifted_f_score": "F, published mix, shifted",
    "share_success": "sample-success, best share",
}
"""The same measured as the paper did, so that absolute figures can be compared with its (docs/evaluation.md)."""
_SHOWN: Mapping[str, str] = {
    "method": "method",
    "budget": "interactions",
    **{str(name): shown for name, shown in MEASURES.items()},
    "gap_closed": "gap closed",
    "trials": "trials",
    "best_f": "best F",
    "bce": "BCE",
    "auc": "AUC",
    "mean_tries": "interactions made",
    **{str(name): shown for name, shown in LIKE_FOR_LIKE.items()},
}
"""Columns that people see, and what they call them."""
_PERCENT = frozenset({*MEASURES, *LIKE_FOR_LIKE, "gap_closed", "best_f"})
_ONLY_FOR_PROGRAMS = frozenset({"counts"})
BEST_METHOD: MethodName = "ours-final"
WITHOUT_TRIES = (PRIOR_METHOD, NO_TRIES_METHOD, ORACLE_METHOD)
ORDER = (*METHODS.names(), NO_TRIES_METHOD, ORACLE_METHOD)
"""Of rows: as in the paper's tables, and then what stands beside them."""


class ResultRow(BaseModel):
    """A row of results.json: a method after a budget. See `learner.evaluation.table.EvaluationRow`.

    What older versions did not measure is None in their files.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    method: str = Field(max_length=100)
    budget: int
    f_score: float | None
    f_score_low: float | None = None
    f_score_high: float | None = None
    sample_success: float | None
    sample_success_low: float | None = None
    sample_success_high: float | None = None
    start_success: float | None = None
    start_success_low: float | None = None
    start_success_high: float | None = None
    mix_f_score: float | None = None
    mix_f_score_low: float | None = None
    mix_f_score_high: float | None = None
    shifted_f_score: float | None = None
    shifted_f_score_low: float | None = None
    shifted_f_score_high: float | None = None
    share_success: float | None = None
    share_success_low: float | None = None
    share_success_high: float | None = None
    mix_base_rate: float | None = None
    trials: int
    gap_closed: float | None = None
    best_f: float | None
    bce: float | None
    auc: float | None
    base_rate: float | None
    queries: int
    mean_tries: float | None

    def value(self, measure: Measure) -> float | None:
        """One of the measures."""
        found: float | None = getattr(self, measure)
        return found

    def interval(self, measure: Measure) -> tuple[float, float] | None:
        """The limits of its 95% interval; None where it has none."""
        low, high = (getattr(self, f"{measure}_{end}") for end in ("low", "high"))
        return None if low is None or high is None else (low, high)


class ResultRows(BaseModel):
    """What is read of results.json."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    task: str = Field("", max_length=100)
    objects: int = Field(ge=0)
    exploit_share: float | None = None
    rows: tuple[ResultRow, ...]


@dataclass(frozen=True, slots=True)
class EvaluationTable:
    """What came of an evaluation.

    Attributes:
        task: what was evaluated.
        seed: of the evaluation.
        objects: how many there were trials of.
        rollouts: how many trials in all; each fills the interactions anew for every method.
        policy_version: of the policy that was evaluated.
        exploit_share: of a cloud's points, see `shared.plan.EvaluationConfig`.
        store_digest: of the interactions that the figures are of.
        contents: of these objects, SHA-256 by id, since runs call other objects the same.
        rows: a row for each method and budget: the fields of `learner.evaluation.table.EvaluationRow` ("best_f" for
            short), and "gap_closed", the share of the gap in F-score between Where2Act and the oracle; None: no figure.
    """

    task: str
    seed: int
    objects: int
    rollouts: int
    policy_version: int
    exploit_share: float | None
    store_digest: str
    contents: Mapping[str, str]
    rows: tuple[Mapping[str, Any], ...]


def share_of_gap(low: float, value: float, high: float) -> float:
    """How far a value is from the one to the other; NaN where there is no way to go."""
    return (value - low) / (high - low) if high > low else math.nan


def write_tables(out: Path, table: EvaluationTable) -> None:
    """Write the three files; results.json comes last, so that where it is, all are."""
    make_folder(out)
    write_atomically(out / CSV_FILE, csv_table(table.rows, _ONLY_FOR_PROGRAMS).encode())
    write_atomically(out / MARKDOWN_FILE, as_markdown(table).encode())
    write_atomically(out / RESULTS_FILE, json.dumps(asdict(table), allow_nan=False).encode())


def as_markdown(table: EvaluationTable) -> str:
    """The table as the paper has it, with 95% intervals; percent where the paper has percent."""
    measured = [name for name in LIKE_FOR_LIKE if any(row[name] is not None for row in table.rows)]
    shown = {name: title for name, title in _SHOWN.items() if name in measured or name not in LIKE_FOR_LIKE}
    natural, published = (next((row[name] for row in table.rows), None) for name in ("base_rate", "mix_base_rate"))
    lines = [
        f"# {markdown(table.task)}",
        "",
        f"{table.rollouts} trials on {table.objects} test objects, seed {table.seed}, policy {table.policy_version}. "
        f"F-score at threshold 0.5 on random interactions, of which {percent(natural)}% succeed. In brackets: 95% "
        "bootstrap intervals over objects. Sample-success: where the tries left the object, as in the paper; from the "
        "start: where they began. Gap closed: of that in F-score between Where2Act and the oracle, which is told the "
        f"hidden facts. {like_for_like_note(published, table.exploit_share)} Digest of the interactions: "
        f"`{table.store_digest[:16]}`.",
        "",
        *markdown_table(list(shown.values()), ([_cell(row, name) for name in shown] for row in table.rows)),
    ]
    return "\n".join(lines) + "\n"


def like_for_like_note(base_rate: float | None, share: float | None) -> str:
    """What the like-for-like columns are, in a few sentences.

    Args:
        base_rate: of success in the published mix.
        share: of a cloud's points, from which actions by share were drawn; None: there were none.
    """
    always_yes = None if base_rate is None else 2 * base_rate / (1 + base_rate)
    note = (
        "Published mix: the same questions, weighted as the paper's test rollouts were topped up by label, of which "
        f"{percent(base_rate)}% succeed (a critic that always says yes has an F-score of {percent(always_yes)}); "
        "shifted: with logits moved by the change of the base rate."
    )
    if share is not None:
        note += (
            f" Best share: the points of actions and of AIP's tries are drawn from the best {100 * share:g}% of the "
            "cloud (published: 1%), and the action is executed where the tries began."
        )
    return note


def _cell(row: Mapping[str, Any], name: str) -> str:
    value = row[name]
    if name in _PERCENT:
        return percent(value, (row.get(f"{name}_low"), row.get(f"{name}_high")))
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else markdown(value)
