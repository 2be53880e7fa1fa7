"""Results of benchmarks: one JSON object each, and dated files that name the hardware."""

import json
import math
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from shared.errors import UsageError
from shared.files import write_atomically
from shared.store.provenance import software_versions

CPU_INFO = Path("/proc/cpuinfo")


def as_line(result: dict[str, Any]) -> str:
    """A result as one line of JSON; what is not a finite number becomes null."""
    return json.dumps(_finite(result), allow_nan=False)


def keep(result: dict[str, Any], folder: Path, name: str) -> Path:
    """Write a result, with date, hardware and versions, to `folder`/DATE-`name`.json.

    Raises:
        UsageError: the folder cannot be made or written.
    """
    now = datetime.now(UTC)
    path = folder / f"{now:%Y-%m-%d}-{name}.json"
    document = {
        "date": now.isoformat(timespec="seconds"),
        "hardware": hardware(),
        "software": software_versions(),
        "result": result,
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (json.dumps(_finite(document), indent=2, allow_nan=False) + "\n").encode())
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}); name another folder") from None
    return path


def hardware() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30),
        "system": f"{platform.system()} {platform.machine()}",
        "load_of_last_minute": round(os.getloadavg()[0], 2),
    }


def _processor() -> str:
    """The processor's name, as far as the system tells."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
