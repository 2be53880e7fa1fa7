"""Figures as tables show them (None and NaN as "-"), and as JSON can hold them."""

import math
from collections.abc import Sequence
from typing import Any


def percent(share: float | None, limits: Sequence[float | None] = (), decimals: int = 1) -> str:
    """A share in percent, "76.6", and its interval if it has one, "76.6 [71.2, 80.9]".

    Args:
        share: between 0 and 1, as a rule.
        limits: where the interval begins and ends.
        decimals: of the limits.
    """
    if share is None or math.isnan(share):
        return "-"
    known = [limit for limit in limits if limit is not None and not math.isnan(limit)]
    interval = f" [{', '.join(f'{100 * limit:.{decimals}f}' for limit in known)}]" if len(known) == 2 else ""
    return f"{100 * share:.1f}{interval}"


def number(value: float | None) -> str:
    """An integer as it is, anything else with three decimals."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def finite(value: Any) -> Any:
    """A value of nested dicts and lists, in which every number that is not finite is None: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
