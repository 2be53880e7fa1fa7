"""A heartbeat: something that is said again and again from a thread in the background, for as long as work goes on."""

import threading
import time
from collections.abc import Callable
from types import TracebackType


class Heartbeat:
    """Calls `beat` while the context lasts, and never at the same time as its end.

    Args:
        beat: what is done; it sees to its own errors.
        pause_s: seconds until the next one, given the seconds since the beginning.
        name: of the thread.
        at_once: whether the first one comes at the beginning, instead of after a pause.
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End; a beat under way is waited for."""
        self._stop.set()
        self._thread.join()

    def _repeat(self) -> None:
        begun = time.monotonic()
        if self._at_once:
            self._beat()
        while not self._stop.wait(self._pause_s(time.monotonic() - begun)):
            self._beat()
