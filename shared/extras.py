"""Optional packages: the extra of this project that installs each, and the message if one is missing."""

from collections.abc import Mapping
from importlib.util import find_spec

from shared.errors import UsageError

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "collect": ("sapien", "embreex", "coacd", "defusedxml", "ray"),
    "arm": ("defusedxml",),
    "ros": ("rosbags",),
    "report": ("matplotlib", "plotly", "jinja2"),
    "video": ("av",),
    "view": ("viser", "websockets"),
    "import": ("trimesh", "pycollada", "mujoco"),
    "gym": ("gymnasium",),
    "ray-data": ("ray", "pandas"),
    "wandb": ("wandb",),
    "mlflow": ("mlflow",),
}
"""Extras of pyproject.toml, and the packages that each brings."""
MODULES = {"pycollada": "collada"}
"""What a package is imported as, where that is not its name."""


def require(purpose: str, *extras: str, without: tuple[str, ...] = ()) -> None:
    """Check that the packages of some extras are installed, before any work starts.

    Args:
        purpose: the use that needs them, as the subject of a sentence.
        extras: names of `EXTRAS`.
        without: packages of these extras that this use does not need.

    Raises:
        UsageError: one is not installed.
    """
    for extra in extras:
        require_packages(purpose, *(name for name in EXTRAS[extra] if name not in without), extra=extra)


def require_packages(purpose: str, *packages: str, extra: str | None = None) -> None:
    """Check that packages are installed; `extra` brings them, or the first that brings each.

    Raises:
        UsageError: one is not.
    """
    missing = [name for name in packages if find_spec(MODULES.get(name, name)) is None]
    if missing:
        raise UsageError(missing_line(purpose, *missing, extra=extra))


def missing_line(purpose: str, *packages: str, extra: str | None = None) -> str:
    """The message if packages are not installed; `extra` as above."""
    extras = [extra] if extra else sorted({extra_of(name) for name in packages} - {None}, key=str)
    names = " and ".join(filter(None, [", ".join(packages[:-1]), packages[-1]]))
    how = f"pip install 'adaafford[{','.join(map(str, extras))}]'" if extras else f"pip install {' '.join(packages)}"
    return f"{purpose} needs {names}, not installed here: {how}"


def extra_of(package: str | None) -> str | None:
    """The extra that installs a package or a module; None if there is none."""
    top = (package or "").partition(".")[0]
    return next((extra for extra, names in EXTRAS.items() if top in {*names, *(MODULES.get(n) for n in names)}), None)
