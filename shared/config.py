"""Configuration models, one for each concern, with all defaults; TOML files and flags are read through them."""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError, model_validator

from shared.errors import UsageError
from shared.extensions import Registry
from shared.hidden import ALWAYS_DRAWN, HIDDEN_PARAMETERS, NAME, HiddenParameter, hidden_parameter
from shared.io.documents import MAX_PROBLEMS, reason_of
from shared.io.files import read_named
from shared.io.text import MAX_WORD, plain
from shared.types import Order

MAX_CONFIGURATION_BYTES = 1 << 18
MAX_DEPTH_SIZE = 1024
"""Width and height, pixels, of a depth image that is kept."""
MAX_NOISE = 10.0
"""Of a depth camera, times what a real one has."""
MAX_DOTS = 100
"""In a line of a configuration file, paths included."""

Collision = Literal["hulls", "decomposed"]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,30}$")]
"""Of something that a registry finds (`shared.extensions`); it stands in flags, file names and keys of plans. A store
can be read where the package is not installed."""
PANDA, SAPIEN = "panda", "sapien"


class StrictModel(BaseModel):
    """A frozen model that refuses settings it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def as_document(self) -> dict[str, Any]:
        """The model as JSON, with unknown fields of the document that it was read from."""
        named = {name: _as_document(getattr(self, name)) for name in type(self).model_fields}
        return self.model_dump(mode="json") | {n: value for n, value in named.items() if value is not None} | self.more

    @property
    def more(self) -> dict[str, Any]:
        """Unknown fields of the document that the model was read from."""
        return dict(self.model_extra or {})


def _as_document(value: Any) -> Any:
    """The document of a value that holds models; None for others."""
    if isinstance(value, StrictModel):
        return value.as_document()
    if isinstance(value, tuple) and value and isinstance(value[0], StrictModel):
        return [one.as_document() for one in value]
    if isinstance(value, RootModel):
        return _as_document(value.root)
    if isinstance(value, dict) and value and isinstance(next(iter(value.values())), StrictModel):
        return {name: one.as_document() for name, one in value.items()}
    return None


class Range(StrictModel):
    """An interval to draw from."""

    low: float
    high: float
    log: bool = False
    """Uniform in the logarithm instead of the value."""

    @model_validator(mode="after")
    def _ordered(self) -> "Range":
        if self.low > self.high or (self.log and self.low <= 0):
            raise ValueError(f"needs low <= high, and low > 0 where log is set; given {self.low} to {self.high}")
        return self


class CameraConfig(StrictModel):
    """The depth camera (protocol of Where2Act; the azimuth is narrowed to the side that doors face)."""

    image_size: int = Field(448, ge=32, le=4096)
    """Width and height, pixels."""
    field_of_view_deg: float = Field(35.0, gt=1, lt=120)
    """Vertical field of view."""
    distance: float = Field(5.0, gt=0)
    """From the object's origin, which it looks at."""
    azimuth_deg: Range = Range(low=135.0, high=225.0)
    """PartNet-Mobility objects face -x, which is 180 deg. Where2Act: 0 to 360; AdaAfford: 181."""
    elevation_deg: Range = Range(low=30.0, high=60.0)
    points: int = Field(2048, ge=64, le=16384)
    """N, kept by furthest-point sampling. As published: 10,000."""
    candidates: int = Field(30_000, ge=64)
    """Hit pixels drawn at random before furthest-point sampling, as published."""
    renderer: Literal["embree", "sapien"] = "embree"
    """Who renders: Embree on the CPU, or SAPIEN's own renderer, which needs a Vulkan device."""
    keep_depth: bool = Field(False, exclude_if=lambda kept: not kept)
    """Keep the whole depth image of each observation beside its cloud, some KB, which `network.pinch_profile` needs:
    `run` and `evaluate --policy` then switch it on."""

    noise: float = Field(0.0, ge=0, le=MAX_NOISE, exclude_if=lambda noise: noise == 0)
    """Factor of the errors of a depth camera (`collector.sim.camera`): 0 for none, 1 for a structured-light camera
    at one metre. Normals are then estimated from what it measured, as those of a robot's scan are."""

    @property
    def depth_size(self) -> int:
        """Width and height of the depth images that are kept, pixels; 0: none is."""
        return self.image_size if self.keep_depth else 0

    @model_validator(mode="after")
    def _enough_candidates(self) -> "CameraConfig":
        if self.candidates < self.points:
            raise ValueError(f"candidates ({self.candidates}) must be at least points ({self.points})")
        if self.keep_depth and self.image_size > MAX_DEPTH_SIZE:
            raise ValueError(f"keep_depth needs an image_size of at most {MAX_DEPTH_SIZE}; given {self.image_size}")
        return self


PUBLISHED_LEG_S = 4.0
"""How long one leg of a primitive takes as published: 2,000 steps of 1/500 s."""


