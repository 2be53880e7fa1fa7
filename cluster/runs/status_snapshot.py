"""The status of a run or a store, read from files on the disk or in the bucket, without a request to its processes.

snapshot = snapshot_of("RUN")        # or a store, or the folder of a learner
snapshot.stores[0].driver            # the last status of its driver
"""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster.collection.status_writer import DriverStatus, read_status
from cluster.runs.run_folder import RunFolder
from cluster.runs.run_log import RunLog
from learner.settings import METRICS_FILE, PUBLISHED_FILE
from shared.errors import UsageError
from shared.io.documents import json_lines
from shared.plan import covered
from shared.store import Store
from shared.store.backends.base import is_url
from shared.store.layout import SHARDS_FOLDER, STORE_FILE, parse_shard_id
from shared.store.provenance import host_of

LARGEST_NUMBER = 1e300
"""Of a metric that is shown; an integer may be too large to be a float."""
MAX_TAIL_BYTES = 1 << 14
"""Of a file of metrics; a line is far shorter."""


@dataclass(frozen=True, slots=True)
class WorkerNow:
    """What a worker does now.

    Attributes:
        process: its name, by `shared.io.files.process_name`.
        host: its machine; "" if the store does not know it.
        shard_id: of its job.
        rollout: the running rollout; None while it writes, or waits for its next job.
    """

    process: str
    host: str
    shard_id: str
    rollout: int | None


@dataclass(frozen=True, slots=True)
class StoreSnapshot:
    """The status of a store.

    Attributes:
        where: its folder or URL.
        rollouts: how many there are, by plan.
        policies: versions that are published.
        driver: the status of the last collection; None if there was none.
        driver_alive: whether that driver runs.
        workers: the workers; a killed one may be among them until the next collection begins.
    """

    where: str
    rollouts: Mapping[str, int]
    policies: tuple[int, ...]
    driver: DriverStatus | None
    driver_alive: bool
    workers: tuple[WorkerNow, ...]


@dataclass(frozen=True, slots=True)
class TrainingSnapshot:
    """The last line of a training's metrics.

    Attributes:
        stage: folder of the stage.
        step: of the last validation.
        written: seconds since 1970.
        metrics: by name.
    """

    stage: str
    step: int
    written: float
    metrics: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class StatusSnapshot:
    """The status of a run, a store or a learner.

    Attributes:
        what: "run", "store" or "learner".
        where: the given folder or URL.
        stages_done: finished stages of a run, in the order of their ends.
        stage: the running stage of a run; None if there is none.
        stage_s: seconds of that stage, over all attempts.
        stores: the two of a run; or the store itself.
        training: of a run or a learner; None before the first validation.
    """

    what: str
    where: str
    stages_done: tuple[str, ...] = ()
    stage: str | None = None
    stage_s: float = 0.0
    stores: tuple[StoreSnapshot, ...] = ()
    training: TrainingSnapshot | None = None


def snapshot_of(where: str, now: float | None = None) -> StatusSnapshot:
    """The status of a run, a store or a learner.

    Args:
        where: its folder, or the URL of a store.
        now: seconds since 1970.

    Raises:
        UsageError: it is none of these.
        StoreError: a store is damaged.
    """
    now = time.time() if now is None else now
    folder = Path(where)
    if is_url(where) or (folder / STORE_FILE).is_file():
        return StatusSnapshot("store", where, stores=(_store(where, now),))
    run = RunFolder(folder)
    if run.config.is_file() and run.log.is_file():
        return _run(run, now)
    if (folder / PUBLISHED_FILE).is_file() or (folder / "prior").is_dir():
        return StatusSnapshot("learner", where, training=_training(folder.glob(f"*/{METRICS_FILE}")))
    raise UsageError(f"{where}: no run, store or learner's folder; name one, or the s3:// URL of a store")


def _run(run: RunFolder, now: float) -> StatusSnapshot:
    run_log = RunLog(run.log)
    open_stages = [name for name in run_log.seconds if name not in run_log.finished]
    stores = [path for path in (run.store, run.evaluation) if (path / STORE_FILE).is_file()]
    return StatusSnapshot(
        what="run",
        where=str(run.path),
        stages_done=run_log.finished,
        stage=open_stages[-1] if open_stages else None,
        stage_s=run_log.seconds[open_stages[-1]] if open_stages else 0.0,
        stores=tuple(_store(str(path), now) for path in stores),
        training=_training(run.path.glob(f"training/*/{METRICS_FILE}")),
    )


def _store(where: str, now: float) -> StoreSnapshot:
    store = Store.open(where)
    driver = read_status(store.backend)
    heartbeats = store.crash_log.heartbeats()
    return StoreSnapshot(
        where=where,
        rollouts=_rollouts(store),
        policies=store.policy_versions(),
        driver=driver,
        driver_alive=driver is not None and driver.is_alive(now),
        workers=tuple(
            WorkerNow(name, host_of(store.backend, name), heartbeat.shard_id, heartbeat.rollout)
            for name, heartbeat in heartbeats.items()
        ),
    )


def _rollouts(store: Store) -> dict[str, int]:
    """Rollouts by plan, by the names of the shards alone: that a million of them are listed is work enough."""
    ranges: dict[str, list[tuple[int, int]]] = {}
    for job in filter(None, map(parse_shard_id, store.backend.names(SHARDS_FOLDER))):
        ranges.setdefault(job.plan_key, []).append((job.start, job.stop))
    return {plan_key: covered(known) for plan_key, known in sorted(ranges.items())}


def _training(files: Iterable[Path]) -> TrainingSnapshot | None:
    """Of the stage that was validated last."""
    written = {file: file.stat().st_mtime for file in files if file.is_file()}
    for file in sorted(written, key=lambda file: written[file], reverse=True):
        line = _last_line(file)
        if line is not None:
            numbers = {
                name: float(value)
                for name, value in line.items()
                if isinstance(value, int | float) and abs(value) < LARGEST_NUMBER
            }
            return TrainingSnapshot(file.parent.name, int(numbers.pop("step", 0)), written[file], numbers)
    return None


def _last_line(file: Path) -> dict[str, Any] | None:
    """The last whole line of a file of JSON lines; None if there is none."""
    with file.open("rb") as stream:
        stream.seek(max(file.stat().st_size - MAX_TAIL_BYTES, 0))
        lines = stream.read(MAX_TAIL_BYTES).splitlines()
    return next(json_lines(reversed(lines)), None)
