"""The run log of a run: which stages are done, and how long each took over all attempts.

`log.jsonl` is append-only, one JSON object a line. A kill can at worst tear its last line, which is then ignored and
fenced off; so the file is both the log for people and the record that a resumption relies on.

Heartbeats come the less often the longer a stage takes, so that the file of a year is no larger than that of a day.
"""

import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from shared.errors import UsageError
from shared.heartbeat import Heartbeat
from shared.io.files import sync_folder

BEAT_S, BEAT_SHARE = 5.0, 0.01
"""A stage under way is noted after so many seconds, or after this share of what the attempt has spent on it if that is
more; a kill loses at most so much of its wall time."""
MAX_LOG_BYTES = 1 << 30
"""Older software noted each stage every 5 s, which is 1.5 MB a day."""
MAX_LINE_BYTES = 1 << 20
MAX_STAGES = 1 << 14
MAX_SOFTWARE, MAX_VERSION = 100, 100
"""Sets of versions that are kept of a log, and characters of a version."""
_BEAT = re.compile(
    rb'\{"time": [0-9.]+, "event": "beat", "stage": "(?P<stage>[a-z0-9-]{1,100})", "seconds": [0-9.]+\}\n'
)

Clock = Callable[[], float]


class RunLog:
    """Finished stages and their wall time, in RUN/log.jsonl."""

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
        self._software: list[dict[str, str]] = []
        if path.exists():
            self._replay()

    @property
    def finished(self) -> tuple[str, ...]:
        """Finished stages, in the order of their ends."""
        return tuple(self._results)

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time of each stage over all attempts, in the order of their starts, s."""
        return dict(self._seconds)

    @property
    def software(self) -> tuple[dict[str, str], ...]:
        """Software versions of the attempts, without repetitions, in order."""
        return tuple(self._software)

    def result(self, stage: str) -> dict[str, Any]:
        """The result of a finished stage."""
        return self._results[stage]

    def run(self, stages: Mapping[str, Callable[[], Mapping[str, Any]]], say: Callable[[str], None]) -> None:
        """Run the unfinished stages in order; a stage may be repeated if a kill comes before its log entry.

        Args:
            stages: functions by name, the same names in every attempt; each returns its result.
            say: receives a line for each stage that begins or was already done.
        """
        before = [name for name in stages if name in self._results]
        if before:
            say(f"done before: {', '.join(before)}")
        for number, (name, do) in enumerate(stages.items(), start=1):
            if name not in before:
                say(f"stage {number} of {len(stages)}: {name}")
                with self.stage(name) as done:
                    done(do())

    def note(self, event: str, **details: Any) -> None:
        """Append one event, durably."""
        line = json.dumps({"time": round(time.time(), 3), "event": event, **details}, allow_nan=False)
        with self._lock:
            known = self._path.exists()
            torn = known and not _ends_with_newline(self._path)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(f"\n{line}\n" if torn else f"{line}\n")
                file.flush()
                os.fsync(file.fileno())
            if not known:
                sync_folder(self._path.parent)

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[Mapping[str, Any]], None]]:
        """Time a stage; it counts as done only if the body hands its result to what this yields, and ends well.

        >>> with run_log.stage("publish-1") as done:
        ...     done({"policy": store.publish_policy(1, files)})
        """
        earlier, begun = self._seconds.get(name, 0.0), self._clock()
        outcome: list[dict[str, Any]] = []

        def beat() -> None:
            self._seconds[name] = earlier + self._clock() - begun
            self.note("beat", stage=name, seconds=round(self._seconds[name], 3))

        def background_beat() -> None:
            # A full disk, say; the end of the stage is noted as well, and fails where that lasts.
            with suppress(OSError):
                beat()

        self.note("began", stage=name)
        try:
            with Heartbeat(background_beat, pause_s, "ledger"):
                yield lambda result: outcome.append(dict(result))
        finally:
            beat()
        assert outcome, f"the stage {name} ended without a result"
        self.note("done", stage=name, seconds=round(self._seconds[name], 3), result=outcome[-1])
        self._results[name] = outcome[-1]

    def _replay(self) -> None:
        # Also what is no file, such as a pipe, which would be waited for.
        if not self._path.is_file() or self._path.stat().st_size > MAX_LOG_BYTES:
            raise UsageError(f"{self._path}: no file of at most {MAX_LOG_BYTES} bytes; not the log of a run")
        # Of the heartbeats, nearly all of a long log, only the last of each stage counts: others are not even parsed.
        beats: dict[bytes, bytes] = {}
        with self._path.open("rb") as file:
            while line := file.readline(MAX_LINE_BYTES):
                if (beat := _BEAT.fullmatch(line)) and (len(beats) < MAX_STAGES or beat["stage"] in beats):
                    beats[beat["stage"]] = line
                    self._seconds.setdefault(beat["stage"].decode(), 0.0)
                else:
                    self._take_in(beats)
                    self._take_in({b"": line})
        self._take_in(beats)

    def _take_in(self, lines: dict[bytes, bytes]) -> None:
        """Take note of some lines, and forget them."""
        for line in lines.values():
            try:
                entry = json.loads(line)
                stage, seconds, software = entry.get("stage"), entry.get("seconds"), entry.get("software")
                seconds = float(seconds) if isinstance(seconds, int | float) else None
            except (ValueError, AttributeError, OverflowError, RecursionError):
                continue  # Torn by a kill.
            if isinstance(stage, str) and seconds is not None:
                if stage not in self._seconds and len(self._seconds) >= MAX_STAGES:
                    continue
                self._seconds[stage] = seconds
                if entry.get("event") == "done" and isinstance(entry.get("result"), dict):
                    self._results[stage] = entry["result"]
            if isinstance(software, dict) and len(self._software) < MAX_SOFTWARE and software not in self._software:
                self._software.append({str(name): str(version)[:MAX_VERSION] for name, version in software.items()})
        lines.clear()


def pause_s(spent_s: float) -> float:
    """Seconds until the next heartbeat of a stage after this many seconds of an attempt."""
    return max(BEAT_S, BEAT_SHARE * spent_s)


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        if file.seek(0, os.SEEK_END) == 0:
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
