"""What does one try do to the heatmap of a hinged door? A success on its free side should darken the hinge side.

The try is a stored random trial; affordance before and after it is compared on the points of its own door. Its sides
are told by the stored axis of the hinge, which no network sees.

Shapes: P points of a door.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adaafford import load_policy
from benchmarks.script import check_picture, main
from cluster.cli.commands.bench import StoredSettings, source_of, stored
from cluster.reporting.picture import Panel, draw_panels
from cluster.reporting.style import verdict
from cluster.runs.warm_start import seen_by, unknown
from learner.metrics import ratio_interval
from shared.errors import UsageError
from shared.formatting import percent
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.progress import Advance, Progress
from shared.store import Store
from shared.types import Float, Float32, Interaction, Observation, Outcome

Side = Literal["free", "hinge"]
OUTER, INNER = 0.8, 0.2
"""Where the free side begins and the hinge side ends, as shares of the way from the axis to the farthest point seen."""
LEAST_POINTS = 5
"""Of each side; a door of which less is seen is left out."""
RANDOM = "random"
"""The proposer whose tries count: what a network proposed says as much of the network as of the door."""
DRAWN = 4
"""Objects in a picture."""


class HintSettings(StoredSettings):
    """Say what a single try does to the affordance near a door's hinge, and far from it."""

    task: str = "pull-closed-door"
    """Of the store that is made where none is given; its parts must turn."""
    seed: int = Field(1_000, ge=0, lt=2**63)
    """Of the store that is made: not the training's, whose built-in objects would be the same."""
    procedural_per_category: int = Field(40, ge=1, le=10_000)
    """Its built-in objects: how many of each category that the task applies to."""
    rollouts: int = Field(120, ge=2, le=1_000_000)
    """Of the store that is made."""
    policy: str = "pull-closed-door"
    """Whose heatmaps: a name of those that the package brings, a folder, or a run."""
    picture: Path | None = None
    """A PNG of the first four objects before and after a success on the free side."""


def measure(command: HintSettings) -> dict[str, Any]:
    """Measure, and print a table."""
    policy = load_policy(command.policy)
    check_picture("--picture", command.picture)
    if command.store is None:
        fit_for_hints(policy, command.task)
        command = command.model_copy(update={"collection": policy.collection_for(command.collection)})
    if not (seen := seen_by(command.policy)):
        print(f"--policy {unknown(command.policy)}", file=sys.stderr)
    with stored(command) as store:
        benchmark = HintBenchmark(store, policy, seen)
        with Progress("shards of hints", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store) | {"policy": command.policy}
    print("affordance of a door's free and hinge side before and after one random try, and in how many it rose")
    for case, figures in result["cases"].items():
        told, side = case.split("-")
        print(f"  {told} on the {side} side: {figures['tries']} tries of {figures['objects']} objects")
        for name in get_args(Side):
            of = figures[name]
            rose = percent(of["brighter"], of["brighter_interval"], decimals=0)
            print(f"    {name:<6}{of['before']:.3f} -> {of['after']:.3f}, rose in {rose}%")
    if command.picture is not None and draw_hints(benchmark.hints, policy.task, command.picture):
        print(f"drawn in {command.picture}", file=sys.stderr)
    return result


@dataclass(frozen=True, slots=True)
class Hint:
    """One try, and the affordance that it left.

    Attributes:
        object_id: whose door.
        case: what kind of try it was, one of `CASES`.
        interaction: the try.
        before: mean affordance of each side with no try.
        after: the same after this one.
        heat: affordance of the whole cloud before and after, [N] each.
    """

    object_id: str
    case: str
    interaction: Interaction
    before: Mapping[Side, float]
    after: Mapping[Side, float]
    heat: tuple[Float32, Float32] = field(repr=False)


CASES = tuple(f"{result}-{side}" for result in ("success", "failure") for side in get_args(Side))


