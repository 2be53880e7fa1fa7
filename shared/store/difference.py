"""How two settings differ, in words that fit on one line."""

from collections.abc import Iterator
from typing import Any

_MAX_VALUE = 60


def difference_of(stored: dict[str, Any], given: dict[str, Any]) -> str:
    """The first setting that differs, with both values, and how many more do."""
    differences = list(_walk(stored, given, ""))
    more = f" (and {len(differences) - 1} more)" if len(differences) > 1 else ""
    return (differences[0] if differences else "they are equal") + more


def _walk(stored: Any, given: Any, name: str) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(given, dict):
        for key in dict.fromkeys([*stored, *given]):
            yield from _walk(stored.get(key), given.get(key), f"{name}.{key}" if name else key)
    elif isinstance(stored, list) and isinstance(given, list) and len(stored) != len(given):
        yield f"{name}: the store has {len(stored)} entries, given {len(given)}"
    elif isinstance(stored, list) and isinstance(given, list):
        for k, (ours, theirs) in enumerate(zip(stored, given, strict=True)):
            yield from _walk(ours, theirs, f"{name}[{k}]")
    elif stored != given:
        yield f"{name}: the store has {_brief(stored)}, given {_brief(given)}"


def _brief(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}..."
