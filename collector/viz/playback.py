"""Playbacks: a trial frame by frame, as it is simulated, for pictures, videos and viewers."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull

from collector.objects.articulation import ArticulatedObject, Body, Mesh
from collector.sim.engine import Link, convex_shapes
from collector.sim.restoration import restored
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from shared.config import CollectionConfig, Fidelity
from shared.geometry import camera_pose
from shared.plan import InteractionRecord, RolloutRecord
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, Outcome


@dataclass(frozen=True, slots=True)
class Playback:
    """One executed trial, frame by frame.

    Attributes:
        target: the object; `target.body_poses(joint_positions[frame])` says where its bodies are.
        action: that was executed.
        primitive: its name.
        outcome: of this execution.
        hand: of each link of the hand, the palm first, its shapes: closed convex meshes in the frame of the link.
        times: [frames], s, from 0 when the hand was placed.
        joint_positions: [frames, parts], of the object.
        hand_poses: [frames, links, 4, 4], world_from_link.
        contact: the first frame in which the hand touches anything; None: it touches nothing.
    """

    target: ArticulatedObject
    action: Action
    primitive: str
    outcome: Outcome
    hand: tuple[tuple[Mesh, ...], ...]
    times: Float
    joint_positions: Float
    hand_poses: Float
    contact: int | None

    @property
    def moments(self) -> dict[str, int]:
        """What there is to be seen, in order: frames."""
        last = len(self.times) - 1
        if self.contact is None:
            return {"start": 0, "end, no contact": last}
        return {"start": 0, "first contact": self.contact, "end": last}

    def scenery(self) -> ArticulatedObject:
        """The bodies of the object and then the links of the hand, which no joint joins, for a camera."""
        hand = (Body("", "hand", None, shapes, ()) for shapes in self.hand)
        return ArticulatedObject(self.target.ref, (*self.target.bodies, *hand))

    def poses(self, frame: int) -> Float:
        """Where the bodies of `scenery` are in a frame, [bodies, 4, 4], world_from_body."""
        return np.concatenate([self.target.body_poses(self.joint_positions[frame]), self.hand_poses[frame]])

    def seen_from(self, side_deg: float, elevation_deg: float, distance: float) -> Float:
        """The pose of a camera that looks at the touched point, [4, 4].

        Args:
            side_deg: azimuth from straight behind the hand, or from the object's front where the hand comes from above.
            elevation_deg: above the horizon.
            distance: from the point.
        """
        behind = -self.action.approach
        level = float(np.hypot(behind[0], behind[1]))
        azimuth = float(np.rad2deg(np.arctan2(behind[1], behind[0]))) if level > 0.3 else 180.0
        place = camera_pose(azimuth + side_deg, elevation_deg, distance)
        place[:3, 3] += self.action.point
        return place

    def at_rate(self, frames_a_second: float) -> "Playback":
        """The same trial with frames at equal intervals of time; the last one shows the end."""
        wanted = np.arange(int(np.ceil(self.times[-1] * frames_a_second - 1e-9)) + 1) / frames_a_second
        kept = np.searchsorted(self.times, wanted + 1e-9, side="right") - 1
        kept[-1] = len(self.times) - 1
        return replace(
            self,
            times=wanted,
            joint_positions=self.joint_positions[kept],
            hand_poses=self.hand_poses[kept],
            contact=None if self.contact is None else int(np.searchsorted(kept, self.contact)),
        )


def caption(primitive: str, outcome: Outcome) -> str:
    """An outcome in a few words."""
    success = "success" if outcome.success else "failure"
    return f"{primitive}: {outcome.kind.value}, {success}, m = {outcome.motion:.3f}"


class RecordedTrial(Trial):
    """A trial that keeps every step.

    Free flight that is not simulated is filled in, since all that happens in it is that the hand flies on; so a
    recorded trial has the outcome of any other.
    """

    def __init__(self, scene: Scene, action: Action, target: int, primitive: str, fidelity: Fidelity) -> None:
        super().__init__(scene, action, target, PRIMITIVES.get(primitive), fidelity)
        self._name = primitive
        self._time = 0.0
        self._times = list[float]()
        self._positions_kept = list[Float]()
        self._hand_kept = list[Float]()
        self._contact: int | None = None

    def record(self) -> Playback:
        """Execute the trial."""
        outcome = self.run()
        hand = tuple(tuple(_closed(shape) for shape in convex_shapes(link)) for link in _links(self.scene))
        return Playback(
            self.scene.object,
            self.action,
            self._name,
            outcome,
            hand,
            np.array(self._times),
            np.stack(self._positions_kept),
            np.stack(self._hand_kept),
            self._contact,
        )

    def _execute(self) -> None:
        self._keep(_hand_of(self.scene))
        super()._execute()

    def _step(self) -> None:
        try:
            super()._step()
        finally:  # A contact that ends the trial is its last frame.
            self._pass_step()
            self._keep(_hand_of(self.scene))
            if self._contact is None and self.scene.contact().brushes:
                self._contact = len(self._times) - 1

    def _free_flight(self, path: Float, step: int, stride: float) -> int:
        skipped = super()._free_flight(path, step, stride)
        # Where the hand is not simulated it flies straight on, and does not turn.
        start = _hand_of(self.scene)
        for ahead in range(1, skipped + 1):
            hand = start.copy()
            hand[:, :3, 3] += self.action.rotation @ (path[step + ahead, :3] - path[step, :3])
            self._pass_step()
            self._keep(hand)
        return skipped

    def _pass_step(self) -> None:
        self._time += 1.0 / self._timing.steps_per_second

    def _keep(self, hand: Float) -> None:
        positions = self.scene.joint_positions()
        # A simulation that has diverged cannot be shown.
        if np.isfinite(positions).all() and np.isfinite(hand).all():
            self._times.append(self._time)
            self._positions_kept.append(positions)
            self._hand_kept.append(hand)


def record(
    target: ArticulatedObject,
    collection: CollectionConfig,
    rollout: RolloutRecord,
    row: InteractionRecord,
    frames_a_second: float = 30.0,
) -> Playback:
    """Execute a stored interaction again, alone in a scene of its own, and record it.

    The simulation is that of the store. Compare `outcome` of the result with `row.outcome`, which is what counts: in
    rare cases they differ, as `adaafford store verify --resimulate` shows.

    Args:
        target: the rollout's object (see `collector.objects.catalogue.load_ref`).
        collection: of the store's setting.
        rollout: one of the store.
        row: one of its interactions.
        frames_a_second: of simulated time.

    Raises:
        UsageError: another simulator made the store.
    """
    scene = restored(target, collection, rollout, row)
    trial = RecordedTrial(scene, row.action, row.target_part, row.primitive, collection.fidelity)
    return trial.record().at_rate(frames_a_second)


def _links(scene: Scene) -> tuple[Link, ...]:
    return (scene.gripper.palm, *scene.gripper.fingers)


def _hand_of(scene: Scene) -> Float:
    """The pose of each link of the hand, [links, 4, 4], world_from_link."""
    poses = [link.entity_pose.to_transformation_matrix() for link in _links(scene)]
    return np.stack(poses).astype(np.float64)


def _closed(mesh: Mesh) -> Mesh:
    """The convex hull of a mesh's vertices as triangles, outside first."""
    hull = ConvexHull(mesh.vertices)
    corners = mesh.vertices[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Mesh(mesh.vertices, faces.astype(np.int32))