class Timing(StrictModel):
    """How finely one part of a trial is stepped, and how fast the hand moves in it."""

    steps_per_second: int = Field(ge=60, le=2000)
    leg_steps: int = Field(ge=1)
    """Steps of one leg of a primitive."""
    hold_steps: int = Field(ge=0)
    """The most steps of hold after a leg."""

    @property
    def pace(self) -> float:
        """How many times faster than published the hand moves."""
        return PUBLISHED_LEG_S * self.steps_per_second / self.leg_steps


PUBLISHED_TIMING = Timing(steps_per_second=500, leg_steps=2000, hold_steps=2000)


FidelityVersion = Literal[1, 2, 3, 4]
"""What of a trial `fast` leaves out (docs/physics.md)."""


class Fidelity(StrictModel):
    """How finely a trial is simulated; `fast` agrees with `reference`, the published timing, on labels."""

    name: str = "fast"
    approach: Timing = Timing(steps_per_second=240, leg_steps=240, hold_steps=240)
    """Until the fingers have closed. The dampers of the hand's drives are weaker by as much as it is faster, so that
    its forces stay as published."""
    drag: Timing = Timing(steps_per_second=240, leg_steps=480, hold_steps=480)
    """The second leg of every primitive but push: whether a pinched or dragged part slips depends on its speed."""
    push_solver_iterations: int = Field(10, ge=1, le=255)
    """Of the engine, for the primitive push, and for others that do not need friction."""
    solver_iterations: int = Field(20, ge=1, le=255)
    """For all other primitives, since friction between fingers and part needs more."""
    skip_free_flight: bool = True
    """Move the hand at once to within a third of a millimetre of the object, while nothing touches it."""
    end_holds_at_rest: bool = True
    """End a hold once neither hand nor object moves."""
    jointed_hand: bool = False
    """Attach the hand to six joints, as published, instead of a free body with the same drives."""
    version: FidelityVersion = Field(1, exclude_if=lambda version: version == 1)
    """2: what nothing can change is not waited for; 3: nor are fingers that slide along what does not move; 4: a hand
    does not fly into the object (docs/physics.md). A document that describes its fidelity without a version is of 1, as
    collections were before there was another."""


FIDELITIES = {
    "fast": Fidelity(version=3),
    "reference": Fidelity(
        name="reference",
        approach=PUBLISHED_TIMING,
        drag=PUBLISHED_TIMING,
        push_solver_iterations=20,
        skip_free_flight=False,
        end_holds_at_rest=False,
        jointed_hand=True,
    ),
}


