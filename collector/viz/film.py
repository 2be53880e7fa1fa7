"""Pictures of trials: the hand and the object when a primitive starts, first touches, and has ended."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from collector.objects.articulation import ArticulatedObject, Body, Joint, Mesh
from collector.random_proposer import RandomProposer
from collector.recorder import interact
from collector.sim.camera import DepthImage, EmbreeCamera
from collector.sim.engine import Link, convex_shapes
from collector.sim.environment import SapienEnvironment
from collector.sim.grippers import GRIPPERS
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from collector.stopwatch import StageClock
from collector.viz.preview import part_colours, save, shaded
from shared import seeds
from shared.config import PANDA, CameraConfig, CollectionConfig, Fidelity
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.primitives import PRIMITIVES
from shared.tasks import task_named
from shared.types import Action, Float, HiddenDynamics, Observation, Outcome

FIDELITY = Fidelity(name="film", skip_free_flight=False)
DYNAMICS = HiddenDynamics(part_mass=0.2, joint_friction=0.3, surface_friction=2.0)
SEEN_FROM = (190.0, 40.0)
"""Azimuth and elevation, deg, of the camera whose cloud the actions are drawn from."""
STATES, TRIES = 12, 20
"""States drawn for a primitive at the most, and random actions executed from each of them."""
ENOUGH = 4
"""Successes, of which the one that takes the touched point the farthest is shown."""
EDGE_SHARE = 0.5
"""As in pull tasks; pushes there move their part as well."""
SIDES_DEG = (-50.0, 50.0)
"""Azimuths of the film's camera, from straight behind the hand; the one from which more of the hand is seen is used."""
CLOSE_UP = CameraConfig(image_size=260, field_of_view_deg=14.0)
PALM_COLOUR, FINGER_COLOUR = (0.2, 0.2, 0.25), (1.0, 0.8, 0.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """The poses of object and hand at one moment of a trial.

    Attributes:
        joint_positions: [parts], of the object.
        hand: [links, 4, 4], world_from_link of the palm and the fingers.
    """

    joint_positions: Float
    hand: Float


@dataclass(frozen=True, slots=True)
class Take:
    """One filmed trial; `contact` is None if the hand touched nothing; `hand` has the shapes of its links."""

    action: Action
    primitive: str
    outcome: Outcome
    hand: tuple[tuple[Mesh, ...], ...]
    start: Pose
    contact: Pose | None
    end: Pose

    @property
    def moments(self) -> dict[str, Pose]:
        """What there is to be seen, in order."""
        if self.contact is None:
            return {"start": self.start, "end, no contact": self.end}
        return {"start": self.start, "first contact": self.contact, "end": self.end}

    @property
    def caption(self) -> str:
        """The outcome in a few words."""
        success = "success" if self.outcome.success else "failure"
        return f"{self.primitive}: {self.outcome.kind.value}, {success}, m = {self.outcome.motion:.3f}"


class FilmedTrial(Trial):
    """A trial that records the poses at its moments."""

    def __init__(self, scene: Scene, action: Action, target: int, primitive: str) -> None:
        super().__init__(scene, action, target, PRIMITIVES.get(primitive), FIDELITY)
        self._name = primitive
        self._first: Pose | None = None
        self._contact: Pose | None = None
        self._last: Pose | None = None

    def take(self) -> Take:
        """Execute the trial."""
        outcome = self.run()
        assert self._first is not None and self._last is not None, "a trial takes at least one step"
        hand = tuple(convex_shapes(link) for link in _links(self.scene))
        return Take(self.action, self._name, outcome, hand, self._first, self._contact, self._last)

    def _step(self) -> None:
        try:
            super()._step()
        finally:  # A contact that ends the trial is its last moment.
            self._last = _pose_of(self.scene)
            self._first = self._first or self._last
            if self._contact is None and self.scene.contact().brushes:
                self._contact = self._last


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
    figure = Figure(figsize=(across * 3 * 2.2, rows * 2.5), dpi=CLOSE_UP.image_size / 2.2)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, across * 3, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for number, take in enumerate(takes):
        row, column = divmod(number, across)
        for place, (moment, image) in enumerate(zip(take.moments, _pictures(target, take), strict=True)):
            axes = grid[row, 3 * column + place]
            axes.imshow(image)
            axes.text(0.5, -0.05, moment, fontsize=7, ha="center", transform=axes.transAxes)
        grid[row, 3 * column + 1].set_title(take.caption, fontsize=8, pad=3)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.03, top=0.95, wspace=0.03, hspace=0.2)
    save(figure, out_png)
    return [take.caption for take in takes]


