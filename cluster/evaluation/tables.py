"""The table of an evaluation as files: results.json for programs, table.csv for spreadsheets, table.md for people.

`write_judgement` makes it in a process of its own: like a trainer, beside neither Ray nor SAPIEN.

They hold nothing of when, where and by how many workers they were made, so that an evaluation that was killed and run
again leaves the same bytes.
"""

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from learner.evaluation.table import NO_TRIES_METHOD, ORACLE_METHOD, PRIOR_METHOD, EvaluationRow, evaluate_store
from learner.stages.oracle import read_oracle
from learner.stages.trainers import ORACLE_FILE
from shared.formatting import csv_table, finite, markdown_table, percent
from shared.io.files import make_folder, write_atomically
from shared.io.text import markdown
from shared.policies.methods import METHODS, MethodName
from shared.policies.policy import Policy
from shared.store import Store

RESULTS_FILE, CSV_FILE, MARKDOWN_FILE = "results.json", "table.csv", "table.md"

Measure = Literal[
    "f_score", "sample_success", "start_success", "mix_f_score", "shifted_f_score", "share_success", "repeat_success"
]
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
BESIDE: Mapping[Measure, str] = {**LIKE_FOR_LIKE, "repeat_success": "from the start, repeated"}
"""What is shown only where it was measured."""
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
    **{str(name): shown for name, shown in BESIDE.items()},
}
"""Columns that people see, and what they call them."""
_PERCENT = frozenset({*MEASURES, *BESIDE, "gap_closed", "best_f"})
_ONLY_FOR_PROGRAMS = frozenset({"counts"})
BEST_METHOD: MethodName = "ours-final"
WITHOUT_TRIES = (PRIOR_METHOD, NO_TRIES_METHOD, ORACLE_METHOD)
ORDER = (*METHODS.names(), NO_TRIES_METHOD, ORACLE_METHOD)
"""Of rows: as in the paper's tables, and then what stands beside them."""


class ResultRows(BaseModel):
    """What is read of results.json; see `EvaluationTable`."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    task: str = Field("", max_length=100)
    objects: int = Field(ge=0)
    exploit_share: float | None = None
    rows: tuple[EvaluationRow, ...]


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
        rows: a row for each method and budget.
    """

    task: str
    seed: int
    objects: int
    rollouts: int
    policy_version: int
    exploit_share: float | None
    store_digest: str
    contents: Mapping[str, str]
    rows: tuple[EvaluationRow, ...]


def share_of_gap(low: float, value: float, high: float) -> float:
    """How far a value is from the one to the other; NaN where there is no way to go."""
    return (value - low) / (high - low) if high > low else math.nan


def write_tables(out: Path, table: EvaluationTable) -> None:
    """Write the three files; results.json comes last, so that where it is, all are."""
    make_folder(out)
    rows = [row.model_dump() for row in table.rows]
    write_atomically(out / CSV_FILE, csv_table(rows, _ONLY_FOR_PROGRAMS).encode())
    write_atomically(out / MARKDOWN_FILE, as_markdown(table).encode())
    write_atomically(out / RESULTS_FILE, json.dumps(asdict(table) | {"rows": rows}, allow_nan=False).encode())


def as_markdown(table: EvaluationTable) -> str:
    """The table as the paper has it, with 95% intervals; percent where the paper has percent."""
    measured = [name for name in BESIDE if any(row.value(name) is not None for row in table.rows)]
    shown = {name: title for name, title in _SHOWN.items() if name in measured or name not in BESIDE}
    first = next(iter(table.rows), None)
    natural, published = (None, None) if first is None else (first.base_rate, first.mix_base_rate)
    lines = [
        f"# {markdown(table.task)}",
        "",
        f"{table.rollouts} trials on {table.objects} test objects, seed {table.seed}, policy {table.policy_version}. "
        f"F-score at threshold 0.5 on random interactions, of which {percent(natural)}% succeed. In brackets: 95% "
        "bootstrap intervals over objects. Sample-success: in the state that the interactions left, as in the paper; "
        "from the start: in the start state. Gap closed: share of the gap in F-score between Where2Act and the oracle, "
        f"which is given the hidden facts. {beside_note(published, table.exploit_share, measured)} Digest of the "
        f"interactions: `{table.store_digest[:16]}`.",
        "",
        *markdown_table(list(shown.values()), ([_cell(row, name) for name in shown] for row in table.rows)),
    ]
    return "\n".join(lines) + "\n"