class DynamicsRanges(RootModel[dict[Annotated[str, Field(pattern=NAME)], Range]]):
    """Ranges of hidden parameters, by name (see `shared.hidden`).

    Parameters that are always drawn are always included; others are included if they are named. The default of a range
    is that of the parameter's own record.
    """

    model_config = ConfigDict(frozen=True)
    root: dict[Annotated[str, Field(pattern=NAME)], Range] = Field(
        default_factory=lambda: {name: _proposed(parameter) for name, parameter in ALWAYS_DRAWN.items()}
    )

    @model_validator(mode="before")
    @classmethod
    def _with_proposed(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        names = [*ALWAYS_DRAWN, *sorted(given.keys() - ALWAYS_DRAWN.keys())]
        ranges = {name: given.get(name, {}) for name in names}
        return {n: _proposed(HIDDEN_PARAMETERS.get(n)) if value == {} else value for n, value in ranges.items()}

    @model_validator(mode="after")
    def _possible(self) -> "DynamicsRanges":
        for name, given in self.root.items():
            parameter = hidden_parameter(name)
            if parameter is not None and parameter.least is not None and given.low < parameter.least:
                raise ValueError(
                    f"{name} needs a range from {parameter.least:g} on; given {given.low:g} to {given.high:g}"
                )
        return self

    def __getitem__(self, name: str) -> Range:
        """The range of one parameter."""
        return self.root[name]

    @property
    def added(self) -> tuple[str, ...]:
        """The parameters that not every store has, in order of name."""
        return tuple(sorted(self.root.keys() - ALWAYS_DRAWN.keys()))

    @property
    def extensions(self) -> list[tuple[Registry[Any], str]]:
        """The things in it that packages may add: registry and name."""
        return [(HIDDEN_PARAMETERS, name) for name in self.added]

    def check_known(self) -> None:
        """Check that the packages of all parameters are installed, before anything is drawn.

        Raises:
            UsageError: one is not.
        """
        for name in self.root:
            HIDDEN_PARAMETERS.get(name)


def _proposed(parameter: HiddenParameter) -> Range:
    """The range that a parameter's own record proposes."""
    return Range(low=parameter.low, high=parameter.high, log=parameter.log)


class RolloutConfig(StrictModel):
    """The interactions of one rollout."""

    interactions: int = Field(32, ge=1, le=4096)
    """As published: 32 for each object and draw of hidden dynamics."""
    order: Order = Order.RESTART
    """Order of the random interactions; those of AIP always continue, and come first."""
    continued: int = Field(0, ge=0)
    """Restart order: how many random interactions at the start continue each other, as at test time. From them AAP
    learns to interpret an interaction that begins where another one ended."""
    actions_per_state: int = Field(8, ge=1)
    """Restart order: actions executed from one observed state."""
    edge_share: float | None = Field(None, ge=0, le=1)
    """Share of random actions at points near a part's edge, where a gripper can pinch it; the rest are anywhere on
    the movable parts, as published. None: the task's own."""
    context: int = Field(4, ge=0)
    """The most interactions that AIP proposes at the start of a rollout, in rounds that use it."""


class CollectionConfig(StrictModel):
    """How interactions are collected, except for the objects, their number and the workers."""

    primitive: Name | None = None
    """Instead of the task's own: push, push-left, push-up, pull, pull-left, pull-up, or what a package adds."""
    gripper: Name = Field(PANDA, exclude_if=lambda name: name == PANDA)
    """The hand: panda, suction, or what a package adds."""
    arm: str | None = Field(None, max_length=1000, exclude_if=lambda arm: arm is None)
    """The arm that carries the hand: panda, ur5e, what a package adds, or FILE.urdf, or FILE.urdf#LINK where LINK
    carries the hand. What it cannot reach is not executed (`unreachable`). None: the hand flies."""
    arm_known: bool = Field(True, exclude_if=lambda known: known)
    """Whether policies know the arm, so that they propose what it reaches; random interactions never do."""
    simulator: Name = Field(SAPIEN, exclude_if=lambda name: name == SAPIEN)
    """What rollouts are simulated with: sapien, or what a package adds."""
    camera: CameraConfig = CameraConfig()
    fidelity: Fidelity = FIDELITIES["fast"]
    collision: Collision = "hulls"
    """What objects collide as: each mesh's convex hull, which closes cavities, or its convex decomposition."""
    dynamics: DynamicsRanges | None = None
    """What hidden parameters are drawn from, instead of the ranges of the task. Those of packages are drawn if they
    are named here."""
    rollout: RolloutConfig = RolloutConfig()

    def keeping_depth(self) -> "CollectionConfig":
        """The same with depth images kept, which networks need that have pinch profiles as input.

        Raises:
            UsageError: the images are too large for that.
        """
        camera = parse(CameraConfig, {**self.camera.model_dump(), "keep_depth": True}, "collection.camera")
        return self.model_copy(update={"camera": camera})


Model = TypeVar("Model", bound=BaseModel)


def parse(model: type[Model], values: dict[str, Any], source: str) -> Model:
    """Validate `values` as `model`.

    Raises:
        UsageError: with one line that names `source`, the setting, what was given and what is allowed.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        cause = error.errors()[0].get("ctx", {}).get("error") if error.error_count() == 1 else None
        if isinstance(cause, UsageError):
            raise cause from None  # It names the file itself.
        raise UsageError(f"{source}: {_first_problem(model, error)}") from None


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of settings.

    Raises:
        UsageError: the file is missing, too large, or not TOML.
    """
    data = read_named(path, MAX_CONFIGURATION_BYTES, "name an existing TOML file")
    try:
        text = data.decode("utf-8")
        # The parser's work grows with the square of the number of dots in a key.
        if any(line.count(".") > MAX_DOTS for line in text.splitlines()):
            raise ValueError(f"a line with more than {MAX_DOTS} dots")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not valid TOML ({plain(str(error), 200)}); correct it") from None


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base`, in which the settings of `over` replace its own, table by table."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def _first_problem(model: type[BaseModel], error: ValidationError) -> str:
    """One line for the first thing that is wrong, with the likely spelling of an unknown setting."""
    if error.error_count() > MAX_PROBLEMS:
        return f"{error.error_count()} settings are unknown or not allowed"
    problems = error.errors()
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    location = [str(part) for part in problem["loc"]]
    name = plain(".".join(location), MAX_WORD) or "the file"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    if problem["type"] == "extra_forbidden":
        known = sorted(_fields_at(model, location[:-1]))
        close = difflib.get_close_matches(location[-1][:MAX_WORD], known, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"allowed here: {', '.join(known)}"
        return f"unknown setting '{name}'; {hint}{more}"
    if problem["type"] == "value_error":  # Of a check of ours, which says what was given.
        return f"setting '{name}': {reason_of(problem)}{more}"
    return f"setting '{name}': {reason_of(problem)}; given {_shown(problem['input'])}{more}"


def _shown(value: object) -> str:
    """A value as a message has it; an integer of thousands of digits cannot be written."""
    try:
        return f"'{plain(str(value), MAX_WORD)}'"
    except (ValueError, RecursionError):
        return f"a value of type {type(value).__name__}"


def _fields_at(model: type[BaseModel], location: list[str]) -> list[str]:
    """Names of the settings below `location`."""
    here: Any = model
    for part in location:
        annotation = here.model_fields[part].annotation if part in here.model_fields else None
        options = [annotation, *getattr(annotation, "__args__", ())]
        here = next((o for o in options if isinstance(o, type) and issubclass(o, BaseModel)), None)
        if here is None:
            return []
    return list(here.model_fields)
