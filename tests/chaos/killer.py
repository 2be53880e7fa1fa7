"""The killer: runs a command until it is done, and kills some process of it at one random moment after the other.

    killer = Killer(campaign, marked, witness, rng, counts)
    killer.harass(kills=8)      # then the campaign is done, and was looked at after each kill

Moments and victims are drawn from the generator alone; `events` says what was done, so that a failure can be repeated.
"""

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from tests.chaos.counts import Counts
from tests.chaos.processes import Marked, Role
from tests.chaos.witness import Witness

PATIENCE_S = 240.0
"""How long a campaign that nobody disturbs any more may take."""
LAST_BREATH_S = 120.0
"""How long what a dead driver leaves may live on."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """A command, and who of it may be killed when.

    Attributes:
        name: for the counts.
        arguments: of `adaafford`.
        store: folder or URL.
        within_s: a moment is drawn uniformly from so many seconds after the start, or after the last kill.
        victims: roles by their odds.
    """

    name: str
    arguments: Sequence[str]
    store: str
    within_s: float
    victims: Mapping[Role, float]


@dataclass(slots=True)
class Killer:
    """Kills processes of one campaign.

    Attributes:
        campaign: which one.
        marked: whoever may be killed.
        witness: looks at the store after each kill.
        rng: draws moments and victims.
        counts: of all kills.
        folder: for the log of the command.
        mend: is called after each kill of what is not the command itself, to start it again where a user would.
    """

    campaign: Campaign
    marked: Marked
    witness: Witness
    rng: np.random.Generator
    counts: Counts
    folder: Path
    mend: Callable[[Role], None] = lambda role: None
    events: list[str] = field(default_factory=list)
    kills: int = 0

    def harass(self, kills: int) -> None:
        """Run the campaign to its end; it is killed `kills` times at the most, less often if it ends before.

        Raises:
            AssertionError: the store broke a promise, or the command failed of itself.
        """
        try:
            while not self._attempt(kills):
                pass
            self.witness.look()
            self._await_the_last_breath()
        except BaseException as error:
            error.add_note("\n".join([self.campaign.name, *self.events, self.log.read_text()[-3000:]]))
            raise

    @property
    def log(self) -> Path:
        """What the command printed."""
        return self.folder / "log.txt"

    def _attempt(self, kills: int) -> bool:
        """Start the command, and see it to its end; whether it was done then."""
        command = self.marked.start(self.campaign.arguments, self.log)
        excused = False
        while self.kills < kills and self._lives_for(command, self.campaign.within_s * self.rng.random()):
            role = self._kill(command)
            excused |= role is not None
            self.witness.look()
            if role is not None:
                self.mend(role)
        code = self._end_of(command)
        self.events.append(f"the command ended with {code}")
        assert code == 0 or excused, f"the command failed with {code}"
        return code == 0

    def _lives_for(self, command: psutil.Popen, seconds: float) -> bool:
        """Wait; whether the command still runs then."""
        try:
            command.wait(seconds)
        except psutil.TimeoutExpired:
            return True
        return False

    def _end_of(self, command: psutil.Popen) -> int:
        try:
            return int(command.wait(PATIENCE_S))
        except psutil.TimeoutExpired:
            command.kill()
            raise AssertionError(f"nobody disturbed it any more, and yet it took more than {PATIENCE_S:g} s") from None

    def _kill(self, command: psutil.Popen) -> Role | None:
        """Kill somebody; returns who it was, None if nobody of the drawn role lives."""
        roles = list(self.campaign.victims)
        odds = np.array([self.campaign.victims[role] for role in roles])
        role = roles[int(self.rng.choice(len(roles), p=odds / odds.sum()))]
        living = sorted(self.marked.in_role(role), key=lambda process: process.pid)
        victims = living if role is Role.ALL else living[int(self.rng.integers(len(living))) :][:1] if living else []
        for victim in victims:
            try:
                victim.send_signal(signal.SIGKILL)
            except psutil.NoSuchProcess:
                return None
        if not victims:
            return None
        self.kills += 1
        self.counts.killed(self.campaign.name, role)
        self.events.append(f"{time.strftime('%H:%M:%S')} killed: {role}, one of {len(living)}")
        if role in (Role.DRIVER, Role.ALL):
            command.wait()
        return role

    def _await_the_last_breath(self) -> None:
        """See that nothing is left behind that would live for ever."""
        deadline = time.monotonic() + LAST_BREATH_S
        while self.marked.living():
            assert time.monotonic() < deadline, [process.cmdline()[:3] for process in self.marked.living()]
            time.sleep(0.2)
