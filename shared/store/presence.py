"""Which processes work on a store: drivers (several in a bucket), or one that must be alone, such as a repair.

A disk has locks for this. A bucket has none, so each process there writes a marker, renews it, and then looks for other
markers. If two processes start at the same time, at least one sees the other.

    STORE/status/driver-<process>-<n>.json    a marker; about the present state, so no data
"""

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from pydantic import Field, ValidationError

from shared.config import StrictModel
from shared.errors import MissingError, StoreError, UsageError
from shared.heartbeat import Heartbeat, is_recent
from shared.io.files import is_gone, process_name
from shared.store.backends.base import StorageBackend
from shared.store.crash_log import workers_at_work
from shared.store.layout import STATUS_FOLDER

DRIVER = "driver"
"""Name of the lock of drivers, and of processes that must not run beside one."""
BEAT_S = 5.0
SILENT_S = 30.0
"""A process that has not renewed its marker for this long has ended; clocks may differ by some seconds."""
_MAX_MARK_BYTES = 1 << 12


class Mark(StrictModel):
    """The marker of one process."""

    process: str = Field(max_length=200)
    """Its name by `shared.io.files.process_name`."""
    alone: bool
    """Whether it must be the only one."""
    written: float = Field(ge=0)
    """Seconds since 1970."""

    def is_alive(self, now: float) -> bool:
        """Whether its process runs, as far as this machine can know."""
        return not is_gone(self.process) and is_recent(self.written, now, SILENT_S)


@contextmanager
def present(backend: StorageBackend, name: str, *, alone: bool) -> Iterator[None]:
    """Hold a lock of a backend without locks: write a marker, look for others, and renew it during the context.

    Args:
        backend: of the markers.
        name: of the lock.
        alone: whether no other process may hold it; otherwise there may be others that also allow this.

    Raises:
        UsageError: another process holds it, and one of the two must be alone.
    """
    own = f"{STATUS_FOLDER}/{name}-{process_name()}-{secrets.token_hex(4)}.json"

    def write() -> None:
        mark = Mark(process=process_name(), alone=alone, written=time.time())
        backend.replace(own, mark.model_dump_json().encode())

    def renew() -> None:
        # The work itself reports problems of the backend.
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
