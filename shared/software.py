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
    commit = git_commit(Path(__file__).resolve().parents[1])
    return versions | ({COMMIT: commit} if commit else {})


def git_commit(root: Path) -> str:
    """The commit that a checkout stands at, read from its files; "" where that is not known."""
    folder = root / ".git"
    try:
        if folder.is_file():  # Another worktree of a repository has a file that names its folder.
            folder = root / folder.read_text(encoding="utf-8").strip().removeprefix("gitdir: ")
        head = (folder / "HEAD").read_text(encoding="utf-8").strip()
        if head.startswith("ref: "):
            head = _branch_commit(folder, head.removeprefix("ref: "))
    except (OSError, UnicodeDecodeError):
        return ""
    return head if re.fullmatch(r"[0-9a-f]{40,64}", head) else ""


def _branch_commit(folder: Path, name: str) -> str:
    """The commit of a branch such as refs/heads/main, given the folder of a worktree; "" if there is none."""
    shared = folder / "commondir"
    common = folder / shared.read_text(encoding="utf-8").strip() if shared.is_file() else folder
    if (common / name).is_file():
        return (common / name).read_text(encoding="utf-8").strip()
    packed = (line.split(" ") for line in (common / "packed-refs").read_text(encoding="utf-8").splitlines())
    return next((words[0] for words in packed if words[1:] == [name]), "")
