"""What further workers bring: the same jobs by a fleet of one and by a fleet of several, turn by turn."""

import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from cluster.fleet import make_worker
from cluster.orders import Series
from cluster.ray_fleet import RayFleet
from cluster.session import ray_session
from collector.guard import Limits
from shared.plan import ROLLOUTS_PER_SHARD, Plan
from shared.progress import Advance
from shared.store import Store


def speedup(plan: Plan, folder: Path, rollouts: int, repeats: int, workers: int, advance: Advance) -> dict[str, Any]:
    """Time both fleets on live actors.

    Args:
        plan: what is collected.
        folder: of the objects.
        rollouts: of each repeat; every repeat does others.
        repeats: how often.
        workers: of the larger fleet.
        advance: called after each of the 2 x (`repeats` + 1) turns, of which the first is not timed: actors start.

    Returns:
        `workers`, `workers_speedup` (median over the repeats), wall seconds of both, and whether both stores hold the
        same content.
    """
    with TemporaryDirectory(prefix="adaafford-bench-") as scratch, ExitStack() as stack:
        # Both fleets are alive at once, so that turns follow each other; the one that waits uses no processor.
        stack.enter_context(ray_session(workers + 1))
        stores, fleets = [], []
        for count in (1, workers):
            store = Store.create(Path(scratch) / f"store-{count}", plan.setting)
            fleet = RayFleet(partial(make_worker, store.path, folder), store.underway, count, Limits())
            stack.callback(fleet.close)
            stores.append(store)
            fleets.append(fleet)
        walls: list[list[float]] = [[], []]
        for turn in range(repeats + 1):
            for fleet, wall in zip(fleets, walls, strict=True):
                begun = time.perf_counter()
                orders = Series(lambda: plan, [(turn * rollouts, (turn + 1) * rollouts)], ROLLOUTS_PER_SHARD)
                fleet.run(orders, lambda _: None)
                wall.append(time.perf_counter() - begun)
                advance()
        alone, together = (wall[1:] for wall in walls)
        return {
            "workers": workers,
            "workers_speedup": median(one / many for one, many in zip(alone, together, strict=True)),
            "one_worker_wall_seconds": alone,
            "workers_wall_seconds": together,
            "same_digest": stores[0].digest() == stores[1].digest(),
        }