class HintBenchmark:
    """Hints of a store, as a policy takes them.

    Args:
        store: random interactions.
        policy: whose AAP.
        seen: content hashes of objects that it has learnt from; these are left out.

    Raises:
        UsageError: as `fit_for_hints`.
    """

    def __init__(self, store: Store, policy: Policy, seen: frozenset[str]) -> None:
        fit_for_hints(policy, store.setting.task)
        self.hints: list[Hint] = []
        self._store, self._seen = store, seen
        self._adapter = Adapter(policy)
        self._parts = store.parts()

    @property
    def turns(self) -> int:
        """How often `run` will call `advance`."""
        return len(self._parts)

    def run(self, advance: Advance) -> None:
        """Take the first try of each case in every rollout.

        Raises:
            UsageError: there is no such try on a hinge.
        """
        for part in self._parts:
            for rollout in self._store.rollouts_of(part):
                if rollout.object.content_hash not in self._seen:
                    self.hints += hints_of(rollout, self._adapter.affordance)
            advance()
        if not self.hints:
            raise UsageError(
                f"{self._store.where}: holds no random try on a hinged part that was not trained on; collect some"
            )

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints: by case, means over tries, and shares with 95% intervals over objects."""
        by_case = {case: [hint for hint in self.hints if hint.case == case] for case in CASES}
        return {"cases": {case: _figures(hints) for case, hints in by_case.items() if hints}}


def fit_for_hints(policy: Policy, task: str) -> None:
    """Refuse a policy that cannot be asked about tries of a task.

    Raises:
        UsageError: it has no AAP, or is of another task.
    """
    policy.require("aap")
    policy.require_task(task, "--policy", "the tries are of")


def hints_of(rollout: RolloutRecord, affordance: Callable[..., Float32]) -> list[Hint]:
    """The first random try of each case, so that long rollouts count no more than short ones.

    Args:
        rollout: interactions, of which those that a network proposed are passed over.
        affordance: of an observation after a history, [N], as `Adapter.affordance` has it.
    """
    found: dict[str, Hint] = {}
    for row in rollout.interactions:
        observation = rollout.observations[row.observation]
        touched = _touched(observation, row) if row.proposer == RANDOM else None
        if touched is None or (case := case_of(row.outcome, touched.side)) in found:
            continue
        tried = Interaction(observation, row.action, row.outcome)
        heat = affordance(observation, []), affordance(observation, [tried])
        before, after = (
            {side: float(scores[points].mean()) for side, points in touched.sides.items()} for scores in heat
        )
        found[case] = Hint(rollout.object.id, case, tried, before, after, heat)
    return list(found.values())


def case_of(outcome: Outcome, side: Side) -> str:
    """What kind of try it was, one of `CASES`."""
    return f"{'success' if outcome.success else 'failure'}-{side}"


@dataclass(frozen=True, slots=True)
class _Touched:
    """A door, as far as it is seen, and the side that a try was on.

    Attributes:
        side: of the try.
        sides: indices of the points of each.
    """

    side: Side
    sides: Mapping[Side, NDArray[np.int64]]


def _touched(observation: Observation, row: InteractionRecord) -> _Touched | None:
    """What a try touched; None for what slides, for a try between the sides, and where too little of a side is seen."""
    axis, moment = row.joint_twist[:3], row.joint_twist[3:]
    door = np.flatnonzero(observation.part_ids == row.target_part)
    if not (row.outcome.kind.is_label and axis.any() and len(door)):
        return None
    away = distance_from_axis(observation.points[door].astype(np.float64), axis, moment)
    farthest = float(away.max())
    sides: dict[Side, NDArray[np.int64]] = {
        "free": door[away > OUTER * farthest],
        "hinge": door[away < INNER * farthest],
    }
    if min(map(len, sides.values())) < LEAST_POINTS:
        return None
    place = float(distance_from_axis(row.action.point[None], axis, moment)[0]) / farthest
    if INNER <= place <= OUTER:
        return None
    return _Touched("free" if place > OUTER else "hinge", sides)


def distance_from_axis(points: Float, axis: Float, moment: Float) -> Float:
    """Distance of points, [P, 3], from the axis of a twist (w, v) without pitch, [3] each, [P].

    A point p moves by w x p + v; on the axis that is nothing, so that w x v / |w|^2 lies on it.
    """
    direction = axis / np.linalg.norm(axis)
    relative = points - np.cross(axis, moment) / (axis @ axis)
    distances: Float = np.linalg.norm(relative - np.outer(relative @ direction, direction), axis=1)
    return distances


def _figures(hints: Sequence[Hint]) -> dict[str, Any]:
    objects = np.unique([hint.object_id for hint in hints], return_inverse=True)[1]
    figures: dict[str, Any] = {"tries": len(hints), "objects": len(np.unique(objects))}
    for side in get_args(Side):
        before, after = (np.array([getattr(hint, when)[side] for hint in hints]) for when in ("before", "after"))
        brighter = after > before
        figures[side] = {
            "before": float(before.mean()),
            "after": float(after.mean()),
            "brighter": float(brighter.mean()),
            "brighter_interval": ratio_interval(brighter, np.ones(len(hints)), objects),
        }
    return figures


def draw_hints(hints: Sequence[Hint], title: str, out: Path) -> bool:
    """Draw the first successes on the free side, of as many objects as `DRAWN`: before above, after below.

    Returns:
        Whether there was any; if not, no file is written.

    Raises:
        UsageError: the file cannot be written.
    """
    first: dict[str, Hint] = {}
    for hint in hints:
        if hint.case == "success-free":
            first.setdefault(hint.object_id, hint)
    chosen = list(first.values())[:DRAWN]
    if not chosen:
        return False
    before, after = [], []
    for hint in chosen:
        observation = hint.interaction.observation
        before.append(Panel(observation, hint.heat[0], f"{hint.object_id}: before any try"))
        title_after = f"after 1 try: {verdict(hint.interaction.outcome)}"
        after.append(Panel(observation, hint.heat[1], title_after, hint.interaction))
    try:
        draw_panels([before, after], f"{title}: what one success tells", out)
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror}); name another file") from None
    return True


if __name__ == "__main__":
    main("hinting", HintSettings, measure)
