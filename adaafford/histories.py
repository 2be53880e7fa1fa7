"""Histories: the interactions with one object so far, as a JSON file that people and robots may write.

{
  "format": "adaafford-history", "schema_version": 1,
  "frame": {"up": [0, 0, 1], "camera": [0, 0, 0], "origin": [1.2, 0.1, 0.4]},
  "interactions": [
    {"cloud": "scan-1.ply", "point": [1.0, 0.3, 0.5], "approach": [1, 0, 0], "forward": [0, 0, 1],
     "outcome": {"motion": 0.21}}
  ]
}

Everything is in the frame of the clouds, in metres and radians; `cloud` is a file in the folder of the history or
below. An interaction without an outcome is a proposal that was not executed yet.
"""

import json
import math
import os
import unicodedata
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, Field, ValidationError, field_validator

from adaafford.columns import shown, without_mark
from adaafford.depth_images import Lens
from adaafford.parts import FollowedPart, part_choice
from adaafford.scans import ScanFrame, Vector, action_at
from shared.config import StrictModel
from shared.errors import UsageError
from shared.io.documents import reason_of, refuse_twins
from shared.io.files import read_bounded, remove_remnants, write_atomically, writing
from shared.types import MAX_GRASP_WIDTH, Action, Interaction, Observation, Outcome, OutcomeKind

MAX_HISTORY_BYTES = 1 << 20
MAX_TRIES = 64
MAX_NAME = 1000
"""Characters of a scan's path."""
SUCCESS_MOTION = 0.01
"""Motion that counts as a success unless it is said otherwise: tau, rad or m, as published."""
STILL_MOTION = 0.003
"""Motion up to which nothing moved, rad or m."""


Model = TypeVar("Model", bound=BaseModel)


def scan_name(name: str) -> str:
    """The name of a scan, given back where a history can hold it.

    Raises:
        ValueError: it is empty or too long, or holds a control character or what is not UTF-8.
    """
    if not 1 <= len(name) <= MAX_NAME:
        raise ValueError(f"needs a name of 1 to {MAX_NAME} characters; given {len(name)}")
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
        raise ValueError("needs a name without control characters, in UTF-8")
    return name


ScanName = Annotated[str, AfterValidator(scan_name)]
"""The path of a cloud's file."""


class TriedOutcome(StrictModel):
    """The outcome of an interaction."""

    motion: float = Field(ge=0, le=100)
    """How far the part moved: rad if it turns, m if it slides; 0 for nothing, or for a grasp that slipped."""
    success: bool | None = None
    """Whether it moved as intended (a pull pulled); default: whether it moved by more than 0.01."""
    kind: OutcomeKind = OutcomeKind.UNKNOWN
    """How the interaction ended; of these kinds, a robot usually knows only "ok", "no-contact" and "no-grasp"."""
    grasp_width: float | None = Field(None, ge=0, le=MAX_GRASP_WIDTH)
    """Opening of the two fingers together after they closed, m; of a suction cup its diameter if it sealed, else 0.
    None: not measured, or nothing closed."""

    @property
    def outcome(self) -> Outcome:
        """The outcome in the form that policies read."""
        moved = self.kind in (OutcomeKind.OK, OutcomeKind.UNKNOWN) and self.motion > SUCCESS_MOTION
        success = moved if self.success is None else self.success
        width = math.nan if self.grasp_width is None else self.grasp_width
        return Outcome(self.kind, self.motion, success, grasp_opening=width)

    @property
    def held_still(self) -> bool:
        """Whether something was gripped, and did not move."""
        return self.kind is OutcomeKind.OK and self.motion <= STILL_MOTION


class TriedInteraction(StrictModel):
    """One interaction, or a proposal for one."""

    cloud: ScanName
    """The scan before the interaction: a path relative to the history, inside its folder."""
    cloud_sha256: str | None = Field(None, pattern=r"^[0-9a-f]{64}$")
    """The hash of that file, which reveals a scan that was overwritten; None: not checked."""
    point: Vector
    """The target of the fingertips."""
    approach: Vector
    """The approach direction of the hand."""
    forward: Vector
    """The hand's forward direction, which defines its roll (see docs/robot.md)."""
    outcome: TriedOutcome | None = None
    """None until the interaction was executed."""
    part: FollowedPart | None = Field(None, exclude_if=lambda part: part is None)
    """Of a raw scan: where the part is that is followed."""

    @field_validator("cloud")
    @classmethod
    def _stays_inside(cls, cloud: str) -> str:
        path = PurePosixPath(cloud)
        if path.is_absolute() or ".." in path.parts:
            raise ValueError("needs a path relative to the history, without '..'")
        return cloud


