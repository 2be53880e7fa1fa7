"""Judges a policy on an evaluation store: `python -m cluster.judging STORE VERSION OUT AAP`, a process of its own.

AAP is the folder of the training stage that may have left an oracle. Like a learner it shares a process with neither
Ray nor SAPIEN.
"""

import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from learner.evaluation import PRIOR_METHOD, EvaluationRow, evaluate_store
from learner.oracle import read_oracle
from learner.recipes import ORACLE_FILE
from shared.errors import AdaAffordError
from shared.files import write_atomically
from shared.policy import Policy
from shared.store import Store
from shared.vocabulary import Role

RESULTS_FILE = "results.json"


def main(arguments: list[str]) -> int:
    """Write OUT/results.json; returns the exit code."""
    store, version, out, aap = Path(arguments[0]), int(arguments[1]), Path(arguments[2]), Path(arguments[3])
    try:
        rows = judge(Store.open(store), version, aap / ORACLE_FILE)
        write_atomically(out / RESULTS_FILE, json.dumps({"rows": rows}, indent=1, allow_nan=False).encode())
    except AdaAffordError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def judge(store: Store, version: int, oracle: Path) -> list[dict[str, Any]]:
    """The rows of summary.json, a method and a budget each.

    Args:
        store: the evaluation store.
        version: the policy.
        oracle: file of the oracle's weights; where AAP was trained without one, there is none.
    """
    config = store.setting.evaluation
    assert config is not None, "an evaluation store says what was evaluated"
    network = Policy.from_files(store.read_policy(version)).config
    told = read_oracle(oracle, network) if oracle.is_file() else None
    rows = []
    for row in evaluate_store(store, version, sorted(config.budgets), told):
        rows += _each_budget(row, store, sorted(config.budgets)) if row.method == PRIOR_METHOD else [row]
    return [_plain(row) for row in rows]


def _each_budget(row: EvaluationRow, store: Store, budgets: list[int]) -> list[EvaluationRow]:
    """The prior at each budget, to stand beside the others: only which actions were drawn differs."""
    table = store.interactions(["role", "method", "budget", "success"]).to_pylist()
    exploits = [r for r in table if r["role"] == Role.EXPLOIT.value and r["method"] == row.method]
    rows = []
    for budget in budgets:
        successes = [r["success"] for r in exploits if r["budget"] == budget]
        share = sum(successes) / len(successes) if successes else float("nan")
        rows.append(replace(row, budget=budget, sample_success=share, trials=len(successes)))
    return rows


def _plain(row: EvaluationRow) -> dict[str, Any]:
    """For JSON, which has no NaN; there it is null."""
    values = {"best_f" if name == "best_f_score" else name: value for name, value in asdict(row).items()}
    return {n: None if isinstance(v, float) and not math.isfinite(v) else v for n, v in values.items()}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
