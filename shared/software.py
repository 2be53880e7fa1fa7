"""Versions of the software that runs here, which files note and caches are known by."""

import platform
import re
from functools import cache
from importlib import metadata
from pathlib import Path

COMMIT = "git_commit"
"""Name of the commit, beside the packages."""
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
    commit = _git_commit(Path(__file__).resolve().parents[1])
    return versions | ({COMMIT: commit} if commit else {})


def _git_commit(root: Path) -> str:
    """The commit that a checkout stands at, read from its files; "" where that is not known."""
    try:
        head = (root / ".git" / "HEAD").read_text(encoding="utf-8").strip()
        if head.startswith("ref: "):
            head = (root / ".git" / head.removeprefix("ref: ")).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
    return head if re.fullmatch(r"[0-9a-f]{40,64}", head) else ""
