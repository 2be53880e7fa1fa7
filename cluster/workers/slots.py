"""Slots of a worker group: each holds one actor and the jobs that were submitted to it.

Slots are queued by state, so every operation is O(1) in the number of slots.
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
"""Jobs in flight for each actor: one is executed, and one waits so that the actor is never idle."""


@dataclass(slots=True, eq=False)
class Task:
    """A request to an actor: to start, or to execute a job.

    Attributes:
        planned: the job; None for the start.
        answer: the name of its process, or the job result.
    """

    planned: PlannedJob | None
    answer: "Future[Any]"


@dataclass(slots=True, eq=False)
class Slot:
    """One actor, if it has been started, and its tasks, oldest first."""

    actor: Any = None
    """None: the slot is empty."""
    process: str = ""
    """The name of its process, which is also that of its heartbeats; "" until the process has started."""
    tasks: deque[Task] = field(default_factory=deque)
    busy_since: float = 0.0
    """Since when the actor starts, or its oldest task is executed; `time.monotonic`."""
    seen: tuple[Heartbeat | None, float] | None = None
    """The last heartbeat that was read, and since when it has not changed."""
    first_mb: float | None = None
    """Memory of the process after its first job, MB."""
    retiring: bool = False
    """Whether the actor gets no further jobs."""

    @property
    def planned_jobs(self) -> list[PlannedJob]:
        """The jobs in flight, oldest first."""
        return [task.planned for task in self.tasks if task.planned is not None]

    def complete(self) -> None:
        """Remove the oldest task."""
        self.tasks.popleft()
        self.busy_since, self.seen = time.monotonic(), None

    def look(self, crash_log: CrashLog) -> tuple[Heartbeat | None, float]:
        """The heartbeat of the running rollout, and since when it has not changed."""
        heartbeat = crash_log.heartbeat_of(self.process)
        if self.seen is None or self.seen[0] != heartbeat:
            self.seen = heartbeat, time.monotonic()
        return self.seen

    def clear(self) -> None:
        """Make the slot empty."""
        self.actor = self.seen = self.first_mb = None
        self.process, self.retiring = "", False
        self.tasks.clear()


class Slots:
    """All slots, queued by state; call `update` after each change of a slot."""

    def __init__(self, count: int) -> None:
        self._all = [Slot() for _ in range(count)]
        # In an OrderedDict the first entry is found in O(1) after removals, unlike in a dict.
        self._empty = OrderedDict[Slot, None].fromkeys(self._all)
        self._called = OrderedDict[Slot, None]()
        self._idle = tuple(OrderedDict[Slot, None]() for _ in range(IN_FLIGHT))
        """One queue for each number of jobs in flight."""
        self._next_look = 0

    def __iter__(self) -> Iterator[Slot]:
        return iter(self._all)

    @property
    def called(self) -> int:
        """How many actors are starting."""
        return len(self._called)

    @property
    def empty(self) -> Slot | None:
        """A slot without an actor."""
        return next(iter(self._empty), None)

    @property
    def most_idle(self) -> Slot | None:
        """A slot with the fewest jobs that may get one; None if all are busy."""
        return next((slot for idle in self._idle for slot in idle), None)

    def update(self, slot: Slot) -> None:
        """Put a slot into the queue of its present state."""
        for queue in (self._empty, self._called, *self._idle):
            queue.pop(slot, None)
        if slot.actor is None:
            self._empty[slot] = None
        elif not slot.process:
            self._called[slot] = None
        elif not slot.retiring and len(slot.tasks) < IN_FLIGHT:
            self._idle[len(slot.tasks)][slot] = None

    def round_robin(self) -> Iterator[Slot]:
        """Each slot once, beginning where the last iteration stopped."""
        for _ in self._all:
            slot = self._all[self._next_look]
            self._next_look = (self._next_look + 1) % len(self._all)
            yield slot