class History(StrictModel):
    """The contents of a history file."""

    format: Literal["adaafford-history"] = "adaafford-history"
    schema_version: Literal[1] = 1
    frame: ScanFrame
    lens: Lens | None = Field(None, exclude_if=lambda lens: lens is None)
    """Of depth images: the camera's intrinsics and pose. None: scans are clouds."""
    part: Annotated[str, AfterValidator(part_choice)] | None = Field(None, exclude_if=lambda choice: choice is None)
    """Of raw scans: which part was wanted of the first. None: scans are of the object alone."""
    interactions: tuple[TriedInteraction, ...] = Field((), max_length=MAX_TRIES)

    @property
    def pending(self) -> TriedInteraction | None:
        """The proposal without an outcome, if there is one."""
        return self.interactions[-1] if self.interactions and self.interactions[-1].outcome is None else None

    @property
    def tried(self) -> tuple[TriedInteraction, ...]:
        """The interactions with an outcome."""
        return tuple(each for each in self.interactions if each.outcome is not None)

    def proposing(self, action: Action, cloud: str, cloud_sha256: str, part: FollowedPart | None = None) -> "History":
        """This history with a proposal at its end; it replaces one that was not executed.

        Args:
            action: the proposal.
            cloud: the scan that it was made with.
            cloud_sha256: the hash of that scan's file.
            part: of a raw scan: its parts.

        Raises:
            UsageError: the history is full.
        """
        if len(self.tried) >= MAX_TRIES:
            raise UsageError(f"the history holds {MAX_TRIES} interactions, which is the maximum; begin another")
        frame = self.frame
        proposal = TriedInteraction(
            cloud=cloud,
            cloud_sha256=cloud_sha256,
            point=_rounded(frame.point_to_scan(action.point).tolist()),
            approach=_rounded(frame.direction_to_scan(action.approach).tolist()),
            forward=_rounded(frame.direction_to_scan(action.forward).tolist()),
            part=part,
        )
        return self.model_copy(update={"interactions": (*self.tried, proposal)})

    def concluding(self, outcome: TriedOutcome) -> "History":
        """This history with the outcome of its proposal.

        Raises:
            UsageError: no proposal waits for one.
        """
        if self.pending is None:
            raise UsageError("the history has no proposal that waits for an outcome; ask for a proposal first")
        last = self.pending.model_copy(update={"outcome": outcome})
        return self.model_copy(update={"interactions": (*self.tried, last)})

    def interactions_with(self, observe: Callable[[TriedInteraction], Observation]) -> list[Interaction]:
        """The interactions in the form that policies read.

        Args:
            observe: gives the observation before an interaction.

        Raises:
            UsageError: a cloud cannot be read, or an interaction point is not on its cloud.
        """
        found = []
        for each in self.tried:
            assert each.outcome is not None, "an interaction has an outcome"
            observation = observe(each)
            action = action_at(observation, self.frame, each.point, each.approach, each.forward)
            found.append(Interaction(observation, action, each.outcome.outcome))
        return found


def read_history(path: Path) -> History:
    """Read an untrusted history.

    Raises:
        UsageError: it is not a valid history; the message has the first error.
        StoreError: it is not a regular file, or too large.
    """
    if os.path.exists(path) and not os.path.isfile(path):  # noqa: PTH110, PTH113 - of a name too long pathlib raises.
        raise UsageError(f"{path}: a folder, pipe or device, and no file; name a history, or a file that is to be one")
    history = parse_json(
        History, read_bounded(path, MAX_HISTORY_BYTES), f"{path}: ", "docs/robot.md says what it holds"
    )
    early = next((n for n, each in enumerate(history.interactions[:-1]) if each.outcome is None), None)
    if early is not None:
        raise UsageError(f"{path}: interactions.{early}: has no outcome though others follow; give it, or take it out")
    return history


def parse_json(model: type[Model], data: bytes, source: str, remedy: str) -> Model:
    """Parse an untrusted JSON document.

    Args:
        model: of its contents.
        data: in UTF-8, with or without a byte order mark.
        source: start of messages, such as the file.
        remedy: end of messages: what to write instead.

    Raises:
        UsageError: it is not valid; the message has the first error.
    """
    try:
        text = without_mark(data)
        found = model.model_validate_json(text)
        # Of a name that stands twice, pydantic takes the last.
        json.loads(text, object_pairs_hook=refuse_twins)
    except ValidationError as error:
        problem = error.errors()[0]
        place = shown([".".join(map(str, problem["loc"]))]) if problem["loc"] else "the file"
        raise UsageError(f"{source}{place}: {reason_of(problem)[:150]}; {remedy}") from None
    except ValueError as error:
        raise UsageError(f"{source}{error}; {remedy}") from None
    return found


def write_history(path: Path, history: History) -> None:
    """Write a history atomically.

    Raises:
        UsageError: the folder is not writable.
    """
    with writing(path):
        remove_remnants(path.parent)
        write_atomically(path, history.model_dump_json(indent=2).encode() + b"\n")


def _rounded(vector: list[float]) -> Vector:
    x, y, z = (round(value, 6) for value in vector)
    return x, y, z
