"""The command line `adaafford`: finds the subcommand, and turns errors into one line and an exit code.

Heavy packages are imported by the subcommands that need them, so that help is instant.
"""

import logging
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from importlib import import_module
from types import TracebackType
from typing import NoReturn

import adaafford  # noqa: F401 - it sees first that nothing shadows our packages.
from cluster.runs.streams import Streams, configure
from shared.errors import AdaAffordError, UsageError
from shared.extras import extra_of, missing_line, require
from shared.interrupts import ENDING, heeded
from shared.io.text import plain, without_secrets

logger = logging.getLogger(__name__)

SPINS = 30_000
"""Turns of its loop that a waiting OpenMP thread takes before it sleeps, a tenth of the default: training keeps its
speed on a quiet machine, and its fair share of a busy one."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as a shell has it."""

COMMANDS = {
    "run": "a whole campaign: collect, train, collect proposed interactions, evaluate",
    "resume": "continue a run that was stopped",
    "evaluate": "the table of the paper: F-score and sample-success of all methods, on any objects",
    "compare": "one table of the runs of several seeds, beside the paper's figures",
    "report": "print the results of a run again, and write its page again",
    "adapt": "propose the next interaction with a scanned object, and predict where it can be moved",
    "rehearse": "a simulated robot that speaks the protocol of adapt --follow: test a program before hardware moves",
    "export-policy": "write a run's policy in half precision, with a model card",
    "calibrate": "fit a policy's probabilities to a few interactions with your own objects",
    "collect": "collect interactions into a store, without training",
    "train": "prior, aap, aip or alternate: train from a store",
    "curve": "how much critics know about hidden facts after some interactions",
    "status": "status of a run or a store: rate, done, left, workers",
    "learn": "train beside a collection: wait for rollouts, and publish policies",
    "view": "a store, a run or a scan in the browser: rollouts, beliefs, simulations; marks of movable points",
    "store": "info, verify, digest, replay, repair, compact, merge, export or check-place: work with stores",
    "objects": "generate, import, export, check, preview, film or decompose objects",
    "bench": "fidelity, dynamics, collect or learner: measure what helps to choose settings",
    "version": "print the version",
}
"""Subcommands, each a module of `cluster.cli.commands` with `main(args) -> int`."""

NEEDS = {
    "run": ("collect", "report"),
    "resume": ("collect", "report"),
    "evaluate": ("collect",),
    "compare": ("report",),
    "report": ("report",),
    "collect": ("collect",),
    "rehearse": ("collect",),
    "curve": ("report",),
    "view": ("view",),
    "objects": ("collect",),
    "bench": ("collect",),
}
"""Extras without which a command would fail, perhaps after hours; what only some of its uses need is not among them."""

RESUMABLE = (
    *("run", "resume", "collect", "train", "learn", "evaluate", "rehearse"),
    *("objects scenes", "store export"),
)
"""Long work, with which the same command goes on after an interruption."""

USAGE = "usage: adaafford COMMAND [ARGUMENTS]; `adaafford COMMAND --help` shows more\n\n" + "\n".join(
    f"  {name:<15}{text}" for name, text in COMMANDS.items()
)


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    args = sys.argv[1:]
    streams = begin_process(stop_at_pipe=only_prints(args))
    try:
        try:
            code = _run(args)
        finally:
            # A second signal must not interrupt the report of the first.
            _answer(ENDING, _pass_over)
    except KeyboardInterrupt:
        code = _interrupted(args)
    except _Ended as ended:
        code = _interrupted(args, 128 + ended.number)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else _complain(str(stop.code), 1) if stop.code else 0
    # All is done and said, so that a signal may end the process at once, without a traceback.
    _answer(ENDING, signal.SIG_DFL)
    sys.exit(streams.settle(code))


def only_prints(args: list[str]) -> bool:
    """Whether a command line leaves nothing but its output, so that it can end where nobody reads that any more."""
    if {"-h", "--help", "--dry-run"}.intersection(args):
        return True
    return not _is_resumable(args) and not any(arg.partition("=")[0] == "--out" for arg in args)


