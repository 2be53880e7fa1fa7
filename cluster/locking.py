"""One driver a folder: two that scheduled the same store would do everything twice."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from shared.files import exclusive_lock

LOCK_FILE = ".lock-driver"
"""The store ignores names that begin with ".lock-"."""


@contextmanager
def only_driver(folder: Path) -> Iterator[None]:
    """Hold `folder` (a store or a run) against other drivers; the kernel releases it however this process ends.

    Raises:
        UsageError: another driver holds it; the message names the process.
    """
    with exclusive_lock(folder / LOCK_FILE):
        yield
