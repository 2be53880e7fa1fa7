"""Progress of a collection: what its job results add up to, how that is shown, and its status file.

    STORE/status/driver.json     replaced as a whole every few seconds; no data, and never part of a digest

Only the driver writes it. It can be read on any machine that can reach the store, also after the driver has ended.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import StoreError
from shared.heartbeat import Heartbeat, is_recent
from shared.io.files import is_gone
from shared.progress import Progress
from shared.store.backends.base import StorageBackend
from shared.store.layout import STATUS_FOLDER

if TYPE_CHECKING:
    from collector.job_result import JobResult

BEAT_S = 2.0
"""How often the driver writes its status, s."""
SILENT_S = 30.0
"""A driver without a new status for this long has ended; clocks may differ by some seconds."""
MAX_STATUS_BYTES = 1 << 16
_KEY = f"{STATUS_FOLDER}/driver.json"

State = Literal["collecting", "waiting", "done", "stopped"]

logger = logging.getLogger(__name__)


class DriverStatus(StrictModel):
    """The status of a collection."""

    process: str = Field(max_length=200)
    """Name of the driver's process, by `shared.io.files.process_name`."""
    written: float = Field(ge=0)
    """Seconds since 1970, by the driver's clock."""
    state: State
    """Waiting: a new policy is needed for more rollouts."""
    title: str = Field(max_length=100)
    """What is collected: a plan, or a proposer that follows a learner."""
    policy: int | None = Field(None, ge=0)
    """The version that proposes; 0 means none, null that the collection waits for the first one."""
    done: int = Field(ge=0)
    """Rollouts in the store, including earlier attempts."""
    total: int = Field(ge=0)
    elapsed_s: float = Field(ge=0)
    """Since the start of this attempt; the fields below are also of this attempt."""
    rollouts: int = Field(ge=0)
    interactions: int = Field(ge=0)
    successes: int = Field(ge=0)
    outcomes: dict[str, int]
    quarantined: int = Field(ge=0)
    recent_per_s: float = Field(ge=0)
    """Interactions a second over the last half minute."""
    workers: int = Field(ge=0)
    restarts: int = Field(ge=0)
    """Workers that were replaced."""

    @property
    def per_s(self) -> float:
        """Interactions a second over the whole attempt."""
        return self.interactions / self.elapsed_s if self.elapsed_s else 0.0

    @property
    def success_rate(self) -> float:
        """Share of the interactions that succeeded; 0 before the first."""
        return self.successes / self.interactions if self.interactions else 0.0

    @property
    def left(self) -> int:
        """Missing rollouts."""
        return max(self.total - self.done, 0)

    @property
    def left_s(self) -> float | None:
        """Seconds until all is done, at the present speed; None if it is unknown."""
        if self.state != "collecting" or not self.rollouts:
            return None
        return self.left * self.elapsed_s / self.rollouts

    def is_alive(self, now: float) -> bool:
        """Whether the driver runs, as far as this machine can know.

        Args:
            now: seconds since 1970.
        """
        ended = self.state in ("done", "stopped") or is_gone(self.process)
        return not ended and is_recent(self.written, now, SILENT_S)


def read_status(place: StorageBackend) -> DriverStatus | None:
    """The status of the last collection into a store; None if it is missing or damaged."""
    try:
        if not place.exists(_KEY):
            return None
        return DriverStatus.model_validate_json(place.read(_KEY, MAX_STATUS_BYTES))
    except (StoreError, ValidationError):
        return None


@contextmanager
def status_kept(
    place: StorageBackend,
    stand: Callable[[State], DriverStatus],
    is_waiting: Callable[[], bool],
    say: Callable[[str], None],
    beat_s: float = BEAT_S,
) -> Iterator[None]:
    """Write the status of a collection in the background during the context, and its final state.

    Args:
        place: storage backend of the store.
        stand: makes the status from the state.
        is_waiting: whether the collection waits for a new policy.
        say: receives a line when it begins to wait.
        beat_s: interval, s.
    """
    before: State = "collecting"

    def write(state: State) -> None:
        try:
            place.replace(_KEY, stand(state).model_dump_json(indent=1).encode())
        except (StoreError, OSError) as error:
            # Nothing depends on it; where the store itself is out of reach, the workers say so.
            logger.info("the status cannot be written (%s)", error)

    def beat() -> None:
        nonlocal before
        state: State = "waiting" if is_waiting() else "collecting"
        if state == "waiting" != before:
            say(f"waiting for a newer policy in {place.where}; `adaafford learn --follow` publishes them")
        before = state
        write(state)

    ended: State = "stopped"
    try:
        with Heartbeat(beat, lambda _: beat_s, "status", at_once=True):
            yield
        ended = "done"
    finally:
        write(ended)


