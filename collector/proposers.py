"""The random proposer: trial and error without a policy."""

from collections.abc import Sequence

import numpy as np

from shared.geometry import gripper_rotation
from shared.vocabulary import Action, Float, Interaction, Observation

LEAST_COSINE = 0.7
"""AdaAfford's random data approaches within about 45 deg of the inward normal: d . n < -0.7."""


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
    """Proposes a random visible point that the task may act on, approached from a random side; never stops."""

    name = "random"

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        """A random action, or None where nothing that the task may act on is in view."""
        candidates = np.flatnonzero(observation.movable)
        if len(candidates) == 0:
            return None
        index = int(self._rng.choice(candidates))
        rotation = random_rotation(observation.normals[index].astype(np.float64), self._rng)
        return Action(index, observation.points[index].astype(np.float64), rotation)
