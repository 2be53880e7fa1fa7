"""What made a shard: software, commit and process. Kept beside the data, never part of the content digest."""

import os
import platform
import re
from functools import cache
from importlib import metadata
from pathlib import Path

from shared.files import host_name

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
    return versions | ({"git_commit": commit} if commit else {})


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