def _best_take(target: ArticulatedObject, primitive: str, gripper: str, seed: int) -> Take:
    """Of a few random successes the one that takes the touched point the farthest; without any, the last failure."""
    successes, failure = list[Take](), None
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


def _takes(target: ArticulatedObject, primitive: str, gripper: str, seed: int) -> Iterator[Take]:
    """Random trials from random states."""
    pixels, states, actions = (
        seeds.generator(seed, f"film/{purpose}/{primitive}", 0) for purpose in ("pixels", "states", "actions")
    )
    collection = CollectionConfig(primitive=primitive, gripper=gripper, fidelity=FIDELITY)
    task = task_named("pull" if PRIMITIVES.get(primitive).closes_fingers else "push")
    pose = camera_pose(*SEEN_FROM, collection.camera.distance)
    environment = SapienEnvironment(target, task, collection, DYNAMICS, pose, pixels, StageClock())
    proposer = RandomProposer(actions, EDGE_SHARE)
    take: Take

    def execute(observation: Observation, action: Action) -> Outcome:
        nonlocal take
        part = int(observation.part_ids[action.point_index])
        take = FilmedTrial(environment.scene, action, part, primitive).take()
        return take.outcome

    for _ in range(STATES):
        if environment.reset(states) and environment.shows_a_target():
            for _ in interact(environment, proposer, TRIES, start=environment.state(), execute=execute):
                yield take


def _links(scene: Scene) -> tuple[Link, ...]:
    return (scene.gripper.palm, *scene.gripper.fingers)


def _pose_of(scene: Scene) -> Pose:
    hand = [np.asarray(link.entity_pose.to_transformation_matrix(), dtype=np.float64) for link in _links(scene)]
    return Pose(scene.joint_positions(), np.stack(hand))


def _pictures(target: ArticulatedObject, take: Take) -> list[Float]:
    """The moments from the side that shows more of the hand, the camera on the touched point."""
    shots = [[_capture(target, take, pose, side) for pose in take.moments.values()] for side in SIDES_DEG]
    best = max(shots, key=lambda images: sum(int((i.bodies > len(target.parts)).sum()) for i in images))
    fingers = [FINGER_COLOUR] * (len(take.hand) - 1)
    colours = np.concatenate([part_colours(len(target.parts)), [PALM_COLOUR, *fingers]])
    return [shaded(image, colours, CLOSE_UP.image_size) for image in best]


def _capture(target: ArticulatedObject, take: Take, pose: Pose, side_deg: float) -> DepthImage:
    behind = -take.action.approach
    level = float(np.hypot(behind[0], behind[1]))
    azimuth = np.rad2deg(np.arctan2(behind[1], behind[0])) if level > 0.3 else 180.0
    camera = camera_pose(float(azimuth) + side_deg, 25.0, CLOSE_UP.distance)
    camera[:3, 3] += take.action.point
    hand = [_snapshot(shapes, place) for shapes, place in zip(take.hand, pose.hand, strict=True)]
    with_hand = ArticulatedObject(target.ref, (*target.bodies, *hand))
    return EmbreeCamera(with_hand, camera, CLOSE_UP).capture(np.append(pose.joint_positions, np.zeros(len(hand))))


def _snapshot(shapes: Sequence[Mesh], world_from_link: Float) -> Body:
    """A link of the hand as a body that stands where it is at joint position 0."""
    joint = Joint("", "prismatic", 0, world_from_link, np.array([1.0, 0.0, 0.0]), 0.0, 0.0)
    return Body("", "hand", joint, tuple(_closed(mesh) for mesh in shapes), ())


def _closed(mesh: Mesh) -> Mesh:
    """The convex hull of a mesh's vertices as triangles."""
    return Mesh(mesh.vertices, ConvexHull(mesh.vertices).simplices.astype(np.int32))
