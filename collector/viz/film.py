"""Pictures of trials: the hand and the object when a primitive starts, first touches, and has ended."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from collector.objects.articulation import ArticulatedObject
from collector.random_proposer import RandomProposer
from collector.rollout import interact
from collector.sim.environment import SapienEnvironment
from collector.sim.grippers import GRIPPERS
from collector.sim.simulator import StageClock
from collector.viz.playback import Playback, RecordedTrial, caption
from collector.viz.rendering import Picture, Renderer, View, save, with_most_of_the_hand
from shared import seeds
from shared.config import PANDA, CollectionConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.primitives import PRIMITIVES
from shared.tasks import task_named
from shared.types import Action, HiddenDynamics, Observation, Outcome

DYNAMICS = HiddenDynamics(part_mass=0.2, joint_friction=0.3, surface_friction=2.0)
SEEN_FROM = (190.0, 40.0)
"""Azimuth and elevation, deg, of the camera whose cloud the actions are drawn from."""
STATES, TRIES = 12, 20
"""States drawn for a primitive at the most, and random actions executed from each of them."""
ENOUGH = 4
"""Successes, of which the one that takes the touched point the farthest is shown."""
EDGE_SHARE = 0.5
"""As in pull tasks; pushes there move their part as well."""
SIDES_DEG, ELEVATION_DEG, DISTANCE = (-50.0, 50.0), 25.0, 5.0
"""Of the film's camera; of the two sides, the one from which more of the hand is seen is used."""
IMAGE_SIZE, FIELD_OF_VIEW_DEG = 260, 14.0


def film(
    target: ArticulatedObject, primitives: Sequence[str], seed: int, out_png: Path, gripper: str = PANDA
) -> list[str]:
    """Write a picture of one random trial of each primitive, preferably one that succeeds.

    Args:
        target: the object.
        primitives: their names, in the order of the picture.
        seed: of the random trials.
        out_png: file to write.
        gripper: the name of the hand.

    Returns:
        The caption of each trial.

    Raises:
        UsageError: a name is unknown, no camera sees a movable part, or the file cannot be
            written.
    """
    GRIPPERS.get(gripper)
    for primitive in primitives:
        PRIMITIVES.get(primitive)
    takes = [_best_take(target, primitive, gripper, seed) for primitive in primitives]
    across = 1 if len(takes) < 4 else 2
    rows = int(np.ceil(len(takes) / across))
    figure = Figure(figsize=(across * 3 * 2.2, rows * 2.5), dpi=IMAGE_SIZE / 2.2)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, across * 3, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for number, take in enumerate(takes):
        row, column = divmod(number, across)
        for place, (moment, image) in enumerate(zip(take.moments, _pictures(take), strict=True)):
            axes = grid[row, 3 * column + place]
            axes.imshow(image)
            axes.text(0.5, -0.05, moment, fontsize=7, ha="center", transform=axes.transAxes)
        grid[row, 3 * column + 1].set_title(caption(take.primitive, take.outcome), fontsize=8, pad=3)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.03, top=0.95, wspace=0.03, hspace=0.2)
    save(figure, out_png)
    return [caption(take.primitive, take.outcome) for take in takes]


def _best_take(target: ArticulatedObject, primitive: str, gripper: str, seed: int) -> Playback:
    """Of a few random successes the one that takes the touched point the farthest; without any, the last failure."""
    successes, failure = list[Playback](), None
    for take in _takes(target, primitive, gripper, seed):
        if not take.outcome.success:
            failure = take
            continue
        successes.append(take)
        if len(successes) == ENOUGH:
            break
    if successes:
        return max(successes, key=lambda take: float(np.linalg.norm(take.outcome.displacement)))
    if failure is None:
        raise UsageError(f"{target.ref.id}: no part that moves comes to rest in view of the camera; try another object")
    return failure


def _takes(target: ArticulatedObject, primitive: str, gripper: str, seed: int) -> Iterator[Playback]:
    """Random trials from random states."""
    pixels, states, actions = (
        seeds.generator(seed, f"film/{purpose}/{primitive}", 0) for purpose in ("pixels", "states", "actions")
    )
    collection = CollectionConfig(primitive=primitive, gripper=gripper)
    task = task_named("pull" if PRIMITIVES.get(primitive).closes_fingers else "push")
    pose = camera_pose(*SEEN_FROM, collection.camera.distance)
    environment = SapienEnvironment(target, task, collection, DYNAMICS, pose, pixels, StageClock())
    proposer = RandomProposer(actions, EDGE_SHARE)
    take: Playback

    def execute(observation: Observation, action: Action) -> Outcome:
        nonlocal take
        part = int(observation.part_ids[action.point_index])
        take = RecordedTrial(environment.scene, action, part, primitive, collection.fidelity).record()
        return take.outcome

    for _ in range(STATES):
        if environment.reset(states) and environment.shows_a_target():
            for _ in interact(environment, proposer, TRIES, start=environment.state(), execute=execute):
                yield take


def _pictures(take: Playback) -> list[Picture]:
    """The moments from the side that shows more of the hand, the camera on the touched point."""
    places = [take.seen_from(side, ELEVATION_DEG, DISTANCE) for side in SIDES_DEG]
    place = with_most_of_the_hand(take, places, FIELD_OF_VIEW_DEG)
    renderer = Renderer(take, View(place, IMAGE_SIZE, IMAGE_SIZE, FIELD_OF_VIEW_DEG))
    return [renderer.picture(frame) for frame in take.moments.values()]
