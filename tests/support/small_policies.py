"""Policies with random weights, and what they are shown."""

import numpy as np

from shared.geometry import camera_pose, gripper_rotation
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import movable_points
from shared.policies.methods import BaselineName, CriticName
from shared.policies.policy import Policy
from shared.types import Action, Interaction, Observation, Outcome, OutcomeKind
from tests.support.fabricate import fabricate_observation
from tests.support.small_networks import TINY


def policy_of(config: NetworkConfig = TINY, seed: int = 0) -> Policy:
    policy = Policy.untrained("push", config, seed)
    return policy.with_trained("prior").with_trained("aap").with_trained("aip")


def observation_of(seed: int = 0, points: int = 200, azimuth: float = 200.0) -> Observation:
    return fabricate_observation(np.random.default_rng(seed), points, camera_pose(azimuth, 40.0, 5.0), 2)


def history_of(observation: Observation, count: int, seed: int = 0) -> list[Interaction]:
    rng = np.random.default_rng(seed)
    tries = []
    for _ in range(count):
        point = int(rng.choice(movable_points(observation)))
        approach = rng.normal(size=3)
        rotation = gripper_rotation(approach / np.linalg.norm(approach), rng.normal(size=3))
        action = Action(point, observation.points[point].astype(float), rotation)
        motion = float(rng.uniform(0, 0.3))
        tries.append(Interaction(observation, action, Outcome(OutcomeKind.OK, motion, motion > 0.1)))
    return tries


BASELINES: tuple[BaselineName, ...] = ("where2act-interaction", "where2act-adaptation")


CRITICS: tuple[CriticName, ...] = ("where2act", "aap", *BASELINES)


def policy_with_all(seed: int = 0) -> Policy:
    """A policy whose networks, all of them at their start, pass for trained."""
    policy = Policy.untrained("push", TINY, seed)
    for name in BASELINES:
        policy.begin_baseline(name, seed)
        policy.with_trained(name)
    return policy.with_trained("prior").with_trained("aap").with_trained("aip")
