"""Texts of the page for hidden facts, outcomes and numbers of interactions."""

from shared.hidden import hidden_parameter
from shared.types import Direction, HiddenDynamics, Outcome


def hidden(dynamics: HiddenDynamics) -> str:
    """Hidden dynamics in words."""
    text = ", ".join(number(name, f"{value:.2f}") for name, value in dynamics.values.items())
    return text if dynamics.direction is Direction.AS_BUILT else f"{text}, {turning(dynamics.direction)}"


def number(name: str, value: str) -> str:
    """A hidden parameter with its value, and its unit where the package that adds it is installed."""
    parameter = hidden_parameter(name)
    unit = "" if parameter is None or not parameter.unit else f" {parameter.unit}"
    return f"{name.replace('_', ' ')} {value}{unit}"


def turning(direction: Direction) -> str:
    """Which way a joint turns."""
    return "turns both ways" if direction is Direction.BOTH else f"turns {direction.value}"


def verdict(outcome: Outcome) -> str:
    """The outcome of an interaction in a few words."""
    result = "success" if outcome.success else outcome.kind.value.replace("ok", "no success")
    return f"{result}, moved {outcome.motion:.3f}"


def after(tries: int) -> str:
    """After how many interactions something holds."""
    return "before any interaction" if tries == 0 else f"after {tries} interaction{'' if tries == 1 else 's'}"
