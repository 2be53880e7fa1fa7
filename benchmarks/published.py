"""How many times faster is collection than the published protocol? Both execute some of the same trials."""

import resource
import subprocess
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import Field

from benchmarks import published_trial
from benchmarks.published_trial import PublishedRequest, PublishedTiming
from benchmarks.script import main
from cluster.cli.benchmarks.collecting import collect, jobs_of, summary
from cluster.cli.commands.bench import BenchSettings, planned, print_collection
from collector.objects.partnet import urdf_of
from shared.errors import WorkerError
from shared.io.interpreter import PYTHON, own_environment
from shared.plan import InteractionRecord, RolloutRecord
from shared.progress import Progress
from shared.store import Store

LIMIT_S = 600.0
"""For one trial."""


class PublishedSettings(BenchSettings):
    """Time what users run, and beside it the published protocol on a sample of the same trials."""

    rollouts: int = Field(120, ge=1, le=1_000_000)
    """Of each repeat: enough that most objects come again, as they do hundreds of times in a large collection."""
    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""
    sample: int = Field(9, ge=1, le=10_000)
    """Trials by the published protocol in all: a process and a scene each, a few seconds."""


@dataclass(frozen=True, slots=True)
class PublishedRun:
    """One trial by the published protocol; CPU seconds of its process, from start to end."""

    cpu_s: float
    timing: PublishedTiming
    same_label: bool


def measure(command: PublishedSettings) -> dict[str, Any]:
    """Measure, turn by turn, and print both."""
    runs, published = [], list[PublishedRun]()
    total = command.repeats * jobs_of(command.rollouts) + command.sample
    with planned(command) as (plan, folder), Progress(f"jobs and published trials, {command.task}", total) as progress:
        for turn in range(command.repeats):
            with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
                store = Store.create(Path(scratch) / "store", plan.setting)
                runs.append(collect(plan, folder, command.rollouts, store, progress.advance))
                for rollout, row in islice(_sample(store, command.sample), turn, None, command.repeats):
                    published.append(_execute(folder, rollout, row))
                    progress.advance()
    result = summary(runs)
    core_s, published_s = 1 / result["interactions_per_core_second"], mean(run.cpu_s for run in published)
    short_s = mean(run.cpu_s - run.timing.settle + run.timing.settle_short for run in published)
    stages = ("start", "load", "settle", "settle_short", "trial")
    seconds = {stage: mean(getattr(run.timing, stage) for run in published) for stage in stages}
    result |= {
        "times_published_protocol": published_s / core_s,
        "times_published_protocol_with_short_settling": short_s / core_s,
        "published_trials": len(published),
        "published_core_seconds_per_trial": published_s,
        "published_stage_seconds": seconds,
        "published_label_agreement": mean(run.same_label for run in published),
    }
    print_collection(result)
    print(f"published protocol, {len(published)} of the same trials")
    print(f"  core-seconds a trial          {published_s:.2f}")
    print(f"  of these                      {', '.join(f'{name} {each:.2f}' for name, each in seconds.items())}")
    print(f"  same label as stored          {result['published_label_agreement']:.0%}")
    print(f"times the published protocol    {published_s / core_s:.0f}")
    print(f"  with AdaAfford's settling     {short_s / core_s:.0f} (settle_short instead of settle)")
    return result


def _sample(store: Store, size: int) -> list[tuple[RolloutRecord, InteractionRecord]]:
    """Interactions spread evenly over what was stored."""
    rows = [
        (rollout, row)
        for manifest in store.committed()
        for rollout in store.read_rollouts(manifest.shard_id)
        for row in rollout.interactions
    ]
    return rows[:: max(1, len(rows) // size)][:size]


def _execute(folder: Path, rollout: RolloutRecord, row: InteractionRecord) -> PublishedRun:
    """Execute one stored trial in a fresh process.

    Raises:
        WorkerError: the process failed, or took longer than any trial may.
    """
    request = PublishedRequest(
        folder=folder if urdf_of(folder) is not None else folder / rollout.object.id,
        hidden=dict(rollout.dynamics.values),
        direction=rollout.dynamics.direction,
        joint_positions=tuple(row.joint_positions.tolist()),
        point=tuple(row.action.point.tolist()),
        rotation=tuple(row.action.rotation.ravel().tolist()),
        target_part=row.target_part,
        primitive=row.primitive,
    )
    before = _children_cpu_s()
    try:
        done = subprocess.run(
            [*PYTHON, published_trial.__file__],
            input=request.model_dump_json(),
            capture_output=True,
            text=True,
            env=own_environment() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        raise WorkerError(f"a published trial took more than {LIMIT_S:g} s ({request.folder})") from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1][:300]
        raise WorkerError(f"a published trial failed ({request.folder}): {reason}")
    timing = PublishedTiming.model_validate_json(done.stdout.splitlines()[-1])
    return PublishedRun(_children_cpu_s() - before, timing, timing.success == row.outcome.success)


def _children_cpu_s() -> float:
    """CPU seconds of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main("published", PublishedSettings, measure)
