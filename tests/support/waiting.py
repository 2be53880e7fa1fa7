"""Waiting for what another thread or process will do, with a deadline that no busy machine needs."""

import time
from collections.abc import Callable


def wait_until(true: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Return once `true()` holds."""
    deadline = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.005)