RECENT_S = 30.0
"""What a rate counts as recent."""
MAX_RECENT = 1024
"""Receipts that are remembered for it."""
MOST_OBJECTS = 5
"""Objects that the last line names for each reason why rollouts gave nothing."""
EMPTY = {
    "never-at-rest": "never at rest",
    "nothing-to-act-on": "with no part in sight that the task may act on",
    "ok": "cut short before the first",
}
"""What a status of rollouts without interactions means."""


@dataclass(slots=True)
class Tally:
    """What job results add up to, of this attempt alone."""

    rollouts: int = 0
    interactions: int = 0
    successes: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    """Of all workers together, by stage."""
    quarantined: int = 0
    """Rollouts that were given up."""
    empty: dict[str, dict[str, int]] = field(default_factory=dict)
    """Rollouts without interactions, by status and by object."""
    memory_mb: float = 0.0
    """Of the largest worker."""

    def add(self, job_result: "JobResult") -> None:
        """Count one job result."""
        self.rollouts += job_result.rollouts
        self.interactions += job_result.interactions
        self.successes += job_result.successes
        for name, count in job_result.outcomes.items():
            self.outcomes[name] = self.outcomes.get(name, 0) + count
        for name, seconds in job_result.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.quarantined += job_result.quarantined
        for status, objects in job_result.empty.items():
            of_status = self.empty.setdefault(status, {})
            for name, count in objects.items():
                of_status[name] = of_status.get(name, 0) + count
        self.memory_mb = max(self.memory_mb, job_result.memory_mb)

    @property
    def success_rate(self) -> float:
        """Of the interactions so far; 0 before the first."""
        return self.successes / self.interactions if self.interactions else 0.0


class CollectionProgress(Progress):
    """Shows how far a collection is; use as a context and call with each job result.

    Args:
        title: of the plan.
        done: rollouts that are committed already.
        total: rollouts wanted in all.
        leaves: what will be there in the end, such as the store's path.
        clock: monotonic seconds.
    """

    def __init__(
        self, title: str, done: int, total: int, leaves: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(title, total, unit="rollouts", done=done, leaves=leaves, details=self._rates, clock=clock)
        self.tally = Tally()
        self._already = done
        self._recent: deque[tuple[float, int]] = deque(maxlen=MAX_RECENT)
        """When job results came, and of how many interactions."""

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.tally.rollouts:
            empty = describe_empty(self.tally.empty)
            self.say("; ".join([f"{self.title}: {self.describe()}", *([empty] if empty else [])]))

    def __call__(self, job_result: "JobResult") -> None:
        """Take in one job result."""
        self.tally.add(job_result)
        self._recent.append((self._clock(), job_result.interactions))
        self.show(self._already + self.tally.rollouts)

    @property
    def recent_per_s(self) -> float:
        """Interactions a second of late."""
        now = self._clock()
        # A copy, since another thread may ask while job results come in.
        recent = [(moment, count) for moment, count in self._recent.copy() if now - moment < RECENT_S]
        since = self._recent[0][0] if len(self._recent) == MAX_RECENT else now - RECENT_S
        return sum(count for _, count in recent) / max(now - max(self._begun, since), 1e-9)

    def _rates(self) -> str:
        rate = self.tally.interactions / self.elapsed_s
        text = f"{rate:.0f} interactions/s, {self.tally.success_rate:.1%} successful"
        return text + (f", {self.tally.quarantined} quarantined" if self.tally.quarantined else "")


def describe_empty(empty: Mapping[str, Mapping[str, int]]) -> str:
    """How many rollouts gave no interaction, why, and of which objects; "" if there are none.

    Args:
        empty: how many, by status and by object.
    """
    if not empty:
        return ""
    count = sum(sum(objects.values()) for objects in empty.values())
    reasons = []
    for status, objects in sorted(empty.items()):
        most = sorted(objects.items(), key=lambda item: (-item[1], item[0]))
        named = ", ".join(f"{name} {number}" for name, number in most[:MOST_OBJECTS])
        more = f", {len(most) - MOST_OBJECTS} objects more" if len(most) > MOST_OBJECTS else ""
        reasons.append(f"{sum(objects.values())} {EMPTY.get(status, status)} ({named}{more})")
    return f"{count} rollouts gave no interaction: {'; '.join(reasons)}"
