"""Processes of one campaign, found by a mark in their environment, whoever started them and whoever adopted them."""

import os
import sys
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
MARK = "ADAAFFORD_CHAOS_MARK"
PROGRAM = "import sys; from cluster.cli.main import main; main()"
LEARNING = {"train", "learn"}


class Role(StrEnum):
    """What a process is to a campaign."""

    DRIVER = "driver"
    ACTOR = "actor"
    RAYLET = "raylet"
    """Of a node that may leave."""
    HEAD = "head's raylet"
    GCS = "gcs server"
    LEARNER = "learner"
    ALL = "all at once"
    """No role of one process: everything that bears the mark, as a machine's power cut takes it."""


COMMANDS = {Role.DRIVER, Role.LEARNER, Role.ACTOR}
"""What lives no longer than the command that it belongs to."""


@dataclass(frozen=True, slots=True)
class Marked:
    """All processes that bear one mark.

    Attributes:
        environment: variables that differ from this process's.
        outlives: whether there is a Ray cluster among them that stays when the commands are done.
        mark: no other processes bear it.
    """

    environment: Mapping[str, str] = field(default_factory=dict)
    outlives: bool = False
    mark: str = field(default_factory=lambda: uuid.uuid4().hex)

    def start(self, arguments: Sequence[str], log: Path) -> psutil.Popen:
        """Start `adaafford ARGUMENTS` in a process group of its own; what it prints is added to a file."""
        return self.execute([sys.executable, "-c", PROGRAM, *arguments], log)

    def execute(self, command: Sequence[str], log: Path) -> psutil.Popen:
        """Start a command likewise."""
        # Processes that set their title would otherwise overwrite the environment that others read.
        marked = {MARK: self.mark, "SPT_NOENV": "1", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        with log.open("a") as out:
            return psutil.Popen(
                command,
                stdout=out,
                stderr=out,
                env={**os.environ, **self.environment, **marked},
                start_new_session=True,
            )

    def living(self) -> list[psutil.Process]:
        """All that live, zombies left out."""
        return [process for process in psutil.process_iter() if self._bears(process)]

    def in_role(self, role: Role) -> list[psutil.Process]:
        """Those that live and have a role."""
        if role is Role.ALL:
            return self.living()
        return [process for process in self.living() if role_of(process) is role]

    def left(self) -> list[psutil.Process]:
        """What should be gone once all commands have ended."""
        living = self.living()
        return [process for process in living if role_of(process) in COMMANDS] if self.outlives else living

    def _bears(self, process: psutil.Process) -> bool:
        try:
            return process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == self.mark
        except (psutil.Error, OSError):
            return False


def role_of(process: psutil.Process) -> Role | None:
    """What a process does, by its command; None for what is of no interest, or gone."""
    try:
        command = process.cmdline()
    except psutil.Error:
        return None
    if not command:
        return None
    if command[0].startswith("ray::WorkerActor"):
        return Role.ACTOR
    if command[0].endswith("/raylet"):
        return Role.HEAD if "--head" in command else Role.RAYLET
    if command[0].endswith("/gcs_server"):
        return Role.GCS
    if PROGRAM in command[:3]:
        return Role.LEARNER if command[3] in LEARNING else Role.DRIVER
    if "cluster.cli.child" in command[1:4]:
        return Role.LEARNER
    return None
