"""The status file of a collection, which its driver writes every few seconds.

    STORE/status/driver.json     replaced as a whole; no data, and never part of a digest

Only the driver writes it. It can be read on any machine that can reach the store, also after the driver has ended.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import StoreError
from shared.heartbeat import Heartbeat, is_recent
from shared.io.files import is_gone
from shared.store.backends.base import StorageBackend
from shared.store.layout import STATUS_FOLDER

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
