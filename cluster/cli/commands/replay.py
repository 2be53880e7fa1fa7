"""`adaafford store replay`: execute a job of a store again, or show interactions that it holds as a video."""

import faulthandler
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from shared.errors import UsageError
from shared.formatting import counted
from shared.progress import Progress

if TYPE_CHECKING:
    from collector.job_result import JobResult
    from shared.plan import Job, RolloutRecord


@dataclass(frozen=True, slots=True)
class ReplayCommand:
    """Execute one job in this process, without Ray, to see why it fails; if it succeeds, it is committed.

    With --rollout, that rollout alone is executed, whatever the store says of it, and nothing is committed.

    With --video, stored interactions are executed again and shown: the whole rollout that --rollout names, or the
    interaction that --step, --success or --failure chooses. Nothing is committed.
    """

    store: Annotated[str, tyro.conf.Positional]
    """Folder or s3:// URL of the store."""
    objects: Path
    """Folder of the store's objects."""
    shard: Annotated[str, tyro.conf.Positional] = ""
    """The shard that the job makes, such as random-v0-00000000-00000002; with --video, only its rollouts are shown."""
    rollout: int | None = None
    """Number of one rollout."""
    video: Path | None = None
    """File of the video: .mp4, .gif, or .png for start, first contact and end in one picture. It needs no GPU."""
    step: int | None = None
    """With --video and --rollout: number of one interaction of the rollout, from 0."""
    success: tyro.conf.FlagCreatePairsOff[bool] = False
    """With --video: the first interaction that succeeded."""
    failure: tyro.conf.FlagCreatePairsOff[bool] = False
    """With --video: the first one that failed."""


def replay(command: ReplayCommand) -> int:
    """Execute the command."""
    if command.video is not None:
        return _show(command, command.video)
    if command.step is not None or command.success or command.failure:
        raise UsageError("--step, --success and --failure choose what is shown; give --video FILE, too")
    if not command.shard:
        raise UsageError("name the shard whose job is executed again, or a file with --video")
    return _replay_job(command)


def _show(command: ReplayCommand, out: Path) -> int:
    from cluster.evaluation.resimulation import chosen_interactions
    from collector.objects.catalogue import load_ref
    from collector.viz.playback import record
    from collector.viz.video import FRAMES_A_SECOND, Clip, check_video, write_video
    from shared.store import Store

    if command.success and command.failure:
        raise UsageError("--success and --failure exclude each other; give one")
    if command.step is not None and command.rollout is None:
        raise UsageError(f"--step {command.step} needs --rollout: steps are numbered within their rollout")
    check_video(out)
    store = Store.open(command.store)
    if command.shard:
        _job(command)
    success = command.success if command.success or command.failure else None
    rollout, rows = chosen_interactions(store, command.shard, command.rollout, command.step, success)
    collection = store.setting.collection
    target = load_ref(command.objects, rollout.object, collection.collision)
    clips = [Clip.of(record(target, collection, rollout, row, FRAMES_A_SECOND), rollout, row) for row in rows]
    for clip in clips:
        print("; ".join(clip.lines))
    frames = 0 if out.suffix.lower() == ".png" else sum(map(len, clips))
    with Progress(f"drawing {out}, frames", frames) as progress:
        write_video(clips, out, progress.advance)
    print(f"into {out}")
    return 0


def _replay_job(command: ReplayCommand) -> int:
    from collector.sim.simulator import StageClock
    from collector.worker import Worker
    from shared.store import Store

    store, job = Store.open(command.store), _job(command)
    plans = {plan.key: plan for plan in store.plans()}
    if job.plan_key not in plans:
        raise UsageError(f"{command.store} has no plan '{job.plan_key}'; it has: {', '.join(plans) or 'none'}")
    # If the engine crashes, this says where.
    faulthandler.enable()
    worker, plan = Worker(command.store, command.objects), plans[job.plan_key]
    if command.rollout is not None:
        print(f"executing rollout {command.rollout} alone; nothing is committed", file=sys.stderr)
        print(_described(worker.execute(plan, command.rollout, StageClock())))
        return 0
    print(f"executing {job.shard_id}", file=sys.stderr)
    print(_summary(worker.run(plan, job, under_way=_announce)))
    return 0


def _job(command: ReplayCommand) -> "Job":
    """The job of the shard that was named.

    Raises:
        UsageError: it is no name of a shard, or the rollout is not of it.
    """
    from shared.store.layout import parse_shard_id

    job = parse_shard_id(command.shard)
    if job is None:
        raise UsageError(f"'{command.shard}' names no shard; names look like random-v0-00000000-00000002")
    if command.rollout is not None and not job.start <= command.rollout < job.stop:
        raise UsageError(f"rollout {command.rollout} is not of this shard; allowed: {job.start} to {job.stop - 1}")
    return job


def _announce(rollout: int | None) -> None:
    """Print which rollout begins, in case it crashes."""
    if rollout is not None:
        print(f"rollout {rollout}", file=sys.stderr, flush=True)


def _described(record: "RolloutRecord") -> str:
    """A rollout in one line."""
    outcomes = Counter(row.outcome.kind.value for row in record.interactions)
    return f"rollout {record.index} (object {record.object.id}): {record.status}; {_counts(outcomes)}"


def _summary(result: "JobResult") -> str:
    """The result of a job in one line."""
    made = f"{counted(result.rollouts, 'rollout')}, {counted(result.interactions, 'interaction')}"
    return f"{result.shard_id}: {made}, {result.successes} successful; {_counts(result.outcomes)}"


def _counts(outcomes: Mapping[str, int]) -> str:
    """Numbers of interactions by outcome kind."""
    return ", ".join(f"{name} {count}" for name, count in sorted(outcomes.items())) or "no interactions"
