"""The ledger of a run: which stages are done, and how long each took over all attempts.

`log.jsonl` is append-only, one JSON object a line. A kill can at worst tear its last line, which is then ignored and
fenced off; so the file is both the log for people and the record that a resumption relies on.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shared.files import read_named

BEAT_S = 5.0
"""A stage under way is noted this often; a kill loses at most so much of its wall time."""
MAX_LOG_BYTES = 64 << 20

Clock = Callable[[], float]


class Ledger:
    """Stages done and seconds spent, kept in RUN/log.jsonl."""

    def __init__(self, path: Path, clock: Clock = time.monotonic) -> None:
        """Read what earlier attempts wrote.

        Raises:
            UsageError: the file is far too large to be ours.
        """
        self._path = path
        self._clock = clock
        self._lock = threading.Lock()
        self._seconds: dict[str, float] = {}
        self._results: dict[str, dict[str, Any]] = {}
        self._attempt_seconds = 0.0
        if path.exists():
            self._replay()

    @property
    def finished(self) -> tuple[str, ...]:
        """Stages that are done, in the order they ended."""
        return tuple(self._results)

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time of each stage over all attempts, in the order they began."""
        return dict(self._seconds)

    def result(self, stage: str) -> dict[str, Any]:
        """What a finished stage had to say."""
        return self._results[stage]

    def note(self, event: str, **details: Any) -> None:
        """Append one event, durably."""
        line = json.dumps({"time": round(time.time(), 3), "event": event, **details}, allow_nan=False)
        with self._lock:
            torn = self._path.exists() and not _ends_with_newline(self._path)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(f"\n{line}\n" if torn else f"{line}\n")
                file.flush()
                os.fsync(file.fileno())

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[Mapping[str, Any]], None]]:
        """Time a stage; it counts as done only if the body hands its result to what this yields, and ends well.

        >>> with ledger.stage("publish-1") as done:
        ...     done({"policy": store.publish_policy(1, files)})
        """
        earlier, begun = self._seconds.get(name, 0.0), self._clock()
        outcome: list[dict[str, Any]] = []

        def beat() -> None:
            self._seconds[name] = earlier + self._clock() - begun
            self.note("beat", stage=name, seconds=round(self._seconds[name], 3))

        self.note("began", stage=name)
        stop = threading.Event()
        thread = threading.Thread(target=_repeat, args=(beat, stop), daemon=True)
        thread.start()
        try:
            yield lambda result: outcome.append(dict(result))
        finally:
            stop.set()
            thread.join()
            beat()
        assert outcome, f"the stage {name} ended without a result"
        self.note("done", stage=name, seconds=round(self._seconds[name], 3), result=outcome[-1])
        self._results[name] = outcome[-1]

    def _replay(self) -> None:
        for line in read_named(self._path, MAX_LOG_BYTES, "not the log of a run").splitlines():
            try:
                entry = json.loads(line)
                stage, seconds = entry.get("stage"), entry.get("seconds")
                seconds = float(seconds) if isinstance(seconds, int | float) else None
            except (ValueError, AttributeError, OverflowError, RecursionError):
                continue  # Torn by a kill.
            if isinstance(stage, str) and seconds is not None:
                self._seconds[stage] = seconds
                if entry.get("event") == "done" and isinstance(entry.get("result"), dict):
                    self._results[stage] = entry["result"]


def _repeat(beat: Callable[[], None], stop: threading.Event) -> None:
    while not stop.wait(BEAT_S):
        beat()


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        if file.seek(0, os.SEEK_END) == 0:
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
