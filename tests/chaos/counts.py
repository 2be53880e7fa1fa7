"""What was done to campaigns and commits, counted by each test, and printed when all is over."""

import json
from collections import Counter
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.chaos.processes import Role


@dataclass(slots=True)
class Counts:
    """Kills by campaign and role, and faults by kind; any number of threads may count."""

    kills: Counter[tuple[str, Role]] = field(default_factory=Counter)
    campaigns: Counter[str] = field(default_factory=Counter)
    """That ended as undisturbed ones, by name."""
    steps: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Write steps of a commit that were disturbed, by place and kind of fault."""
    lock: Lock = field(default_factory=Lock)

    def killed(self, campaign: str, role: Role) -> None:
        """Count a SIGKILL."""
        with self.lock:
            self.kills[campaign, role] += 1

    def ended(self, campaign: str) -> None:
        """Count a campaign that ended as it should."""
        with self.lock:
            self.campaigns[campaign] += 1

    def disturbed(self, place: str, fault: str, steps: int) -> None:
        """Count write steps, at each of which a commit was disturbed."""
        with self.lock:
            self.steps[place, fault] += steps

    def as_json(self) -> str:
        """All counts as text, which a process of pytest hands to the one that prints."""
        counters: tuple[Counter[Any], ...] = (self.kills, self.campaigns, self.steps)
        return json.dumps([list(counter.items()) for counter in counters])

    def add(self, text: str) -> None:
        """Add what `as_json` returned elsewhere."""
        kills, campaigns, steps = json.loads(text)
        self.kills.update({(name, Role(role)): count for (name, role), count in kills})
        self.campaigns.update(dict(campaigns))
        self.steps.update({(place, fault): count for (place, fault), count in steps})

    def print(self, seed: int) -> None:
        """Print all counts."""
        console = Console(width=130)
        if self.kills:
            table = Table(title=f"SIGKILLs at random moments, seed {seed}; after each, the store was verified")
            for heading in ("campaign", *Role, "kills", "ended with the undisturbed result"):
                table.add_column(heading, justify="left" if heading == "campaign" else "right")
            for name in sorted({name for name, _ in self.kills}):
                counts = [self.kills[name, role] for role in Role]
                table.add_row(name, *(str(n or "") for n in counts), str(sum(counts)), str(self.campaigns[name]))
            table.add_section()
            totals = [sum(n for (_, of), n in self.kills.items() if of is role) for role in Role]
            table.add_row("all", *map(str, totals), str(sum(totals)), str(self.campaigns.total()))
            console.print(table)
        if self.steps:
            table = Table(
                "place", "fault", "write steps of a commit", title="A fault at every write step, one at a time"
            )
            for (place, fault), steps in sorted(self.steps.items()):
                table.add_row(place, fault, str(steps))
            table.add_section()
            table.add_row("", "all", str(self.steps.total()))
            console.print(table)
