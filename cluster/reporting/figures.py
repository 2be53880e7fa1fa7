"""Figures of what was collected: base rates, how far parts moved, how trials ended. From the store alone."""

from collections import Counter
from typing import Any

import numpy as np

from shared.store import Store
from shared.types import OutcomeKind

MOTION_EDGES = (0.0, 1e-4, 1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0, float("inf"))
"""Of the motion histogram, rad or length; 0.01 is the least that can be a success."""
_COLUMNS = ("object_category", "proposer", "policy_version", "outcome", "motion", "success")


def collection_figures(store: Store) -> dict[str, Any]:
    """What summary.json says of a store's interactions; those that infrastructure failed are counted, not judged."""
    table = store.interactions(_COLUMNS).to_pydict()
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    labels = [row for row in rows if OutcomeKind(row["outcome"]).is_label]
    random = [row for row in labels if row["proposer"] == "random"]
    outcomes = Counter(row["outcome"] for row in rows)
    proposed = sorted({(row["policy_version"], row["proposer"]) for row in rows})
    return {
        "interactions": len(rows),
        "by_proposer": [
            {"proposer": name, "policy_version": version}
            | _rate([row for row in labels if (row["policy_version"], row["proposer"]) == (version, name)])
            for version, name in proposed
        ],
        "random_success_by_category": {
            category: _rate([row for row in random if row["object_category"] == category])
            for category in sorted({row["object_category"] for row in random})
        },
        "random_motion_histogram": _histogram([row["motion"] for row in random]),
        "outcomes": {name: {"count": n, "share": n / len(rows)} for name, n in sorted(outcomes.items())},
    }


def _rate(rows: list[dict[str, Any]]) -> dict[str, Any]:
    successes = sum(row["success"] for row in rows)
    rate = successes / len(rows) if rows else None
    return {"interactions": len(rows), "successes": successes, "success_rate": rate}


def _histogram(motions: list[float]) -> list[dict[str, Any]]:
    """Counts of motions in [low, high); JSON has no infinity, so the last `high` is null."""
    counts, _ = np.histogram(motions, MOTION_EDGES)
    highs = [high if np.isfinite(high) else None for high in MOTION_EDGES[1:]]
    return [
        {"low": low, "high": high, "count": int(count)}
        for low, high, count in zip(MOTION_EDGES[:-1], highs, counts, strict=True)
    ]
