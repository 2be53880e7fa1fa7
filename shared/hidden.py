"""Hidden parameters of an object: drawn once for each rollout, not visible, and to be inferred from interactions.

Each is declared in one record. Drawing, settings, columns of the store, facts for the oracle, and the words and tables
of the report follow from it. A package adds one by an entry point of the group `adaafford.hidden_parameters`
(docs/extending.md). All but the first three are active only in settings that name them in `collection.dynamics`, or
whose task does.
"""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.errors import UsageError
from shared.extensions import Registry

NAME = r"^[a-z][a-z0-9_]{0,39}$"
RESERVED = ("direction", "values")
"""What `HiddenDynamics` and columns call something else."""


class HiddenTarget(Protocol):
    """The object in a simulator that a parameter is applied to, before anything has moved."""

    def set_part_mass(self, mass: float) -> None:
        """Set the mass of every movable part, kg, and scale its inertia."""
        ...

    def set_joint_friction(self, limit: float) -> None:
        """Set the Coulomb friction of every movable joint: N m if it turns, N if it slides."""
        ...

    def set_surface_friction(self, coefficient: float) -> None:
        """Set the friction coefficient of the surfaces of hand and object."""
        ...

    def set_catch(self, breakaway: float) -> None:
        """Hold every closed part that is no handle until this much more than friction, N m or N, acts on its joint."""
        ...

    def set_latch(self, travel: float | None = None, handle: float | None = None) -> None:
        """Lock every closed part that has a handle until the handle is moved.

        Args:
            travel: share of its range that the handle must have moved; from 1, every part stays locked; 0: no latch.
            handle: which handle of several, from 0 for the first to 1 for the last.
        """
        ...

    def before_step(self, mechanism: Callable[[NDArray[np.float64]], None]) -> None:
        """Have `mechanism` called with the joint positions, [parts], before each step of the engine.

        What it does may depend on these alone: they are all that a state has, and that a row is executed again from.
        """
        ...

    @property
    def links(self) -> Sequence[Any]:
        """The simulator's own handles of the movable parts, in part order."""
        ...

    @property
    def joints(self) -> Sequence[Any]:
        """The simulator's own handles of their joints."""
        ...


@dataclass(frozen=True, slots=True)
class HiddenParameter:
    """One hidden parameter.

    Attributes:
        name: lower-case letters, digits and underscores; used by settings, columns and the report.
        description: what it is, in a few words.
        unit: "" for none.
        low: lower limit of the default range.
        high: upper limit of the default range.
        log: whether the logarithm is uniform instead of the value.
        apply: applies a value to a simulated object; called once for each rollout.
        default: the value of rows in stores without the parameter, which is the simulator's value if `apply` is not
            called. None: every store has it; only for the first three.
        least: the least value that a range may have; None: any.
    """

    name: str
    description: str
    unit: str
    low: float
    high: float
    log: bool
    apply: Callable[[HiddenTarget, float], None]
    default: float | None = None
    least: float | None = None

    def __post_init__(self) -> None:
        """Refuse a record that no setting could hold."""
        if not re.fullmatch(NAME, self.name) or self.name in RESERVED:
            raise ValueError(
                f"a hidden parameter cannot be called '{self.name}'; allowed: {NAME}, not direction or values"
            )

    @property
    def in_full(self) -> str:
        """The description with the unit."""
        return f"{self.description}, {self.unit}" if self.unit else self.description


BUILT_IN = {
    parameter.name: parameter
    for parameter in (
        HiddenParameter(
            name="part_mass",
            description="mass of a movable part; its inertia is scaled along",
            unit="kg",
            low=0.05,
            high=0.5,
            log=True,
            apply=lambda target, value: target.set_part_mass(value),
            least=0.0,
        ),
        HiddenParameter(
            name="joint_friction",
            description="Coulomb friction of a movable joint, N m if it turns, N if it slides",
            unit="",
            low=0.05,
            high=2.0,
            log=True,
            apply=lambda target, value: target.set_joint_friction(value),
            least=0.0,
        ),
        HiddenParameter(
            name="surface_friction",
            description="friction coefficient between hand and object",
            unit="",
            low=0.2,
            high=10.0,
            log=True,
            apply=lambda target, value: target.set_surface_friction(value),
            least=0.0,
        ),
        HiddenParameter(
            name="catch_force",
            description="what a catch adds to the friction of a closed joint, N m if it turns, N if it slides",
            unit="",
            low=0.5,
            high=10.0,
            log=True,
            apply=lambda target, value: target.set_catch(value),
            default=0.0,
            least=0.0,
        ),
        HiddenParameter(
            name="latch_travel",
            description="share of its range that a handle must move to open its latch; locked for good from 1",
            unit="",
            low=0.2,
            high=1.1,
            log=False,
            apply=lambda target, value: target.set_latch(travel=value),
            default=0.0,
            least=0.0,
        ),
        HiddenParameter(
            name="latch_handle",
            description="which of several handles opens the latch, from 0 for the first to 1 for the last",
            unit="",
            low=0.0,
            high=1.0,
            log=False,
            apply=lambda target, value: target.set_latch(handle=value),
            default=0.0,
            least=0.0,
        ),
    )
}
ALWAYS_DRAWN = {name: parameter for name, parameter in BUILT_IN.items() if parameter.default is None}
"""Those that every setting draws and every store has, in the order in which they are drawn and told to the oracle."""

HIDDEN_PARAMETERS = Registry("hidden parameter", HiddenParameter, BUILT_IN)


def hidden_parameter(name: str) -> HiddenParameter | None:
    """The parameter called `name`; None if its package is not installed or cannot be imported."""
    with suppress(UsageError):
        return HIDDEN_PARAMETERS.get(name)
    return None
