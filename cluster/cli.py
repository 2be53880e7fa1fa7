"""The command line `adaafford`: finds the subcommand, and turns errors into one line and an exit code.

Heavy packages are imported by the subcommands that need them, so that help is instant.
"""

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import NoReturn

from cluster.logs import configure
from shared.errors import AdaAffordError

INTERRUPTED = 130
"""Exit code after Ctrl-C, as a shell has it."""

COMMANDS = {
    "run": "collect, train, collect with what was learnt, evaluate: a whole campaign",
    "resume": "go on with a run that was stopped",
    "evaluate": "the table of the paper: F-score and sample-success of all methods, on any objects",
    "compare": "the runs of several seeds as one table, beside the paper's figures",
    "report": "print a run's results again, and draw its page anew",
    "adapt": "propose the next try on a scanned object, and say where it can be moved",
    "export-policy": "a run's policy in half precision with its model card, to take elsewhere",
    "collect": "collect interactions into a store, without any learning",
    "train": "prior, aap, aip or alternate: train from a store alone",
    "curve": "how much trainings find out from stored tries, between Where2Act and an oracle",
    "status": "how a run or a store stands: rate, done, left, workers",
    "learn": "train beside collection: wait for rollouts, publish policies for the collectors",
    "store": "info, verify, digest, replay, repair, compact, merge, export or migrate: look after stores",
    "objects": "generate, check, preview or decompose: the objects",
    "bench": "fidelity, dynamics, collect, store, scale, learner, adapt or hints: how fast and how true each part is",
    "version": "print the version",
}
"""Subcommands, each a module of `cluster.commands` with `main(args) -> int`."""

RESUMABLE = ("run", "resume", "collect", "train", "learn", "evaluate")

USAGE = "usage: adaafford COMMAND [ARGUMENTS]; `adaafford COMMAND --help` tells more\n\n" + "\n".join(
    f"  {name:<15}{text}" for name, text in COMMANDS.items()
)


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    begin_process()
    sys.exit(run(sys.argv[1:]))


def begin_process() -> None:
    """Set up logging and signals of a process of ours."""
    configure(os.environ)
    # As Ctrl-C does, so that workers and learners are ended in an orderly way.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


def run(args: list[str]) -> int:
    """Run one command line; returns its exit code."""
    if not args or args[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if args else 2
    name, rest = args[0], args[1:]
    if name == "--version":
        name = "version"
    if name not in COMMANDS:
        return _complain(f"unknown command '{name}'; allowed: {', '.join(COMMANDS)}", 2)
    return guarded(lambda: import_module(f"cluster.commands.{name.replace('-', '_')}").main(rest), args)


def guarded(command: Callable[[], int], args: list[str]) -> int:
    """Run a subcommand; what it raises becomes one line and an exit code.

    Args:
        command: returns its exit code.
        args: the command line that it came from.
    """
    try:
        code = command()
        sys.stdout.flush()
    except AdaAffordError as error:
        return _complain(str(error), error.exit_code)
    except KeyboardInterrupt:
        return _interrupted(args)
    except BrokenPipeError:
        # Whoever read our output has enough (`adaafford ... | head`); keep Python from complaining at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    return code


def _interrupted(args: list[str]) -> int:
    """Say how to go on after Ctrl-C."""
    hint = "; what is committed stays, and the same command goes on" if args[0] in RESUMABLE else ""
    print(
        f"adaafford: interrupted{hint}: adaafford {' '.join(args)}" if hint else "adaafford: interrupted",
        file=sys.stderr,
    )
    return INTERRUPTED


def _complain(message: str, code: int) -> int:
    """Print one line."""
    print(f"adaafford: {' '.join(message.split())}", file=sys.stderr)
    return code
