"""Judges a policy on an evaluation store, in a process of its own: like a trainer, beside neither Ray nor SAPIEN."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from cluster.evaluation.tables import EvaluationTable, share_of_gap, write_tables
from learner.evaluation.table import ORACLE_METHOD, PRIOR_METHOD, EvaluationRow, evaluate_store
from learner.stages.oracle import read_oracle
from learner.stages.trainers import ORACLE_FILE
from shared.formatting import finite
from shared.policies.policy import Policy
from shared.store import Store


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
        rows += [replace(row, budget=budget) for budget in budgets] if row.method == PRIOR_METHOD else [row]
    tried = {name for row in rows for name in row.counts.object}
    return EvaluationTable(
        task=store.setting.task,
        seed=store.setting.seed,
        objects=len(tried),
        rollouts=sum(part.stop - part.start for part in store.parts()),
        policy_version=version,
        exploit_share=config.exploit_share,
        store_digest=store.digest(),
        contents={ref.id: ref.content_hash for ref in store.setting.objects if ref.id in tried},
        rows=tuple(finite(_values(row) | {"gap_closed": _gap_closed(row, rows)}) for row in rows),
    )


def _gap_closed(row: EvaluationRow, rows: list[EvaluationRow]) -> float:
    """The share of the gap in F-score between Where2Act and the oracle that a method closes; NaN without such a gap."""
    prior, oracle = (next((r.f_score for r in rows if r.method == m), math.nan) for m in (PRIOR_METHOD, ORACLE_METHOD))
    return share_of_gap(prior, row.f_score, oracle)


def _values(row: EvaluationRow) -> dict[str, Any]:
    return {"best_f" if name == "best_f_score" else name: value for name, value in asdict(row).items()}
