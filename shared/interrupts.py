"""Signals by which users end a command: which these are, work that they do not interrupt, and work that they must."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, `kill`, and a terminal that closes."""
AGAIN_S = 0.02
"""After how long a signal is repeated whose exception was lost."""
_TOKENS = "_tokens"
"""The attribute of an exception that shows that a signal has raised it."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Signals that would end this process wait for the end of the context, so that a second Ctrl-C leaves nothing.

    In the main thread, where Python handles signals; elsewhere none interrupts.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in ENDING}
    handled = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in handled:
        signal.signal(number, lambda one, _: received.append(one))
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
    if received:
        signal.raise_signal(received[0])


@contextmanager
def heeded() -> Iterator[None]:
    """A signal ends what runs in the context, also where a library drops the exception that its handler raises.

    Libraries do so in callbacks of native code, and where they try an import: pyarrow imports pandas in this way. Then
    the signal is repeated. What fails after a signal fails because of it, so that the context ends by the signal.

    In the main thread, where Python handles signals; elsewhere none arrives.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    watch, before = _Watch(), {number: signal.getsignal(number) for number in ENDING}
    handled = {number: handler for number, handler in before.items() if callable(handler)}
    unraisable = sys.unraisablehook
    for number, handler in handled.items():
        signal.signal(number, partial(_watched, handler, watch))
    sys.unraisablehook = partial(_unless_repeated, unraisable)
    try:
        yield
    except Exception:
        if watch.received is None:
            raise
        signal.raise_signal(watch.received)
        raise
    finally:
        watch.is_open = False
        sys.unraisablehook = unraisable
        for number, handler in handled.items():
            signal.signal(number, handler)


@dataclass(slots=True)
class _Watch:
    """What is known of the signals of a context."""

    is_open: bool = True
    received: int | None = None

    def repeat(self, number: int) -> None:
        """Send a signal again if the context has not ended meanwhile; it wakes the main thread where that waits."""
        if self.is_open:
            signal.pthread_kill(threading.main_thread().ident or 0, number)


class _Token:
    """Exists as long as the exception of a signal, which is lost if that is while the context goes on.

    An exception that is raised, or handled by those who clean up and raise it again, exists.
    """

    def __init__(self, watch: _Watch, number: int) -> None:
        self._watch, self._number = watch, number

    def __del__(self) -> None:
        if self._watch.is_open:
            # By a thread, since a handler that is called right here would raise within this method.
            timer = threading.Timer(AGAIN_S, self._watch.repeat, (self._number,))
            timer.daemon = True
            timer.start()


def _watched(handler: Callable[[int, Any], Any], watch: _Watch, number: int, frame: Any) -> None:
    """Handle a signal, and see to it that the exception which that raises is not lost."""
    watch.received = number
    try:
        handler(number, frame)
    except BaseException as error:
        # Several, where a context is within another.
        error.__dict__.setdefault(_TOKENS, []).append(_Token(watch, number))
        raise


def _unless_repeated(hook: Callable[[Any], Any], unraisable: Any) -> None:
    """Report an exception that could not be raised, unless it is one of a signal, which is repeated."""
    if not hasattr(unraisable.exc_value, _TOKENS):
        hook(unraisable)
