"""The killer: runs commands until they are done, and kills some process of theirs at one random moment after another.

    killer = Killer(campaign, marked, look, rng, counts, folder)
    killer.harass(kills=8)      # then the campaign is done, and was looked at after each kill

Moments and victims are drawn from the generator alone; events.txt, beside the commands' log, says what was done.
"""

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from shared.errors import WorkerError
from tests.chaos.counts import Counts
from tests.chaos.processes import Marked, Role

PATIENCE_S = 900.0
"""How long a campaign that nobody disturbs any more may take."""
LAST_BREATH_S = 300.0
"""How long what the dead leave behind may live on; Ray's processes notice after a minute that nobody is there."""
POLL_S = 0.05
DEPENDED_ON = (Role.HEAD, Role.GCS, Role.ALL)
"""What a driver cannot go on without, if it is its own node's."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """Commands that run at the same time, and who of them may be killed when.

    Attributes:
        name: for the counts.
        commands: arguments of `adaafford`, each a command that can be given again.
        within_s: a moment is drawn uniformly from so many seconds after the last kill.
        victims: roles by their odds.
    """

    name: str
    commands: Sequence[Sequence[str]]
    within_s: float
    victims: Mapping[Role, float]


@dataclass(slots=True)
class Killer:
    """Kills processes of one campaign, and gives the commands that this ended again.

    Attributes:
        campaign: which one.
        marked: whoever may be killed.
        look: looks at what was made, after each kill; raises AssertionError if a promise is broken.
        rng: draws moments and victims.
        counts: of all kills.
        folder: for the log of the commands.
        mend: is called after each kill, to start again what is no command of the campaign's.
    """

    campaign: Campaign
    marked: Marked
    look: Callable[[], object]
    rng: np.random.Generator
    counts: Counts
    folder: Path
    mend: Callable[[Role], None] = lambda role: None
    events: list[str] = field(default_factory=list)
    kills: int = 0
    _running: dict[int, psutil.Popen] = field(default_factory=dict)
    """By number of the command; what is done is not there any more."""
    _excused: set[int] = field(default_factory=set)
    """Commands that were killed, or may rightly fail since what they depend on was."""

    def harass(self, kills: int) -> None:
        """Run the campaign to its end; it is struck `kills` times at the most, less often if it ends before.

        Raises:
            AssertionError: a promise is broken, or a command failed of itself.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            for number in range(len(self.campaign.commands)):
                self._start(number)
            while self.kills < kills and self._lives_for(self.campaign.within_s * self.rng.random()):
                role = self._strike()
                self.look()
                if role is not None:
                    self.mend(role)
            assert not self._lives_for(PATIENCE_S), f"undisturbed at last, and not done within {PATIENCE_S:g} s"
            self.look()
        except BaseException as error:
            error.add_note("\n".join([self.campaign.name, *self.events, self.log.read_text()[-5000:]]))
            for process in self.marked.left():
                end(process)
            raise

    @property
    def log(self) -> Path:
        """What the commands printed."""
        return self.folder / "log.txt"

    def _start(self, number: int) -> None:
        self._excused.discard(number)
        self._running[number] = self.marked.start(self.campaign.commands[number], self.log)

    def _lives_for(self, seconds: float) -> bool:
        """Wait, and give again what was ended by a kill; whether there is anything left to do then."""
        deadline = time.monotonic() + seconds
        while True:
            for number, command in list(self._running.items()):
                code = command.poll()
                if code == 0:
                    del self._running[number]
                elif code is not None:
                    self._note(f"`{self.campaign.commands[number][0]}` ended with {code}")
                    assert number in self._excused, f"a command failed of itself, with {code}"
                    assert code in (-signal.SIGKILL, WorkerError.exit_code), f"a command ended with {code}"
                    self._start(number)
            if not self._running or time.monotonic() > deadline:
                return bool(self._running)
            time.sleep(POLL_S)

    def _strike(self) -> Role | None:
        """Kill somebody; returns who it was, None if nobody of the drawn role lives."""
        roles = list(self.campaign.victims)
        odds = np.array([self.campaign.victims[role] for role in roles])
        role = roles[int(self.rng.choice(len(roles), p=odds / odds.sum()))]
        which = self.rng.random()
        living = sorted(self.marked.in_role(role), key=lambda process: process.pid)
        victims = living if role is Role.ALL else living[int(which * len(living)) :][:1]
        own = {command.pid: number for number, command in self._running.items()}
        struck = {pid for victim in victims for pid in (victim.pid, _asked_by(victim, role))}
        self._excused |= set(own.values()) if role in DEPENDED_ON else {own[pid] for pid in struck if pid in own}
        if not sum(map(end, victims)):
            self._note(f"no {role} lives")
            return None
        self.kills += 1
        self.counts.killed(self.campaign.name, role)
        self._note(f"killed: {role}")
        return role

    def _note(self, event: str) -> None:
        self.events.append(f"{time.strftime('%H:%M:%S')} {event}")
        (self.folder / "events.txt").write_text("\n".join([*self.events, ""]))


def _asked_by(victim: psutil.Process, role: Role) -> int | None:
    """The command that had a learner trained, and ends with it: it says so, and is given again by whoever wants to."""
    try:
        return victim.ppid() if role is Role.LEARNER else None
    except psutil.NoSuchProcess:
        return None


def await_last_breath(everybody: Sequence[Marked]) -> None:
    """See that nothing is left behind that would live for ever.

    Raises:
        AssertionError: something is.
    """
    deadline = time.monotonic() + LAST_BREATH_S
    while living := [process for marked in everybody for process in marked.left()]:
        assert time.monotonic() < deadline, f"left behind: {living}"
        time.sleep(POLL_S)


def end(process: psutil.Process) -> bool:
    """Kill a process, and wait until it is dead; whether it still lived."""
    try:
        process.send_signal(signal.SIGKILL)
        # Waited for as any other's child is, since whoever started it wants its exit code.
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            time.sleep(0.001)
    except psutil.NoSuchProcess:
        return False
    return True
