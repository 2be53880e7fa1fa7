"""Figures as the tables for people show them; None and NaN are no figure, which is a dash."""

import math
from collections.abc import Sequence


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
