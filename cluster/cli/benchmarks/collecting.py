"""How fast is collection? The same plan is collected several times by one worker, and by one worker and several."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from cluster.collection.status_writer import Tally
from collector.worker import Worker
from shared.errors import UsageError
from shared.io.files import scratch_folder
from shared.plan import ROLLOUTS_PER_SHARD, Plan, missing_jobs
from shared.progress import Advance
from shared.store import Store, info

STAGES = ("load", "settle", "observe", "propose", "simulate", "write")


@dataclass(frozen=True, slots=True)
class CollectionRun:
    """One timed collection into an empty store.

    Attributes:
        stages: wall seconds; "other" belongs to none of `STAGES`: restoring states, bookkeeping.
    """

    interactions: int
    successes: int
    cpu_s: float
    wall_s: float
    stages: dict[str, float]
    bytes_per_interaction: float
    digest: str


def collect(plan: Plan, folder: Path, rollouts: int, store: Store, advance: Advance) -> CollectionRun:
    """Collect the first rollouts of a plan in this process.

    Args:
        plan: what is collected.
        folder: of the objects.
        rollouts: how many.
        store: empty.
        advance: called after each job, of which there are `jobs_of(rollouts)`.

    Raises:
        UsageError: no object comes to rest in view of the camera.
    """
    worker, tally = Worker(store.path, folder), Tally()
    wall, cpu = time.perf_counter(), time.process_time()
    for job in missing_jobs(plan.key, rollouts, [], ROLLOUTS_PER_SHARD):
        tally.add(worker.run(plan, job))
        advance()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if not tally.interactions:
        raise UsageError(f"{folder}: no object comes to rest in view of the camera; nothing was collected")
    stages = {stage: tally.seconds.get(stage, 0.0) for stage in STAGES}
    return CollectionRun(
        interactions=tally.interactions,
        successes=tally.successes,
        cpu_s=cpu,
        wall_s=wall,
        stages=stages | {"other": wall - sum(stages.values())},
        bytes_per_interaction=info(store).bytes_per_interaction,
        digest=store.digest(),
    )


def jobs_of(rollouts: int) -> int:
    """How many jobs so many rollouts are."""
    return -(-rollouts // ROLLOUTS_PER_SHARD)


def summary(runs: Sequence[CollectionRun]) -> dict[str, Any]:
    """What `--json` prints of repeated collections of one plan: medians."""
    interactions = runs[0].interactions

    def by_stage(scale: Callable[[CollectionRun], float]) -> dict[str, float]:
        return {stage: median(run.stages[stage] * scale(run) for run in runs) for stage in runs[0].stages}

    return {
        "interactions_per_core_second": interactions / median(run.cpu_s for run in runs),
        "interactions_per_wall_second": interactions / median(run.wall_s for run in runs),
        "interactions": interactions,
        "repeats": len(runs),
        "success_rate": runs[0].successes / interactions,
        "bytes_per_interaction": runs[0].bytes_per_interaction,
        "digest": runs[0].digest,
        "stage_seconds": by_stage(lambda run: 1.0),
        "stage_core_seconds": by_stage(lambda run: run.cpu_s / run.wall_s),
    }


def speedup(plan: Plan, folder: Path, rollouts: int, repeats: int, workers: int, advance: Advance) -> dict[str, Any]:
    """Time the same jobs by one Ray worker and by several, turn by turn, with both worker groups alive.

    Args:
        plan: what is collected.
        folder: of the objects.
        rollouts: of each repeat; every repeat does others.
        repeats: how often.
        workers: of the larger worker group.
        advance: called after each of the 2 x (`repeats` + 1) turns, of which the first is not timed: actors start.

    Returns:
        `workers`, `workers_speedup` (median over the repeats), wall seconds of both, and whether both stores hold the
        same content.
    """
    # Ray is needed by several workers alone.
    from cluster.workers.job_queue import RolloutQueue
    from cluster.workers.ray_group import RayWorkerGroup
    from cluster.workers.session import ray_session
    from cluster.workers.worker_group import make_worker
    from collector.watchdog import Limits

    with scratch_folder("bench") as scratch, ExitStack() as stack:
        # The worker group that waits uses no processor.
        stack.enter_context(ray_session(workers + 1))
        stores, worker_groups = [], []
        for count in (1, workers):
            store = Store.create(scratch / f"store-{count}", plan.setting)
            worker_group = RayWorkerGroup(partial(make_worker, store.path, folder), store.crash_log, count, Limits())
            stack.callback(worker_group.close)
            stores.append(store)
            worker_groups.append(worker_group)
        walls: list[list[float]] = [[], []]
        for turn in range(repeats + 1):
            for worker_group, wall in zip(worker_groups, walls, strict=True):
                begun = time.perf_counter()
                queue = RolloutQueue(lambda: plan, [(turn * rollouts, (turn + 1) * rollouts)], ROLLOUTS_PER_SHARD)
                worker_group.run(queue, lambda _: None)
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
