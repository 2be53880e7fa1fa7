"""Counterfactuals: one hidden fact is varied, the same actions are executed, and the affordance is adapted.

The observation is the same for every value, so differences of the affordance were learned from the interactions. The
hidden facts are friction, mass, direction and hinge side, one at a time.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path

import numpy as np

from cluster.reporting.clouds import CloudView, draw_panels, tried
from cluster.reporting.page import Drawing, Section, plain, shortened
from cluster.reporting.style import after, number, turning
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from collector.objects.procedural.cabinets import storage_furniture
from collector.objects.procedural.shapes import normalised
from collector.objects.readers import read_object
from collector.objects.writing import write_object
from collector.random_proposer import RepeatingProposer
from collector.rollout import interact
from collector.sim.environment import SapienEnvironment
from collector.sim.simulator import StageClock
from shared import seeds
from shared.config import Range
from shared.errors import ObjectError
from shared.geometry import camera_pose
from shared.plan import ObjectRef, Setting
from shared.policies.adaptation import Adapter
from shared.policies.proposers import proposer_named
from shared.types import Action, Direction, Float32, HiddenDynamics, Interaction, Observation, Proposer

TRIES = 4
"""Actions that are executed under each value."""
TRIED_BY = "fps"
"""The proposer that chooses them under the first value: spread over actionable points."""
OBJECTS_TRIED = 5
"""The most test objects that are searched for one that can still be read."""
ELEVATION_DEG = 40.0
CABINET_M = (1.0, 0.6, 1.2, 0.03)
"""Width, depth, height and overhang of the cabinet that is hung on either side."""
HINGED = "StorageFurniture"
"""Its category."""


@dataclass(frozen=True, slots=True)
class Case:
    """One value of a hidden fact."""

    label: str
    target: ArticulatedObject
    dynamics: HiddenDynamics


@dataclass(frozen=True, slots=True)
class Variation:
    """A hidden fact and the values that it takes."""

    name: str
    cases: tuple[Case, ...]


@dataclass(frozen=True, slots=True)
class Posterior:
    """The adapted affordance after the interactions under one value."""

    label: str
    observation: Observation
    history: tuple[Interaction, ...]
    affordance: Float32


class Counterfactuals:
    """Runs the experiments with the task, camera, fidelity and policy of a run."""

    def __init__(self, setting: Setting, adapter: Adapter) -> None:
        self.setting = setting
        self.adapter = adapter
        self.task = setting.task_record

    def posteriors(self, variation: Variation) -> list[Posterior]:
        """The affordance under each value after the same interactions; values without an interaction are skipped."""
        found: list[Posterior] = []
        actions: list[Action] = []
        for case in variation.cases:
            environment = self._environment(case)
            if not environment.reset(self._rng("state")) or not environment.shows_a_target():
                continue
            proposer = RepeatingProposer(actions) if actions else self._proposer()
            history = list(interact(environment, proposer, TRIES, start=environment.state()))
            if not history:
                continue
            actions = actions or [interaction.action for interaction in history]
            observation = history[0].observation
            affordance = self.adapter.affordance(observation, history)
            found.append(Posterior(case.label, observation, tuple(history), affordance))
        return found

    def _environment(self, case: Case) -> SapienEnvironment:
        collection = self.setting.collection
        middle = (collection.camera.azimuth_deg.low + collection.camera.azimuth_deg.high) / 2
        return SapienEnvironment(
            case.target,
            self.task,
            collection,
            case.dynamics,
            camera_pose(middle, ELEVATION_DEG, collection.camera.distance),
            self._rng("pixels"),
            StageClock(),
        )

    def _proposer(self) -> Proposer:
        return proposer_named(TRIED_BY, self.adapter, self._rng("tries"), TRIES)

    def _rng(self, purpose: str) -> np.random.Generator:
        """The same for every value, so that everything that is drawn is the same."""
        return seeds.generator(self.setting.seed, f"report/{purpose}", 0)


def variations(setting: Setting, target: ArticulatedObject, twins: Sequence[ArticulatedObject]) -> list[Variation]:
    """What can be varied: each hidden parameter, the direction if the task hides it, and the side of a hinge.

    Args:
        setting: of the run's evaluation.
        target: a test object.
        twins: the same cabinet hung on its left and on its right; none where the task is not about doors.
    """
    ranges, task = setting.dynamics, setting.task_record
    middle = HiddenDynamics({name: _middle(interval) for name, interval in ranges.root.items()}, task.directions[0])

    def growing(name: str, interval: Range) -> Variation:
        values = (interval.low, _middle(interval), interval.high)
        cases = [
            Case(number(name, f"{value:.2g}"), target, replace(middle, values={**middle.values, name: value}))
            for value in values
        ]
        return Variation(name.replace("_", " "), tuple(cases))

    found = [growing(name, interval) for name, interval in ranges.root.items()]
    if len(task.directions) > 1:
        ways = tuple(Case(turning(way), target, replace(middle, direction=way)) for way in task.directions)
        found.append(Variation("direction", ways))
    if twins:
        built = replace(middle, direction=Direction.AS_BUILT)
        sides = zip(("hinge on the left", "hinge on the right"), twins, strict=True)
        found.append(Variation("hinge side", tuple(Case(side, twin, built) for side, twin in sides)))
    return found


def hinge_twins(setting: Setting, folder: Path) -> list[ArticulatedObject]:
    """One cabinet with a closed overlay door, hung on its left and on its right: no camera tells them apart.

    Args:
        setting: of the run's evaluation; tasks that are not about cabinets get none.
        folder: where they are written.
    """
    categories = setting.task_record.categories
    if categories and HINGED not in categories:
        return []
    left = write_object(folder / "left", normalised(storage_furniture("left", *CABINET_M)))
    right = write_object(folder / "right", normalised(storage_furniture("right", *CABINET_M)))
    return [read_object(left), read_object(right)]


def first_readable(folder: Path, refs: Sequence[ObjectRef], setting: Setting) -> ArticulatedObject | None:
    """The first of some test objects that can still be read; None where none of the first few can."""
    for ref in refs[:OBJECTS_TRIED]:
        with suppress(ObjectError):
            return load_ref(folder, ref, setting.collection.collision)
    return None


def _middle(interval: Range) -> float:
    """The middle of what is drawn from: the geometric one where the logarithm is uniform."""
    return sqrt(interval.low * interval.high) if interval.log else (interval.low + interval.high) / 2


def hidden_facts_section(
    counterfactuals: Counterfactuals,
    target: ArticulatedObject | None,
    twins: Sequence[ArticulatedObject],
    say: Callable[[str], None],
) -> Section:
    """A tab for each hidden fact, and in it a cloud for each of its values (AdaAfford, Fig. 4)."""
    key, title = "hidden-facts", "Affordance under hidden facts"
    if target is None:
        return Section(key, title, ("No test object of the run can be read any more, so nothing was simulated.",))
    found = variations(counterfactuals.setting, target, twins)
    drawings = []
    for place, variation in enumerate(found, start=1):
        say(f"simulating hidden facts, {place} of {len(found)}: {variation.name}")
        posteriors = counterfactuals.posteriors(variation)
        if posteriors:
            drawings.append(_drawing(variation.name, posteriors, counterfactuals.adapter))
    if not drawings:
        return Section(key, title, (f"No interaction with {target.ref.id} was possible.",))
    lead = (
        f"{shortened(target.ref.category)} {target.ref.id}, not seen in training"
        + (" (for the hinge's side: one cabinet, hung on its left and on its right)" if twins else "")
        + f". The first cloud is before any interaction. The others are after the same {TRIES} interactions under each "
        "value (green: success, red: failure), with all other hidden facts at the middle of their range. The camera "
        "sees the same in every cloud of a row, so differences in colour were learned from the interactions. Drag a "
        "cloud to turn all.",
    )
    return Section(key, title, lead, drawings=tuple(drawings))


def _drawing(name: str, posteriors: Sequence[Posterior], adapter: Adapter) -> Drawing:
    first = posteriors[0].observation
    panels = [CloudView(f"{after(0)}<br>&nbsp;", first, adapter.affordance(first, []))]
    panels += [
        CloudView(
            f"{plain(each.label)}<br>{_successes(each)}",
            each.observation,
            each.affordance,
            tuple(tried(interaction) for interaction in each.history),
        )
        for each in posteriors
    ]
    return Drawing(draw_panels(panels, len(panels), ("AAP: affordance",)), tab=name, solid=True)


def _successes(posterior: Posterior) -> str:
    count = sum(interaction.outcome.success for interaction in posterior.history)
    return f"{count} of {len(posterior.history)} interactions succeeded"
