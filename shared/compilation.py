"""Functions that Numba compiles at their first call; it keeps the machine code in the user's cache folder."""

from collections.abc import Callable
from typing import Any

from numba import config, njit

from shared.errors import UsageError
from shared.interrupts import undisturbed
from shared.io.private import cache_folder

_SETTINGS: Any = config


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function at its first call; keep the machine code where that is possible."""

    def compile_lazily(function: Callable[..., Any]) -> Callable[..., Any]:
        before = _SETTINGS.CACHE_DIR
        try:
            # Without a home, Numba's own choice would be a folder called "~" wherever the process happens to be.
            _SETTINGS.CACHE_DIR = before or str(cache_folder("numba"))
            kept: Any = njit(function, cache=True, nogil=True, **options)
        except (RuntimeError, UsageError):  # There is no place that can be written.
            kept = njit(function, nogil=True, **options)
        finally:
            _SETTINGS.CACHE_DIR = before
        kept.compile = _undisturbed(kept.compile)
        made: Callable[..., Any] = kept
        return made

    return compile_lazily


def _undisturbed(compile_for: Callable[..., Any]) -> Callable[..., Any]:
    """Ctrl-C waits for the end of a compilation: within a callback of LLVM, Python would print and forget it."""

    def compile_undisturbed(*arguments: Any) -> Any:
        with undisturbed():
            return compile_for(*arguments)

    return compile_undisturbed
