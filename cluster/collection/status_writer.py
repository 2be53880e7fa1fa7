"""How a collection stands: what its driver writes down every few seconds, and who else reads it.

    STORE/status/driver.json     replaced as a whole; about the moment, so no data and never in a digest

The driver alone writes it, so it is read without asking the driver, on any machine that reaches the store, and also
after the driver has ended.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import StoreError
from shared.heartbeat import Heartbeat
from shared.io.files import is_gone
from shared.store.backends.base import StorageBackend
from shared.store.layout import STATUS_FOLDER

BEAT_S = 2.0
"""How often the driver writes how it stands; one small file, whatever is collected."""
SILENT_S = 30.0
"""A driver that has written nothing for so long is not at work; clocks of machines may differ by some seconds."""
MAX_STATUS_BYTES = 1 << 16
_KEY = f"{STATUS_FOLDER}/driver.json"

State = Literal["collecting", "waiting", "done", "stopped"]

logger = logging.getLogger(__name__)


class DriverStatus(StrictModel):
    """How a collection stands."""

    process: str = Field(max_length=200)
    """The driver's, as `shared.io.files.process_name` has it."""
    written: float = Field(ge=0)
    """Seconds since 1970, by the driver's clock."""
    state: State
    """Waiting: all that the policies so far may propose is handed out."""
    title: str = Field(max_length=100)
    """What is collected: a plan, or a proposer that follows a learner."""
    policy: int | None = Field(None, ge=0)
    """The version in force; 0 is none, null that the first one is waited for."""
    done: int = Field(ge=0)
    """Rollouts that are there, earlier attempts included."""
    total: int = Field(ge=0)
    elapsed_s: float = Field(ge=0)
    """Since work began in this attempt; what follows is of this attempt, too."""
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
        """Rollouts to do."""
        return max(self.total - self.done, 0)

    @property
    def left_s(self) -> float | None:
        """Seconds until all is done, at the pace so far; None if there is none to judge by."""
        if self.state != "collecting" or not self.rollouts:
            return None
        return self.left * self.elapsed_s / self.rollouts

    def is_alive(self, now: float) -> bool:
        """Whether the driver is at work, as far as that can be told from here.

        Args:
            now: seconds since 1970.
        """
        ended = self.state in ("done", "stopped") or is_gone(self.process)
        return not ended and now - self.written < SILENT_S


def read_status(place: StorageBackend) -> DriverStatus | None:
    """How the last collection into a store stands; None where none has said so, or what it said is damaged."""
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
    """Write how a collection stands, in the background for as long as the context lasts, and how it ended.

    Args:
        place: of the store.
        stand: tells how it stands, given the state.
        is_waiting: whether all that may be done now is handed out.
        say: is told when that begins.
        beat_s: how often.
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
