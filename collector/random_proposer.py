"""Proposers without a policy: for random actions, and for given ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from shared.geometry import gripper_rotation
from shared.types import Action, Float, Interaction, Observation

LEAST_COSINE = 0.7
"""AdaAfford's random data approaches within about 45 deg of the inward normal: d . n < -0.7."""

EDGE_RADIUS = 0.08
"""Neighbourhood within which a point's place on its part is judged."""
EDGE_OFFSET = 0.25
"""Share of the radius; the centroid of a half disc is 0.42 of its radius away from the middle of its edge, so that
points up to about a third of the radius from an edge count."""


def random_rotation(normal: Float, rng: np.random.Generator) -> Float:
    """R, [3, 3], world: an approach uniform in the cap about the inward normal, and a uniform roll.

    Args:
        normal: [3], unit, out of the surface.
        rng: draws both.
    """
    inward = -normal / np.linalg.norm(normal)
    cosine = rng.uniform(LEAST_COSINE, 1.0)
    sideways = _normal_to(inward, rng)
    approach = cosine * inward + np.sqrt(1.0 - cosine**2) * sideways
    return gripper_rotation(approach, _normal_to(approach, rng))


def _normal_to(axis: Float, rng: np.random.Generator) -> Float:
    """A uniformly random unit vector normal to `axis`."""
    while True:
        vector = rng.standard_normal(3)
        vector -= (vector @ axis) * axis
        length = float(np.linalg.norm(vector))
        if length > 1e-3:
            return vector / length


class RandomProposer:
    """Proposes a random visible point that the task may act on, with a random approach direction; never stops.

    Args:
        rng: draws the actions.
        edge_share: share of the actions at points near a part's edge; the others are anywhere on the movable parts.
    """

    name = "random"

    def __init__(self, rng: np.random.Generator, edge_share: float = 0.0) -> None:
        self._rng = rng
        self._edge_share = edge_share
        self._edges: tuple[Observation, NDArray[np.int64]] | None = None

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """A random action, or None if no point that the task may act on is visible."""
        candidates = np.flatnonzero(observation.movable)
        if len(candidates) == 0:
            return None
        if self._rng.random() < self._edge_share:
            edges = self._edges_of(observation)
            candidates = edges if len(edges) else candidates
        index = int(self._rng.choice(candidates))
        rotation = random_rotation(observation.normals[index].astype(np.float64), self._rng)
        return Action(index, observation.points[index].astype(np.float64), rotation)

    def _edges_of(self, observation: Observation) -> NDArray[np.int64]:
        if self._edges is None or self._edges[0] is not observation:
            self._edges = observation, edge_points(observation)
        return self._edges[1]


class RepeatingProposer:
    """Proposes given actions in order, each at the movable point nearest to its own point.

    Args:
        actions: of another environment of the same object.
    """

    name = "repeating"

    def __init__(self, actions: Sequence[Action]) -> None:
        self._actions = iter(actions)

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """The next action, or None after the last one."""
        action = next(self._actions, None)
        if action is None:
            return None
        movable = np.flatnonzero(observation.movable)
        nearest = movable[np.linalg.norm(observation.points[movable] - action.point, axis=1).argmin()]
        return replace(action, point_index=int(nearest))


def edge_points(observation: Observation) -> NDArray[np.int64]:
    """Indices of the movable points that lie near an edge of the visible surface of their part.

    A point inside a patch has its neighbours all around it; near an edge they lie to one side, so that their centroid
    is away from it.
    """
    from scipy.spatial import cKDTree  # A fifth of a worker's imports, and most tasks draw no edges.

    found = []
    for part in np.unique(observation.part_ids[observation.movable]):
        own = np.flatnonzero(observation.part_ids == part)
        points = observation.points[own].astype(np.float64)
        for index, point, near in zip(own, points, cKDTree(points).query_ball_point(points, EDGE_RADIUS), strict=True):
            if np.linalg.norm(points[near].mean(axis=0) - point) > EDGE_OFFSET * EDGE_RADIUS:
                found.append(index)
    return np.array(found, dtype=np.int64)
