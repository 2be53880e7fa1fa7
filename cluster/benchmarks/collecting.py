"""How fast is collection? What users run is timed, and beside it the published protocol on some of the same trials."""

import resource
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any

from cluster.progress import Tally
from collector.partnet import urdf_of
from collector.published import PublishedRequest, PublishedTiming
from collector.worker import Worker
from shared.errors import UsageError, WorkerError
from shared.interpreter import PYTHON, own_environment
from shared.plan import ROLLOUTS_PER_SHARD, Job, Plan, missing_jobs
from shared.progress import Advance
from shared.records import InteractionRecord, RolloutRecord
from shared.store import Store, info

STAGES = ("load", "settle", "observe", "propose", "simulate", "write")
PUBLISHED_LIMIT_S = 600.0


@dataclass(frozen=True, slots=True)
class CollectionRun:
    """One timed collection into a store of its own."""

    interactions: int
    successes: int
    cpu_s: float
    wall_s: float
    stages: dict[str, float]
    """Wall seconds; "other" is what belongs to none of `STAGES`: putting states back, bookkeeping."""
    bytes_per_interaction: float
    digest: str


@dataclass(frozen=True, slots=True)
class PublishedRun:
    """One trial by the published protocol; CPU seconds of its process, from start to end."""

    cpu_s: float
    timing: PublishedTiming
    same_label: bool

    @property
    def short_settling_s(self) -> float:
        """With AdaAfford's settling instead of Where2Act's."""
        return self.cpu_s - self.timing.settle + self.timing.settle_short


@dataclass(slots=True)
class CollectionBenchmark:
    """Repeated collections of the same plan, and a sample of its trials by the published protocol, turn by turn.

    Attributes:
        plan: what is collected.
        folder: of the objects.
        rollouts: of each repeat.
        repeats: how often.
        sample: trials by the published protocol in all.
    """

    plan: Plan
    folder: Path
    rollouts: int
    repeats: int
    sample: int
    collected: list[CollectionRun] = field(default_factory=list)
    published: list[PublishedRun] = field(default_factory=list)

    def run(self, advance: Advance) -> None:
        """Measure; `advance` is called after each job and each published trial."""
        for turn in range(self.repeats):
            with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
                store = Store.create(Path(scratch) / "store", self.plan.setting)
                self.collected.append(self._collect(store, advance))
                self._publish(store, turn, advance)

    @property
    def steps(self) -> int:
        """How often `run` will call `advance`, if all goes well."""
        return self.repeats * len(self._jobs()) + self.sample

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        interactions = self.collected[0].interactions
        core_s = median(run.cpu_s for run in self.collected) / interactions
        published_s = mean(run.cpu_s for run in self.published)
        return {
            "interactions_per_core_second": 1 / core_s,
            "interactions_per_wall_second": interactions / median(run.wall_s for run in self.collected),
            "times_published_protocol": published_s / core_s,
            "times_published_protocol_with_short_settling": mean(run.short_settling_s for run in self.published)
            / core_s,
            "interactions": interactions,
            "repeats": len(self.collected),
            "success_rate": self.collected[0].successes / interactions,
            "bytes_per_interaction": self.collected[0].bytes_per_interaction,
            "digest": self.collected[0].digest,
            "stage_seconds": self._by_stage(lambda run: 1.0),
            "stage_core_seconds": self._by_stage(lambda run: run.cpu_s / run.wall_s),
            "published_trials": len(self.published),
            "published_core_seconds_per_trial": published_s,
            "published_stage_seconds": {
                stage: mean(getattr(run.timing, stage) for run in self.published)
                for stage in ("start", "load", "settle", "settle_short", "trial")
            },
            "published_label_agreement": mean(run.same_label for run in self.published),
        }

    def _by_stage(self, scale: Callable[[CollectionRun], float]) -> dict[str, float]:
        """Medians of the wall seconds by stage, each repeat scaled."""
        return {
            stage: median(run.stages[stage] * scale(run) for run in self.collected)
            for stage in self.collected[0].stages
        }

    def _jobs(self) -> list[Job]:
        return missing_jobs(self.plan.key, self.rollouts, [], ROLLOUTS_PER_SHARD)

    def _collect(self, store: Store, advance: Advance) -> CollectionRun:
        """Collect the plan as one worker does, without a fleet."""
        worker, tally = Worker(store.path, self.folder), Tally()
        wall, cpu = time.perf_counter(), time.process_time()
        for job in self._jobs():
            tally.add(worker.run(self.plan, job))
            advance()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if not tally.interactions:
            raise UsageError(f"{self.folder}: no object comes to rest in view of the camera; nothing was collected")
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

    def _publish(self, store: Store, turn: int, advance: Advance) -> None:
        """This turn's share of the sample, spread evenly over what was stored."""
        rows = [
            (rollout, row)
            for manifest in store.committed()
            for rollout in store.read_rollouts(manifest.shard_id)
            for row in rollout.interactions
        ]
        chosen = rows[:: max(1, len(rows) // self.sample)][: self.sample]
        for rollout, row in islice(chosen, turn, None, self.repeats):
            self.published.append(self._publish_one(rollout, row))
            advance()

    def _publish_one(self, rollout: RolloutRecord, row: InteractionRecord) -> PublishedRun:
        own = self.folder / rollout.object.id
        request = PublishedRequest(
            folder=self.folder if urdf_of(self.folder) is not None else own,
            hidden=dict(rollout.dynamics.values),
            direction=rollout.dynamics.direction,
            joint_positions=tuple(row.joint_positions.tolist()),
            point=tuple(row.action.point.tolist()),
            rotation=tuple(row.action.rotation.ravel().tolist()),
            target_part=row.target_part,
            primitive=row.primitive,
        )
        before = _children_cpu_s()
        timing = published_trial(request)
        return PublishedRun(_children_cpu_s() - before, timing, timing.success == row.outcome.success)


def published_trial(request: PublishedRequest) -> PublishedTiming:
    """Execute one trial in a fresh process.

    Raises:
        WorkerError: the process failed, or took longer than any trial may.
    """
    environment = own_environment() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [*PYTHON, "-m", "collector.published"],
            input=request.model_dump_json(),
            capture_output=True,
            text=True,
            env=environment,
            timeout=PUBLISHED_LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        raise WorkerError(f"a published trial took more than {PUBLISHED_LIMIT_S:g} s ({request.folder})") from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1][:300]
        raise WorkerError(f"a published trial failed ({request.folder}): {reason}")
    return PublishedTiming.model_validate_json(done.stdout.splitlines()[-1])


def _children_cpu_s() -> float:
    """CPU seconds of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
