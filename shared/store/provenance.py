"""What made a shard: software, commit and process. Kept beside the data, never part of the content digest."""

import os
import platform
import re
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

from shared.files import host_name
from shared.store.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS, fingerprint

SCHEMA = "schema"
"""Name of the fingerprint of the columns, beside the packages."""
_COMMIT = "git_commit"
_PACKAGES = ("adaafford", "numpy", "pyarrow", "zarr", "torch", "sapien", "ray", "embreex")


@cache
def software_versions() -> dict[str, str]:
    """Versions of Python and of the packages that data depend on, without importing them."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    commit = _git_commit(Path(__file__).resolve().parents[2])
    return versions | ({_COMMIT: commit} if commit else {})


@cache
def store_software() -> dict[str, str]:
    """The same, and a fingerprint of the columns that this software knows, for documents of a store."""
    return software_versions() | {SCHEMA: fingerprint(ROLLOUT_COLUMNS, INTERACTION_COLUMNS)}


def difference_of_software(before: Mapping[str, str]) -> str:
    """In which packages this software differs from one that a store names, in one line; "" for none."""
    now = store_software()
    # The commit changes with every checkout, and what it changes shows in the rest or in the data's digest.
    names = [name for name in sorted(before.keys() | now.keys()) if name != _COMMIT]
    differing = [name for name in names if before.get(name) != now.get(name) and (name != SCHEMA or name in before)]
    return ", ".join(f"{name} {before.get(name, 'none')} before, {now.get(name, 'none')} now" for name in differing)


def process_provenance() -> dict[str, str]:
    """Host and process."""
    return {"host": host_name(), "pid": str(os.getpid())}


def _git_commit(root: Path) -> str:
    """The commit that a checkout stands at, read from its files; "" where that is not known."""
    try:
        head = (root / ".git" / "HEAD").read_text(encoding="utf-8").strip()
        if head.startswith("ref: "):
            head = (root / ".git" / head.removeprefix("ref: ")).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
    return head if re.fullmatch(r"[0-9a-f]{40,64}", head) else ""
