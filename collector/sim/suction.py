"""A hand with a suction cup: where the cup seals, what the seal bears, and when it lets go.

The cup is one of rubber with 1.5 folds and a diameter of 30 mm at 60 kPa below the air outside. Its lip is soft: only
the fitting in its middle collides, and the lip follows the surface within the limits below. `close` switches the vacuum
on where the hand is. The cup seals if every point of its rim meets the same link within `STROKE` of the lip's plane, if
these places are within `FLATNESS` of a plane, and if this plane is tilted by no more than `MOST_TILT_RAD`. All places
are on the shapes that the engine collides, so that the hand cannot seal on what it does not touch.

Sealed, the lip is attached to the link by springs that never exert more than the seal bears, `HOLDING_FORCE` F away
from the surface. It lets go as soon as their load has n + t / mu + m / r > F, with the pull n, the shear t, the moment
m, the radius r of the rim, and the friction coefficient mu of the scene: a ring that is pressed on by F - n slips at
mu (F - n), and tips at r (F - n). It does not seal again in the same trial.
"""

from dataclasses import dataclass

import numpy as np

from collector.objects.articulation import Mesh
from collector.sim.engine import Assembly, Link, convex_shapes, half_spaces, physx, pose, sapien
from collector.sim.gripper import TIP_DISTANCE, Gripper, build_free, convex, frame, make_weightless
from collector.sim.jointed_gripper import build_jointed
from shared.types import Float

RADIUS = 0.015
"""Of the rim, m."""
VACUUM_PA = 60e3
HOLDING_FORCE = float(np.pi * RADIUS**2 * VACUUM_PA)
"""F, 42.4 N: vacuum times area."""
RIM_POINTS = 16
STROKE = 6e-3
"""How far the lip follows a surface, m, up or down."""
FLATNESS = 1.5e-3
MOST_TILT_RAD = float(np.deg2rad(20.0))
STRETCH = 2e-3
"""How far the lip is stretched where it bears F, m, in any direction."""
STIFFNESS, DAMPING = HOLDING_FORCE / STRETCH, 100.0
BEND_STIFFNESS, BEND_DAMPING = 1.0, 0.01
"""N m / rad: folds give way to a door that turns away under the hand."""


@dataclass(frozen=True, slots=True)
class CupShape:
    """The shapes and figures of the hand; see `collector.sim.gripper.HandShape`."""

    palm: tuple[Mesh, ...]
    fitting: tuple[Mesh, ...]
    palm_mass: float = 0.5
    fitting_mass: float = 0.05
    finger_open: float = 0.0

    def add_fingers(self, assembly: Assembly, hand: Link) -> tuple[Link, ...]:
        """Add the fitting in the middle of the cup, which is what touches."""
        link = assembly.add(hand, "cup", self.fitting, touches_own_kind=False)
        make_weightless(link, self.fitting_mass)
        return (link,)


