"""Who is at work on a store: drivers, which may be several in a bucket, and whoever must be alone, such as a repair.

A disk has locks for that. A bucket has none, so each holder there leaves a mark that it renews, and looks for others
after its own is written: of two that come at the same time, at least one sees the other.

    STORE/status/driver-<process>-<n>.json    a mark; about the moment, so no data
"""

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import MissingError, StoreError, UsageError
from shared.heartbeat import Heartbeat
from shared.io.files import is_gone, process_name
from shared.store.backends.base import StorageBackend
from shared.store.crash_log import workers_at_work
from shared.store.layout import STATUS_FOLDER

DRIVER = "driver"
"""Name of the lock of whoever hands out jobs, and of whoever must not meet one."""
BEAT_S = 5.0
SILENT_S = 30.0
"""A holder that has not renewed its mark for so long has ended; clocks of machines may differ by some seconds."""
_MAX_MARK_BYTES = 1 << 12


class Mark(StrictModel):
    """What a holder says of itself."""

    process: str = Field(max_length=200)
    """As `shared.io.files.process_name` has it."""
    alone: bool
    """Whether it must be the only one."""
    written: float = Field(ge=0)
    """Seconds since 1970."""

    def is_alive(self, now: float) -> bool:
        """Whether its process is at work, as far as that can be told from here."""
        return not is_gone(self.process) and now - self.written < SILENT_S


@contextmanager
def present(backend: StorageBackend, name: str, *, alone: bool) -> Iterator[None]:
    """Hold a place without locks: leave a mark, look for others, and renew the mark as long as the context lasts.

    Args:
        backend: where the mark lies.
        name: what is held.
        alone: whether there must be no other holder; without it, there may be others of this kind.

    Raises:
        UsageError: another holder must be alone, or this one must and there is another.
    """
    own = f"{STATUS_FOLDER}/{name}-{process_name()}-{secrets.token_hex(4)}.json"

    def write() -> None:
        mark = Mark(process=process_name(), alone=alone, written=time.time())
        backend.replace(own, mark.model_dump_json().encode())

    def renew() -> None:
        # The work itself meets whatever is wrong with the place.
        with suppress(StoreError):
            write()

    write()
    try:
        _refuse_others(backend, name, own, alone=alone)
    except BaseException:
        backend.remove(own)
        raise
    try:
        with Heartbeat(renew, lambda _: BEAT_S, "presence"):
            yield
    finally:
        # Where that fails it is silent from now on, which says the same some seconds later.
        with suppress(StoreError):
            backend.remove(own)


def _refuse_others(backend: StorageBackend, name: str, own: str, *, alone: bool) -> None:
    for key, mark in _others(backend, name, own):
        if not mark.is_alive(time.time()):
            backend.remove(key)
        elif mark.alone or alone:
            raise UsageError(
                f"{backend.where} is in use by process {mark.process}; wait for it or stop it "
                f"(one that was killed is forgotten after {SILENT_S:.0f} s)"
            )


def _others(backend: StorageBackend, name: str, own: str) -> Iterator[tuple[str, Mark]]:
    for each in backend.names(STATUS_FOLDER):
        key = f"{STATUS_FOLDER}/{each}"
        if not each.startswith(f"{name}-") or key == own:
            continue
        try:
            yield key, Mark.model_validate_json(backend.read(key, _MAX_MARK_BYTES))
        except (MissingError, ValidationError):
            continue  # It has ended meanwhile, or it is no mark.


@contextmanager
def alone(backend: StorageBackend) -> Iterator[None]:
    """Hold a store against drivers, against others who must be alone, and in a bucket against workers as well.

    On a disk a worker that has lost its driver does no harm: its shard is renamed to its place as a whole.

    Raises:
        UsageError: somebody is at work; the message names the process.
    """
    with backend.only_one(DRIVER, alone=True):
        for process in workers_at_work(backend.where, time.time()) if backend.writes_in_place else ():
            raise UsageError(
                f"{backend.where} is in use by worker process {process}, whose driver has ended; stop that process, or "
                "wait until it has been silent for ten minutes"
            )
        yield
