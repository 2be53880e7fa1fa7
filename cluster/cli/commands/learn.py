"""`adaafford learn`: the learner as a separate process beside a collection; needs neither Ray nor SAPIEN."""

from contextlib import ExitStack
from dataclasses import dataclass

import tyro

from cluster.cli.commands.train import LearnerCommand, parse_learner
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class LearnCommand(LearnerCommand):
    """Train the prior, AAP and AIP, then AAP and AIP again, and publish policies into the store for its collectors.

    Without --follow it learns from what the store holds until that brings no more, and publishes the best policy. The
    same command again goes on where it was stopped.
    """

    follow: tyro.conf.FlagCreatePairsOff[bool] = False
    """Wait for the store and for rollouts, and publish a policy after each round."""
    first_rollouts: int = 100
    """With --follow: rollouts that the first round waits for."""
    more_rollouts: int = 30
    """With --follow: new rollouts that each further round waits for."""
    poll_s: float = 5.0
    """With --follow: seconds between two checks of the store."""


def main(args: list[str]) -> int:
    """Learn."""
    command = parse_learner(LearnCommand, args, "learn")
    for name in ("first_rollouts", "more_rollouts", "poll_s"):
        if getattr(command, name) <= 0:
            raise UsageError(f"--{name.replace('_', '-')} must be above 0; given {getattr(command, name)}")
    _learn(command)
    return 0


def _learn(command: LearnCommand) -> None:
    from learner.alternation import Finished, alternate
    from learner.rounds import Following, Pace, publish
    from learner.training import data_parallel
    from learner.training.hardware import hardware
    from shared.io.files import DRIVER_LOCK, exclusive_lock, make_folder
    from shared.store.store import Store

    job = command.job()
    with ExitStack() as stack:
        used = stack.enter_context(hardware(command.settings))
        if data_parallel.rank() == 0:
            make_folder(command.out)
            stack.enter_context(exclusive_lock(command.out / DRIVER_LOCK))
        if command.follow:
            pace = Pace(command.first_rollouts, command.more_rollouts, command.poll_s)
            alternate(Following(job, pace), command.settings, used)
        else:
            best = alternate(Finished(job), command.settings, used)
            publish(Store.open(command.store), command.out, "best", best)
