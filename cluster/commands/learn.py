"""`adaafford learn`: the learner as a process of its own, beside collection; needs neither Ray nor SAPIEN."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.settings import early_flags, layered, parse_flags
from learner.configuration import LearnerConfig
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class LearnCommand:
    """Train the prior, AAP and AIP, then AAP and AIP again, and publish policies into the store for its collectors.

    Without --follow it learns from what the store holds until that brings no more, and publishes the best policy. The
    same command again goes on where it was stopped.
    """

    settings: Annotated[LearnerConfig, tyro.conf.arg(name="")]
    store: str
    """Folder or s3:// URL of the store."""
    out: Path
    """Folder for policies, metrics and checkpoints: new, or of the same learner."""
    follow: tyro.conf.FlagCreatePairsOff[bool] = False
    """Wait for rollouts, also for the store itself, and publish a policy after each round."""
    first_rollouts: int = 100
    """With --follow: rollouts that the first round waits for."""
    more_rollouts: int = 30
    """With --follow: new rollouts that each further round waits for."""
    poll_s: float = 5.0
    """With --follow: seconds between two looks into the store."""
    train_objects: Path | None = None
    """A text file with the ids of the objects to learn from, one a line."""
    validation_objects: Path | None = None
    """The same, of the objects to judge by; without both, one object in five is kept for that."""
    config: Path | None = None
    """A TOML file of settings; flags are laid over it."""


def main(args: list[str]) -> int:
    """Learn."""
    early = early_flags(args, "config")
    config = Path(early["config"]) if early["config"] else None
    defaults = LearnCommand(layered(LearnerConfig, None, config), tyro.MISSING, tyro.MISSING, config=config)
    command = parse_flags(LearnCommand, args, "learn", defaults)
    for name in ("first_rollouts", "more_rollouts", "poll_s"):
        if getattr(command, name) <= 0:
            raise UsageError(f"--{name.replace('_', '-')} must be above 0; given {getattr(command, name)}")
    _learn(command)
    return 0


def _learn(command: LearnCommand) -> None:
    from cluster.locking import only_driver
    from learner import sharing
    from learner.alternation import Finished, alternate
    from learner.data import read_object_list
    from learner.following import Following, Pace, publish
    from learner.hardware import hardware
    from learner.stages import StageJob
    from shared.store.store import Store

    job = StageJob(
        stage="prior",
        store=command.store,
        out=command.out,
        train_objects=read_object_list(command.train_objects),
        validation_objects=read_object_list(command.validation_objects),
    )
    with ExitStack() as stack:
        used = stack.enter_context(hardware(command.settings))
        if sharing.rank() == 0:
            _make_folder(command.out)
            stack.enter_context(only_driver(command.out))
        if command.follow:
            pace = Pace(command.first_rollouts, command.more_rollouts, command.poll_s)
            alternate(job, command.settings, used, Following(command.store, command.out, pace))
            return
        store = Store.open(command.store)
        best = alternate(job, command.settings, used, Finished(store))
        publish(store, command.out, "best", best.folder)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {path}: cannot be made ({error.strerror}); choose another folder") from None
