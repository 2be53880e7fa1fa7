"""Slots of a worker group: each holds one actor and the jobs that it was given.

Slots are queued by state, so every operation takes the same time however many slots there are.
"""

import time
from collections import OrderedDict, deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from cluster.workers.job_queue import PlannedJob
from shared.store.crash_log import CrashLog, Heartbeat

IN_FLIGHT = 2
"""Jobs an actor holds: one under way, one that waits so that the actor never idles for the driver's sake."""


@dataclass(slots=True, eq=False)
class Task:
    """What an actor was asked: to arrive, or to execute an order.

    Attributes:
        order: None if it is to arrive.
        answer: its process's name, or the job result.
    """

    order: PlannedJob | None
    answer: "Future[Any]"


@dataclass(slots=True, eq=False)
class Slot:
    """A place for one actor, and what it was asked, oldest first."""

    actor: Any = None
    """None: the place is empty."""
    process: str = ""
    """By which name its heartbeats go; "" until it is up."""
    tasks: deque[Task] = field(default_factory=deque)
    busy_since: float = 0.0
    """When the actor was called, or the oldest task came to the head; `time.monotonic`."""
    seen: tuple[Heartbeat | None, float] | None = None
    """The last heartbeat that was looked at, and since when it has been the same."""
    first_mb: float | None = None
    """What the process held after its first job."""
    retiring: bool = False
    """Whether it is only to finish what it has."""

    @property
    def orders(self) -> list[PlannedJob]:
        """What it holds, oldest first."""
        return [task.order for task in self.tasks if task.order is not None]

    def settle(self) -> None:
        """Strike out the oldest task; the next one comes to the head."""
        self.tasks.popleft()
        self.busy_since, self.seen = time.monotonic(), None

    def look(self, crash_log: CrashLog) -> tuple[Heartbeat | None, float]:
        """The heartbeat of the rollout under way, and since when it has been seen unchanged."""
        heartbeat = crash_log.heartbeat_of(self.process)
        if self.seen is None or self.seen[0] != heartbeat:
            self.seen = heartbeat, time.monotonic()
        return self.seen

    def clear(self) -> None:
        """Forget the actor and all that was about it."""
        self.actor = self.seen = self.first_mb = None
        self.process, self.retiring = "", False
        self.tasks.clear()


class Slots:
    """All slots, queued by state; call `file` after each change of a slot."""

    def __init__(self, count: int) -> None:
        self._all = [Slot() for _ in range(count)]
        # Unlike a plain dict's, its first entry is found at once, however many before that were removed.
        self._empty = OrderedDict[Slot, None].fromkeys(self._all)
        self._called = OrderedDict[Slot, None]()
        self._idle = tuple(OrderedDict[Slot, None]() for _ in range(IN_FLIGHT))
        """By how many jobs they hold."""
        self._next_look = 0

    def __iter__(self) -> Iterator[Slot]:
        return iter(self._all)

    @property
    def called(self) -> int:
        """How many actors are on their way."""
        return len(self._called)

    @property
    def empty(self) -> Slot | None:
        """A slot without an actor."""
        return next(iter(self._empty), None)

    @property
    def most_idle(self) -> Slot | None:
        """A slot that may be given a job; none gets a second one while another has none."""
        return next((slot for idle in self._idle for slot in idle), None)

    def file(self, slot: Slot) -> None:
        """Queue a slot by its present state."""
        for drawer in (self._empty, self._called, *self._idle):
            drawer.pop(slot, None)
        if slot.actor is None:
            self._empty[slot] = None
        elif not slot.process:
            self._called[slot] = None
        elif not slot.retiring and len(slot.tasks) < IN_FLIGHT:
            self._idle[len(slot.tasks)][slot] = None

    def in_turn(self) -> Iterator[Slot]:
        """Each slot once; whoever stops early is given the next ones another time."""
        for _ in self._all:
            slot = self._all[self._next_look]
            self._next_look = (self._next_look + 1) % len(self._all)
            yield slot