def _is_resumable(args: list[str]) -> bool:
    """Whether a command line is long work with which the same command goes on."""
    return any(" ".join(args[:words]) in RESUMABLE for words in (1, 2))


def begin_process(*, stop_at_pipe: bool = False) -> Streams:
    """Set up standard streams, logging and signals of a process of ours; returns the streams.

    Args:
        stop_at_pipe: see `Streams`.
    """
    streams = Streams(stop_at_pipe=stop_at_pipe)
    configure(os.environ)
    if "OMP_WAIT_POLICY" not in os.environ:
        # Read when PyTorch is imported, and inherited by child processes. On a busy machine, a thread that waits in a
        # loop keeps the processor from the very thread that it waits for.
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
    sys.excepthook = _show_traceback
    # As Ctrl-C does, so that workers and learners are ended in an orderly way.
    _answer((signal.SIGTERM, signal.SIGHUP), _end)
    return streams


def run(args: list[str]) -> int:
    """Run one command line; returns its exit code."""
    return guarded(lambda: _run(args), args)


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if args else 2
    name, rest = args[0], args[1:]
    if name == "--version":
        name = "version"
    if name not in COMMANDS:
        return _complain(f"unknown command '{name}'; allowed: {', '.join(COMMANDS)}", 2)

    def command() -> int:
        if not {"-h", "--help"}.intersection(rest):
            # Ray is needed by several workers alone, and asked for when they start.
            require(f"adaafford {name}", *NEEDS.get(name, ()), without=("ray",))
        code: int = import_module(f"cluster.cli.commands.{name.replace('-', '_')}").main(rest)
        return code

    return _told(command, args)


def guarded(command: Callable[[], int], args: list[str]) -> int:
    """Run a subcommand; what it raises, and Ctrl-C, becomes one line and an exit code.

    Args:
        command: returns its exit code.
        args: the command line that it came from.
    """
    try:
        return _told(command, args)
    except KeyboardInterrupt:
        return _interrupted(args)


def _told(command: Callable[[], int], args: list[str]) -> int:
    """See `guarded`; Ctrl-C is raised."""
    try:
        with heeded():
            code = command()
            sys.stdout.flush()
    except AdaAffordError as error:
        return _complain(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        if extra_of(error.name) is None:
            raise
        return _complain(missing_line(f"adaafford {args[0]} here", str(error.name)), UsageError.exit_code)
    except OSError as error:
        logger.info("what the system refused", exc_info=True)
        place = f"{error.filename}: " if error.filename else ""
        return _complain(f"{place}{error.strerror or error}; correct this and run the same command again", 1)
    return code


def _answer(numbers: Iterable[signal.Signals], handler: Callable[[int, object], object] | signal.Handlers) -> None:
    """Handle signals, except for those that whoever started this process has ignored, as `nohup` has SIGHUP."""
    for number in numbers:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


class _Ended(SystemExit):
    """SIGTERM or SIGHUP ends the command."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number


def _end(number: int, frame: object) -> NoReturn:
    raise _Ended(number)


def _pass_over(number: int, frame: object) -> None:
    """The command is ending already."""


def _interrupted(args: list[str], code: int = INTERRUPTED) -> int:
    """Say how to go on after a signal that ended the command; returns its exit code."""
    hint = "; committed data stay, and the same command continues" if _is_resumable(args) else ""
    print(
        f"adaafford: interrupted{hint}: adaafford {plain(without_secrets(shlex.join(args)))}"
        if hint
        else "adaafford: interrupted",
        file=sys.stderr,
    )
    return code


def _complain(message: str, code: int) -> int:
    """Print one line."""
    print(f"adaafford: {plain(without_secrets(' '.join(message.split())))}", file=sys.stderr)
    return code


def _show_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """As Python shows what is our own mistake, without secrets that its text may quote."""
    print(without_secrets("".join(traceback.format_exception(kind, error, trace))), end="", file=sys.stderr)