def _round(*rings: tuple[float, float]) -> Mesh:
    """The convex hull of rings about the approach, given by radius and height."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return convex([(radius * np.cos(a), radius * np.sin(a), z) for radius, z in rings for a in angles])


CUP = CupShape(
    palm=(_round((0.0316, -0.026), (0.0316, 0.04)), _round((0.012, 0.04), (0.012, 0.08))),
    fitting=(_round((0.008, 0.08), (0.008, TIP_DISTANCE - 0.004), (0.002, TIP_DISTANCE)),),
)
_LIP = frame(np.eye(3), (0.0, 0.0, TIP_DISTANCE))


class SuctionGripper:
    """Implements `collector.sim.gripper.Gripper` with a cup on a hand that flies in one of the two ways.

    Args:
        hand: flies; its one finger is the cup.
        links: what the cup may seal on.
        material: its friction coefficient is that between lip and surface.
    """

    def __init__(self, hand: Gripper, links: list[Link], material: physx.PhysxMaterial) -> None:
        self.palm, self.fingers = hand.palm, hand.fingers
        self.set_pace, self.shift, self.displacement = hand.set_pace, hand.shift, hand.displacement
        self.drive, self.drive_velocity, self.coordinates = hand.drive, hand.drive_velocity, hand.coordinates
        self._hand, self._links, self._material = hand, links, material
        self._pieces: list[tuple[Link, list[tuple[Float, Float]]]] | None = None
        (cup,) = self.fingers
        self._cup = cup
        self._seal = physx.PhysxDriveComponent(cup)
        self._seal.pose_in_child = pose(_LIP)
        cup.entity.add_component(self._seal)
        self._link: Link | None = None

    def place(self, rotation: Float, position: Float, *, opened: bool) -> None:
        """See `Gripper.place`; the vacuum is off."""
        self._let_go()
        self._hand.place(rotation, position, opened=opened)

    def close(self) -> None:
        """Switch the vacuum on: the cup seals here, or not at all."""
        world_from_lip = self._world_from_lip()
        self._link = self._sealed_link(world_from_lip)
        if self._link is None:
            return
        self._seal.set_parent(self._link)
        self._seal.pose_in_parent = self._link.entity_pose.inv() * pose(world_from_lip)
        shear = self._material.static_friction * HOLDING_FORCE
        self._seal.set_drive_property_x(STIFFNESS, DAMPING, shear)
        self._seal.set_drive_property_y(STIFFNESS, DAMPING, shear)
        self._seal.set_drive_property_z(STIFFNESS, DAMPING, HOLDING_FORCE)
        self._seal.set_drive_property_slerp(BEND_STIFFNESS, BEND_DAMPING, RADIUS * HOLDING_FORCE)

    def opening(self) -> float:
        """The diameter of a cup that is sealed, else 0, m."""
        return 2 * RADIUS if self.holds() else 0.0

    def holds(self) -> bool:
        """Whether the cup is sealed."""
        return self._link is not None

    def attached(self) -> bool:
        """See `Gripper.attached`: lets go of what is too heavy."""
        if self._link is not None and self._load() > HOLDING_FORCE:
            self._let_go()
        return self._link is not None

    def _load(self) -> float:
        """What the seal bears, as a pull away from the surface, N."""
        assert self._link is not None
        anchor = self._link.entity_pose * self._seal.pose_in_parent
        offset = (anchor.inv() * pose(self._world_from_lip())).to_transformation_matrix().astype(np.float64)
        force = STIFFNESS * offset[:3, 3]
        moment = BEND_STIFFNESS * np.arccos(np.clip((np.trace(offset[:3, :3]) - 1) / 2, -1.0, 1.0))
        shear = np.linalg.norm(force[:2]) / max(self._material.static_friction, 1e-6)
        return float(max(-force[2], 0.0) + shear + moment / RADIUS)

    def _let_go(self) -> None:
        self._link = None
        self._seal.set_parent(None)
        self._seal.set_drive_property_x(0.0, 0.0)
        self._seal.set_drive_property_y(0.0, 0.0)
        self._seal.set_drive_property_z(0.0, 0.0)
        self._seal.set_drive_property_slerp(0.0, 0.0)

    def _world_from_lip(self) -> Float:
        return np.asarray(self._cup.entity_pose.to_transformation_matrix(), dtype=np.float64) @ _LIP

    def _sealed_link(self, world_from_lip: Float) -> Link | None:
        """The link that the cup seals on, where it seals on one."""
        if self._pieces is None:
            self._pieces = [(link, [half_spaces(piece) for piece in convex_shapes(link)]) for link in self._links]
        angles = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
        rim = np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), np.zeros(RIM_POINTS)], axis=1)
        depths = np.full((len(self._pieces), RIM_POINTS), np.inf)
        for k, (link, pieces) in enumerate(self._pieces):
            link_from_lip = (
                np.linalg.inv(link.entity_pose.to_transformation_matrix().astype(np.float64)) @ world_from_lip
            )
            origins = rim @ link_from_lip[:3, :3].T + link_from_lip[:3, 3]
            for normals, distances in pieces:
                depths[k] = np.minimum(depths[k], _depths(origins, link_from_lip[:3, 2], normals, distances))
        first = depths.argmin(axis=0)
        nearest = depths.min(axis=0)
        if (first != first[0]).any() or np.abs(nearest).max() > STROKE:
            return None
        # The plane z = a x + b y + c of least squares; the points of the rim are spread evenly.
        along = rim[:, :2] / (RIM_POINTS / 2 * RADIUS**2)
        slope = nearest @ along
        apart = np.abs(nearest - nearest.mean() - rim[:, :2] @ slope).max()
        flat = apart <= FLATNESS and np.arctan(np.linalg.norm(slope)) <= MOST_TILT_RAD
        return self._pieces[int(first[0])][0] if flat else None


def _depths(origins: Float, direction: Float, normals: Float, distances: Float) -> Float:
    """How far before a convex piece the lines from `origins`, [P, 3], meet it, [P]: less than 0 inside, else infinite.

    What is behind an origin by more than `STROKE` does not count.
    """
    speed = normals @ direction
    room = distances - (origins[:, None] * normals).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        times = room / speed
    enter = np.where(speed < 0, times, -np.inf).max(axis=1)
    leave = np.where(speed > 0, times, np.inf).min(axis=1)
    missed = (enter >= leave) | (leave < -STROKE) | ((speed == 0) & (room < 0)).any(axis=1)
    return np.where(missed, np.inf, enter)


def build_suction(scene: sapien.Scene, material: physx.PhysxMaterial, jointed: bool) -> SuctionGripper:
    """Build the hand into a scene that has the object already, jointed or free."""
    links = list(scene.physx_system.articulation_link_components)
    hand = (build_jointed if jointed else build_free)(CUP, scene, material)
    return SuctionGripper(hand, links, material)