def beside_note(base_rate: float | None, share: float | None, measured: Collection[str]) -> str:
    """What the columns of `BESIDE` are, in a few sentences.

    Args:
        base_rate: of success in the published mix.
        share: of a cloud's points, from which actions by share were drawn; None: there were none.
        measured: those that are shown.
    """
    always_yes = None if base_rate is None else 2 * base_rate / (1 + base_rate)
    note = (
        "Published mix: the same interactions, weighted as the paper's test rollouts were topped up by label, of which "
        f"{percent(base_rate)}% succeed (a critic that always says yes has an F-score of {percent(always_yes)}); "
        "shifted: with logits moved by the change of the base rate."
    )
    if share is not None:
        note += (
            " Best share: the points of actions and of AIP's interactions are drawn from the best "
            f"{100 * share:g}% of the cloud (published: 1%), and the action is executed in the start state."
        )
    if "repeat_success" in measured:
        note += " Repeated: near an interaction that succeeded, with its rotation, if one did; not in the paper."
    return note


def _cell(row: EvaluationRow, name: str) -> str:
    value: object = getattr(row, name)
    if name in _PERCENT:
        return percent(row.value(name), row.interval(name) or ())
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else markdown(value)


def write_judgement(store: str, version: int, out: str, aap: str) -> None:
    """Write the table of the folder `out`.

    Args:
        store: the evaluation store.
        version: the policy.
        out: folder of the table.
        aap: folder of the training that may have left an oracle; without one the table lacks its row.
    """
    write_tables(Path(out), evaluate_policy(Store.open(store), version, Path(aap) / ORACLE_FILE))


def evaluate_policy(store: Store, version: int, oracle: Path) -> EvaluationTable:
    """The table, a row for each method and budget.

    Args:
        store: the evaluation store.
        version: the policy.
        oracle: file of the oracle's weights; where AAP was trained without one, there is none.
    """
    config = store.setting.evaluation
    assert config is not None, "an evaluation store says what was evaluated"
    network = Policy.from_files(store.read_policy(version)).config
    told = read_oracle(oracle, network) if oracle.is_file() else None
    budgets = sorted(config.budgets)
    rows: list[EvaluationRow] = []
    for row in evaluate_store(store, version, budgets, told):
        # The prior knows nothing of tries: all its actions count at every budget, to stand beside the others.
        alike = budgets if row.method == PRIOR_METHOD else [row.budget]
        rows += [row.model_copy(update={"budget": budget}) for budget in alike]
    tried = {name for row in rows if row.counts is not None for name in row.counts.object}
    return EvaluationTable(
        task=store.setting.task,
        seed=store.setting.seed,
        objects=len(tried),
        rollouts=sum(part.stop - part.start for part in store.parts()),
        policy_version=version,
        exploit_share=config.exploit_share,
        store_digest=store.digest(),
        contents={ref.id: ref.content_hash for ref in store.setting.objects if ref.id in tried},
        rows=tuple(row.model_copy(update={"gap_closed": _gap_closed(row, rows)}) for row in rows),
    )


def _gap_closed(row: EvaluationRow, rows: list[EvaluationRow]) -> float | None:
    """The share of the gap in F-score between Where2Act and the oracle that a method closes; None without a gap."""
    bounds = [next((r.f_score for r in rows if r.method == method), None) for method in (PRIOR_METHOD, ORACLE_METHOD)]
    low, value, high = (math.nan if share is None else share for share in (bounds[0], row.f_score, bounds[1]))
    closed: float | None = finite(share_of_gap(low, value, high))
    return closed
