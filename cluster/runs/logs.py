"""Logging: text lines for people, or JSON lines for programs, with rollout and worker.

    ADAAFFORD_LOG=json adaafford collect ... 2>log.jsonl

A log call gives the subject of a line as `extra`, with the names in `FIELDS`; the text format has only the message.
"""

import json
import logging
from collections.abc import Mapping
from datetime import UTC, datetime

from shared.io.redaction import without_secrets
from shared.io.text import plain

VARIABLE = "ADAAFFORD_LOG"
OURS = ("cluster", "collector", "learner", "shared")
"""Packages of which machines are told more than warnings."""
FIELDS = ("plan", "policy", "shard", "rollout", "worker", "interactions", "successes", "seconds", "reason")
"""What a line may be about."""


class Lines(logging.Formatter):
    """A record as one line for people."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """See `logging.Formatter.formatMessage`."""
        return plain(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        return without_secrets(super().format(record))


class JsonLines(logging.Formatter):
    """A record as a JSON object in one line."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {name: getattr(record, name) for name in FIELDS if hasattr(record, name)}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return without_secrets(json.dumps(line, default=str))


def configure(environment: Mapping[str, str]) -> None:
    """Set up logging of this process, to standard error.

    Args:
        environment: ADAAFFORD_LOG=json selects JSON lines, with more events.
    """
    as_json = environment.get(VARIABLE) == "json"
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if as_json else Lines("adaafford: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    for name in OURS if as_json else ():
        logging.getLogger(name).setLevel(logging.INFO)
