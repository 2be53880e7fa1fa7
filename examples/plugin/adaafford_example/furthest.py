"""A proposer that needs no policy: it chooses points far from the hinge, where a force has the longest lever."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from shared.geometry import gripper_rotation
from shared.policies.methods import ProposerKind
from shared.types import Action, Interaction, Observation

SHARE = 0.1
"""Of the movable points, those furthest away, one of which is tried."""


class FurthestProposer:
    """Tries one of the movable points that are furthest from all that does not move, since the hinge is there.

    Args:
        rng: draws the point, and how the gripper is turned about its approach.
    """

    name = "furthest"

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """A point, approached along its normal; None where nothing movable is in view."""
        movable = np.flatnonzero(observation.movable)
        if not len(movable):
            return None
        points = observation.points.astype(np.float64)
        still = points[~observation.movable]
        distances = cKDTree(still).query(points[movable])[0] if len(still) else np.zeros(len(movable))
        # A stable sort makes the choice among equal distances independent of the machine.
        furthest = movable[np.argsort(-distances, kind="stable")][: max(1, round(SHARE * len(movable)))]
        index = int(self._rng.choice(furthest))
        inward = -observation.normals[index].astype(np.float64)
        rotation = gripper_rotation(inward / np.linalg.norm(inward), self._rng.standard_normal(3))
        return Action(index, points[index], rotation)


FURTHEST = ProposerKind(lambda adapter, rng, budget: FurthestProposer(rng))
