"""Heartbeats: a function that a background thread calls repeatedly while work goes on, and how a reader judges them."""

import threading
import time
from collections.abc import Callable


def is_recent(written: float, now: float, silent_s: float) -> bool:
    """Whether a time stamp, perhaps of another machine's clock, shows that its process was at work a moment ago.

    Clocks may differ by less than `silent_s`. A time further ahead was written by a wrong clock, and would otherwise
    count as recent until the right clock reaches it, which may take years.

    Args:
        written: the time stamp, in seconds since 1970.
        now: by the clock of this machine.
        silent_s: a process that has written nothing for this long has ended.
    """
    return abs(now - written) < silent_s


class Heartbeat:
    """Calls `beat` during the context, and never after its end.

    Args:
        beat: the function; it must handle its own errors.
        pause_s: seconds until the next one, given the seconds since the beginning.
        name: of the thread.
        at_once: whether the first call is immediate, instead of after a pause.
    """

    def __init__(
        self, beat: Callable[[], None], pause_s: Callable[[float], float], name: str, *, at_once: bool = False
    ) -> None:
        self._beat = beat
        self._pause_s = pause_s
        self._at_once = at_once
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name=name, daemon=True)

    def __enter__(self) -> "Heartbeat":
        """Begin."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread, after a running call."""
        self._stop.set()
        self._thread.join()

    def _repeat(self) -> None:
        begun = time.monotonic()
        if self._at_once:
            self._beat()
        while not self._stop.wait(self._pause_s(time.monotonic() - begun)):
            self._beat()
