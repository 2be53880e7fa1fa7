"""Faults at every write or read step of a store: what fails, when, and how many steps there are.

with disk_faults(Fault("ENOSPC", step=7)) as steps: ...    # raises from the seventh step; len(steps) counts them
with disk_read_faults(Fault("EIO", step=7), folder) as steps: ...    # likewise for reading, below a folder
"""

import errno
import os
import signal
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from obstore.exceptions import GenericError, PermissionDeniedError

from shared.store.backends.s3 import S3Backend

DISK_CALLS = ("open", "write", "fsync", "mkdir", "rename", "link", "unlink", "rmdir")
BUCKET_CALLS = ("put", "copy", "delete")
DISK_FAULTS = ("ENOSPC", "EIO", "late EIO", "short write", "short write, then ENOSPC")
BUCKET_FAULTS = ("refused", "answer lost")
KILLS = ("kill before", "kill after")
DISK_READ_CALLS = ("open", "read", "listdir", "stat")
BUCKET_READ_CALLS = ("get", "head", "list", "list_with_delimiter")
DISK_READ_FAULTS = ("EIO", "ESTALE", "EACCES", "vanished")
BUCKET_READ_FAULTS = ("refused", "forbidden", "timed out")


@dataclass(slots=True)
class Fault:
    """A fault of some kind at the n-th step, counted from 1; 0 for none."""

    kind: str
    step: int
    steps: list[str] = field(default_factory=list)
    """Names of the calls so far."""
    lock: Any = field(default_factory=threading.Lock)

    def call(self, name: str, real: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Do one step, or let it fail."""
        with self.lock:
            self.steps.append(name)
            hit = len(self.steps) == self.step or (self.kind == "vanished" and 0 < self.step <= len(self.steps))
            after_short = self.kind.endswith("then ENOSPC") and len(self.steps) == self.step + 1
        if after_short and name == "write":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if not hit:
            return real(*args, **kwargs)
        match self.kind:
            case "ENOSPC" | "EIO" | "ESTALE" | "EACCES":
                code = getattr(errno, self.kind)
                raise OSError(code, os.strerror(code))
            case "late EIO":
                done = real(*args, **kwargs)
                if name == "open":
                    os.close(done)
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            case "short write" | "short write, then ENOSPC" if name == "write":
                descriptor, data = args
                return real(descriptor, data[: max(1, len(data) // 2)])
            case "vanished":
                raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
            case "forbidden":
                raise PermissionDeniedError("403 Forbidden")
            case "timed out":
                raise GenericError("operation timed out")
            case "refused":
                raise GenericError("503 Slow Down")
            case "answer lost":
                real(*args, **kwargs)
                raise GenericError("connection reset")
            case "kill before":
                os.kill(os.getpid(), signal.SIGKILL)
            case "kill after":
                try:
                    real(*args, **kwargs)
                finally:
                    os.kill(os.getpid(), signal.SIGKILL)
        return real(*args, **kwargs)


@contextmanager
def disk_faults(fault: Fault) -> Iterator[list[str]]:
    """Let a step of writing to a disk fail, whoever does it."""
    real = {name: getattr(os, name) for name in DISK_CALLS}

    def wrap(name: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if name == "open" and not args[1] & os.O_CREAT:
                return real[name](*args, **kwargs)
            return fault.call(name, real[name], *args, **kwargs)

        return call

    try:
        for name in DISK_CALLS:
            setattr(os, name, wrap(name))
        yield fault.steps
    finally:
        for name, function in real.items():
            setattr(os, name, function)


@contextmanager
def disk_read_faults(fault: Fault, folder: str) -> Iterator[list[str]]:
    """Let a step of reading below a folder fail."""
    real = {name: getattr(os, name) for name in DISK_READ_CALLS}
    descriptors = set()

    def call(name: str, *args: Any, **kwargs: Any) -> Any:
        mine = args[0] in descriptors if name == "read" else str(args[0]).startswith(folder)
        if not mine or (name == "open" and args[1] & os.O_CREAT):
            return real[name](*args, **kwargs)
        done = fault.call(name, real[name], *args, **kwargs)
        if name == "open":
            descriptors.add(done)
        return done

    try:
        for name in DISK_READ_CALLS:
            setattr(os, name, partial(call, name))
        yield fault.steps
    finally:
        for name, function in real.items():
            setattr(os, name, function)


class _FaultyClient:
    """An obstore client some of whose requests fail."""

    def __init__(self, real: Any, fault: Fault, calls: Collection[str]) -> None:
        self._real, self._fault, self._calls = real, fault, calls

    def __getattr__(self, name: str) -> Any:
        real = getattr(self._real, name)
        if name not in self._calls:
            return real
        if name == "list":
            # Nothing is asked for before the first page is.
            return lambda *args, **kwargs: _FaultyPages(real(*args, **kwargs), self._fault)
        return lambda *args, **kwargs: self._fault.call(name, real, *args, **kwargs)


class _FaultyPages:
    """Pages of a listing, of which one fails."""

    def __init__(self, real: Any, fault: Fault) -> None:
        self._real, self._fault = real, fault

    def __iter__(self) -> "_FaultyPages":
        return self

    def __next__(self) -> Any:
        return self._fault.call("list", next, self._real)


@contextmanager
def bucket_faults(fault: Fault, calls: Collection[str] = BUCKET_CALLS) -> Iterator[list[str]]:
    """Let a step of writing to a bucket fail, or of other calls, in places that are opened within the context."""
    init = S3Backend.__init__

    def faulty(self: S3Backend, where: str, client: Any) -> None:
        init(self, where, _FaultyClient(client, fault, calls))

    try:
        S3Backend.__init__ = faulty  # type: ignore[method-assign]
        yield fault.steps
    finally:
        S3Backend.__init__ = init  # type: ignore[method-assign]
