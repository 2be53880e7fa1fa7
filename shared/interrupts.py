"""Signals by which users end a command: which these are, and work that they do not interrupt."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, `kill`, and a terminal that closes."""


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
