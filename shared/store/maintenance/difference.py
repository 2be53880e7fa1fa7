"""How two settings differ, in words that fit on one line."""

from collections.abc import Iterator
from typing import Any

_MAX_VALUE = 60


def difference_of(stored: dict[str, Any], given: dict[str, Any]) -> str:
    """The first setting that differs, with both values, and how many more do."""
    found = [f"{name}: the store has {ours}, given {theirs}" for name, ours, theirs in differences(stored, given)]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return (found[0] if found else "they are equal") + more


def differences(before: Any, after: Any, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Every setting that differs between two documents of `name`: its name, and both values, shortened."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*before, *after]):
            yield from differences(before.get(key), after.get(key), f"{name}.{key}" if name else key)
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for k, (old, new) in enumerate(zip(before, after, strict=True)):
            yield from differences(old, new, f"{name}[{k}]")
    elif isinstance(before, list) and isinstance(after, list):
        yield name, f"{len(before)} entries", str(len(after))
    elif before != after:
        yield name, _brief(before), _brief(after)


def _brief(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}..."
