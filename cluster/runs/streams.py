"""The standard streams of a command: one that is closed, full or broken costs what it would have shown, nothing else.

A closed one is opened on /dev/null before anything else is, since the next file, a shard say, would get its number, and
whatever a library prints would end up in that file. What could not be written to the standard output is noted, so that
the command does not end with code 0; that progress on the standard error was not seen changes nothing.

Logging goes to the standard error: text lines for people, or JSON lines for programs, with rollout and worker.

    ADAAFFORD_LOG=json adaafford collect ... 2>log.jsonl

A log call gives the subject of a line as `extra`, with the names in `FIELDS`; the text format has only the message.
"""

import errno
import io
import json
import logging
import os
import select
import shutil
import signal
import sys
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, TextIO

from shared.io.text import plain, without_secrets

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


STDIN, STDOUT, STDERR = 0, 1, 2
PIPE_CLOSED = 128 + signal.SIGPIPE
"""Exit code where the reader of the output has gone, as a shell has it for `cat` and `yes`; with `set -o pipefail` a
script can tell it from success, which 0 would not allow."""
MIN_COLUMNS, MAX_COLUMNS = 40, 1000
"""Narrower help and tables could not be read, and laying them out may never end; wider ones are mostly blanks."""


class Sink(io.RawIOBase):
    """A descriptor to which writing never fails; `lost` is why something could not be written.

    Args:
        descriptor: of a standard stream.
        closed: whether it was not open when the process began.
        stop_at_pipe: whether to end the command where nobody reads any more, by a SystemExit that is raised once. Many
            catch an OSError, for which they would blame the disk, and rich ends with a code of its own for it.
    """

    def __init__(self, descriptor: int, *, closed: bool, stop_at_pipe: bool) -> None:
        self.lost: OSError | None = None
        self._descriptor, self._closed, self._stop_at_pipe = descriptor, closed, stop_at_pipe

    def writable(self) -> bool:
        """See `io.RawIOBase`."""
        return True

    def fileno(self) -> int:
        """See `io.RawIOBase`."""
        return self._descriptor

    def isatty(self) -> bool:
        """See `io.RawIOBase`."""
        return os.isatty(self._descriptor)

    def write(self, data: "ReadableBuffer", /) -> int:
        """See `io.RawIOBase`; after a failure the data count as written."""
        whole = memoryview(data).nbytes
        try:
            if self._closed:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            return os.write(self._descriptor, data)
        except BlockingIOError:
            select.select([], [self._descriptor], [])
            return self.write(data)
        except BrokenPipeError as error:
            first, self.lost = self.lost is None, self.lost or error
            if first and self._stop_at_pipe:
                raise SystemExit(PIPE_CLOSED) from None
        except OSError as error:
            self.lost = self.lost or error
        return whole


class Streams:
    """The standard streams of this process, in place of those that Python made.

    Args:
        stop_at_pipe: whether the command is to end where nobody reads its output any more (`| head`), which long work
            is not.
    """

    def __init__(self, *, stop_at_pipe: bool) -> None:
        _open_where_closed(STDIN, os.O_RDONLY)
        self._stop_at_pipe = stop_at_pipe
        self._out = Sink(STDOUT, closed=_open_where_closed(STDOUT, os.O_WRONLY), stop_at_pipe=stop_at_pipe)
        self._err = Sink(STDERR, closed=_open_where_closed(STDERR, os.O_WRONLY), stop_at_pipe=False)
        if sys.stdin is None:
            sys.stdin = open(STDIN, closefd=False)  # noqa: SIM115 - a descriptor, for as long as the process.
        columns = shutil.get_terminal_size().columns
        if columns < MIN_COLUMNS or "COLUMNS" in os.environ:
            os.environ["COLUMNS"] = str(min(max(columns, MIN_COLUMNS), MAX_COLUMNS))
        sys.stdout = _text(self._out, sys.stdout, by_line=bool(os.environ.get("PYTHONUNBUFFERED")))
        sys.stderr = _text(self._err, sys.stderr, by_line=True)

    def settle(self, code: int) -> int:
        """The exit code of the process, given that of its command; says so where output was lost."""
        with suppress(SystemExit):
            sys.stdout.flush()
        lost = self._out.lost
        if lost is None or code != 0:
            return code
        if isinstance(lost, BrokenPipeError) and self._stop_at_pipe:
            return PIPE_CLOSED
        print(
            f"adaafford: the standard output could not be written ({lost.strerror}), so some of it is lost; "
            "all else was done",
            file=sys.stderr,
        )
        return 1


def _open_where_closed(descriptor: int, flags: int) -> bool:
    """Open /dev/null as a standard stream that is closed; returns whether it was."""
    try:
        os.fstat(descriptor)
    except OSError:
        # The lowest free number is this one, since those below are open by now.
        os.set_inheritable(os.open(os.devnull, flags), True)
        return True
    return False


def _text(sink: Sink, before: TextIO | None, *, by_line: bool) -> TextIO:
    """A stream of text into a sink; what its encoding lacks is written with backslashes."""
    encoding = getattr(before, "encoding", None) or "utf-8"
    buffered = io.BufferedWriter(sink)
    return io.TextIOWrapper(buffered, encoding, "backslashreplace", line_buffering=by_line or sink.isatty())


VARIABLE = "ADAAFFORD_LOG"
OURS = ("cluster", "collector", "learner", "shared")
"""Packages of which machines are told more than warnings."""
FIELDS = ("plan", "policy", "shard", "rollout", "worker", "interactions", "successes", "seconds", "reason")
"""What a line may be about."""


class Lines(logging.Formatter):
    """A record as one line for people."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """See `logging.Formatter.formatMessage`."""
        return plain(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        return without_secrets(super().format(record))


class JsonLines(logging.Formatter):
    """A record as a JSON object in one line."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {name: getattr(record, name) for name in FIELDS if hasattr(record, name)}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return without_secrets(json.dumps(line, default=str))


def configure(environment: Mapping[str, str]) -> None:
    """Set up logging of this process, to standard error.

    Args:
        environment: ADAAFFORD_LOG=json selects JSON lines, with more events.
    """
    as_json = environment.get(VARIABLE) == "json"
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if as_json else Lines("adaafford: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    for name in OURS if as_json else ():
        logging.getLogger(name).setLevel(logging.INFO)
