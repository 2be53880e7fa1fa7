"""What made a shard: software, commit and process. Kept beside the data, never part of the content digest.

    STORE/status/machine-<name>.json    which host a machine's name in the manifests stands for; no data

Manifests are published with the data, so they name a machine by a number alone. The host's name is in the folder of
what tells of the moment, which no copy, export or digest takes along.
"""

import json
import os
from collections.abc import Mapping
from contextlib import suppress

from shared.errors import StoreError
from shared.io.files import host_name, machine_name
from shared.software import COMMIT, software_versions
from shared.store.backends.base import StorageBackend
from shared.store.codecs.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS, fingerprint
from shared.store.layout import STATUS_FOLDER

SCHEMA = "schema"
"""Name of the fingerprint of the columns, beside the packages."""

_MAX_NOTE_BYTES = 1 << 12


def store_software() -> dict[str, str]:
    """Versions of the software, and a fingerprint of the columns that it knows, for documents of a store."""
    return software_versions() | {SCHEMA: fingerprint(ROLLOUT_COLUMNS, INTERACTION_COLUMNS)}


def process_provenance() -> dict[str, str]:
    """Machine and process."""
    return {"machine": machine_name(), "pid": str(os.getpid())}


def note_machine(backend: StorageBackend) -> None:
    """Write down in a store which host this machine is; nothing depends on it, so it is no error if that fails."""
    with suppress(StoreError, OSError):
        backend.create(_key(machine_name()), json.dumps({"host": host_name()}).encode())


def host_of(backend: StorageBackend, process: str) -> str:
    """The host of a process, by its `shared.io.files.process_name`; "" if the store does not know it."""
    try:
        found = json.loads(backend.read(_key(process.partition("-")[0]), _MAX_NOTE_BYTES))["host"]
    except (StoreError, ValueError, KeyError, TypeError, RecursionError):
        return ""
    return found if isinstance(found, str) else ""


def _key(machine: str) -> str:
    return f"{STATUS_FOLDER}/machine-{machine}.json"


def changed_versions(before: Mapping[str, str], now: Mapping[str, str] | None = None) -> str:
    """What differs between two sets of versions, such as "numpy 2.1.0 (now 2.2.0)"; "" if nothing does.

    The commit is left out: it changes with every checkout, and what it changes shows in the rest or in the digest.
    """
    now = store_software() if now is None else now
    compared = [name for name in sorted(before.keys() | now.keys()) if name != COMMIT]
    names = [name for name in compared if before.get(name) != now.get(name) and (name != SCHEMA or name in before)]
    return ", ".join(f"{name} {before.get(name, 'none')[:40]} (now {now.get(name, 'none')[:40]})" for name in names)
