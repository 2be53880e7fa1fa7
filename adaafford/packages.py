"""Our five packages have short names. If a user's folder has the same name, Python may import it instead of ours.

So it is seen whether all are from one place before the first is used. Nothing of ours is imported here.
"""

import sys
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

PACKAGES = ("adaafford", "shared", "collector", "learner", "cluster")
ROOT = Path(__file__).resolve().parents[1]
"""The folder that the packages are in."""


class ShadowedError(ImportError):
    """Something else has the name of one of our packages, and comes before it."""


def require_own_packages() -> None:
    """Check that none of our packages is shadowed by something else of its name.

    Raises:
        ShadowedError: one is; the message names it and says what to do. Uncaught, it shows as one line.
    """
    for name in PACKAGES:
        place = _place_of(name)
        if place is not None and place.parent != ROOT:
            _show_in_a_line()
            raise ShadowedError(
                f"{place}: has the name of adaafford's own package '{name}', which is in {ROOT}, and comes before it; "
                f"rename it, or work in another folder and take {place.parent} out of PYTHONPATH"
            )


def _show_in_a_line() -> None:
    """Show this error, as any that a user can solve, without a traceback; all others as before."""
    before = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, ShadowedError):
            print(f"adaafford: {error}", file=sys.stderr)
        else:
            before(kind, error, trace)

    sys.excepthook = show


def _place_of(name: str) -> Path | None:
    """The folder or file that Python takes for a package; None if there is none, as where not all are installed."""
    found = sys.modules.get(name)
    spec = getattr(found, "__spec__", None) if found is not None else find_spec(name)
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())
    place = folders[0] if folders else spec.origin
    return None if place is None else Path(place).resolve()
