"""Adaptation at test time: predictions of a policy, given a history of interactions with one object.

Everything here runs on the CPU in some tens of milliseconds a step, needs only a policy, and is deterministic for a
given random generator. `shared.policies.proposers` chooses interactions.

Shapes: N points of a cloud, A actions, S proposals at a point.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from shared.arms.kinematics import reachable_points
from shared.errors import UsageError
from shared.geometry import gripper_rotation, points_in_view, view_from_world
from shared.networks.aap import Aap
from shared.networks.actions import FRAME_WIDTH, middle_of, outcome_details
from shared.networks.aip import Aip
from shared.networks.pointnet2 import CloudBatch, EncodedClouds, group_cloud, nearest_points
from shared.networks.prior import Prior
from shared.pinch import PROFILE_WIDTH, pinch_profiles
from shared.policies.methods import ModuleName
from shared.policies.policy import Policy
from shared.types import Action, Float, Float32, Interaction, Observation

PROPOSALS = 100
"""Actions sampled at a point (AdaAfford, Next-step Interaction Action Proposal)."""
MAX_CACHED_OBSERVATIONS = 64
MAX_ASKED_POINTS = 12
"""Sets of points for which D's inputs are kept, some megabytes each: of the present observations, not of a history."""


@dataclass(slots=True)
class _Entry:
    """Cached results of one observation; the reference to it prevents that its id is reused.

    Attributes:
        observation: it.
        clouds: its cloud, with the neighbours of each point.
        tree: finds the surroundings of a point.
        middle: of the movable points, [3].
        dense: [M, 3], the surface at full resolution, where networks are told pinch profiles.
        encoded: the cloud under a module's encoder.
        codes: code and attention weight of interactions on this observation, by module, action and outcome.
    """

    observation: Observation
    clouds: CloudBatch
    tree: cKDTree
    middle: Tensor
    dense: Float32 | None
    encoded: dict[ModuleName, EncodedClouds]
    codes: dict[tuple[ModuleName, int, bytes, str], tuple[Tensor, Tensor]]


@dataclass(frozen=True, slots=True)
class _AskedPoints:
    """What a D network is told of points of an observation, whatever was tried; the references are as in `_Entry`."""

    observation: Observation
    points: NDArray[np.int64]
    told: list[Tensor]


@dataclass(frozen=True, slots=True)
class Proposals:
    """Rotations at one point.

    Attributes:
        point: index of p.
        frames: approach and forward, view frame, and the pinch profile if the policy uses it, [S, 6 or more].
    """

    point: int
    frames: Tensor


class Adapter:
    """A policy at test time: z of a history, and the scores and actionabilities given z.

    Each cloud is encoded when it is first needed, and each interaction once. Both are cached by the identity of the
    observation, so after a new interaction only the layers that read z are computed again.

    It does not check that the networks are trained; critics and proposers do.

    Args:
        policy: its networks are switched to evaluation mode.

    Example:
        >>> adapter = Adapter(Policy.from_files(files))
        >>> before = adapter.affordance(observation, [])         # [N], AAP without interactions
        >>> after = adapter.affordance(observation, history)     # [N], adapted
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        policy.modules().eval()
        self._entries: OrderedDict[int, _Entry] = OrderedDict()
        self._asked: OrderedDict[tuple[int, ModuleName], _AskedPoints] = OrderedDict()

    def encode(self, observation: Observation, module: ModuleName = "aap") -> EncodedClouds:
        """The observation's cloud under a module's encoder, computed once."""
        entry = self._entry(observation)
        if module not in entry.encoded:
            with torch.inference_mode():
                entry.encoded[module] = self._module(module).encoder(entry.clouds)
        return entry.encoded[module]

    @torch.inference_mode()
    def z(self, history: Sequence[Interaction], module: ModuleName = "aap") -> Tensor:
        """z_I, the hidden information in a history (AdaAfford, Adaptive Affordance Prediction), [latent_width].

        Args:
            history: interactions in any order; may be empty.
            module: "aap", or a baseline that encodes a history.

        Raises:
            UsageError: the baseline is not trained, or a motion is negative or not finite.
        """
        return self._adaptive(module).latent(*self._history_codes(history, module))

    @torch.inference_mode()
    def imagined(
        self,
        observation: Observation,
        points: NDArray[np.int64],
        frames: Tensor,
        outcome: tuple[float, bool],
        history: Sequence[Interaction],
    ) -> Tensor:
        """The z of a history and one imagined interaction, for each of some actions, [A, latent_width].

        Args:
            observation: of the imagined interactions.
            points: indices of the actions' points, [A].
            frames: of the actions, as `frames` gives them, [A, 6 or more].
            outcome: m and r of the imagined interactions; what else an outcome tells is unknown.
            history: interactions that were executed.
        """
        motions = torch.full((len(points),), outcome[0])
        codes, weights = self.policy.aap.interaction_codes(
            self.features(observation, "aap", points),
            self.places(observation, points),
            frames,
            motions,
            torch.full_like(motions, float(outcome[1])),
        )
        known, known_weights = self._history_codes(history, "aap")
        return self.policy.aap.prefix_latents(
            torch.cat([known.expand(len(points), -1, -1), codes[:, None]], dim=1),
            torch.cat([known_weights.expand(len(points), -1), weights[:, None]], dim=1),
        )[:, -1]

    @torch.inference_mode()
    def beliefs(self, observation: Observation, points: NDArray[np.int64], frames: Tensor, latents: Tensor) -> Tensor:
        """The AAP scores s_u|z of the actions that `imagined` describes, under each of some z, [Z, A]."""
        return self._scores(observation, "aap", points, frames, latents[:, None])

    @torch.inference_mode()
    def affordance(
        self,
        observation: Observation,
        history: Sequence[Interaction],
        module: ModuleName = "aap",
        points: NDArray[np.int64] | None = None,
    ) -> Float32:
        """A_I, the affordance posterior: the AAP actionability after a history, [N] or [len(points)], in [0, 1].

        Args:
            observation: with N points.
            history: interactions; may be empty.
            module: "aap", or a baseline that encodes a history.
            points: indices of the points to score; None: all.

        Raises:
            UsageError: as `z`; or the policy needs pinch profiles, and the observation has no dense geometry.
        """
        told = self._told_of_points(observation, module, points)
        return self._adaptive(module).affordance(told, self.z(history, module)).numpy()

    @torch.inference_mode()
    def prior_affordance(self, observation: Observation, points: NDArray[np.int64] | None = None) -> Float32:
        """A, the affordance prior: Where2Act's actionability of all points, [N], or of `points` only, in [0, 1]."""
        return self.policy.prior.affordance(self._told_of_points(observation, "prior", points)).numpy()

    @torch.inference_mode()
    def score(
        self,
        observation: Observation,
        actions: Sequence[Action],
        history: Sequence[Interaction],
        module: ModuleName = "aap",
    ) -> Float32:
        """The AAP scores s_u|z, success probabilities of actions after a history, [A]; raises as `affordance`."""
        points, frames = point_indices(actions), self.frames(observation, actions)
        return self._scores(observation, module, points, frames, self.z(history, module)).numpy()

    @torch.inference_mode()
    def prior_score(self, observation: Observation, actions: Sequence[Action]) -> Float32:
        """Where2Act's scores of actions, [A], in [0, 1]."""
        return self._scores(observation, "prior", point_indices(actions), self.frames(observation, actions)).numpy()

    @torch.inference_mode()
    def _scores(
        self, observation: Observation, module: ModuleName, points: NDArray[np.int64], frames: Tensor, *latents: Tensor
    ) -> Tensor:
        """A module's scores of actions, in [0, 1], under z unless it is the prior; what is at one point broadcasts."""
        network: Any = self.policy.prior if module == "prior" else self._adaptive(module)
        features, places = self.features(observation, module, points), self.places(observation, points)
        return torch.sigmoid(network.action_logits(features, places, frames, *latents))

    @torch.inference_mode()
    def features(self, observation: Observation, module: ModuleName, points: NDArray[np.int64]) -> Tensor:
        """A module's features of points and of their surroundings, [len(points), point_width]."""
        index, entry = torch.from_numpy(points), self._entry(observation)
        features = self._module(module).encoder.features_at(
            self.encode(observation, module), torch.zeros_like(index), index
        )
        at = entry.clouds.points[0, index]
        around = torch.from_numpy(nearest_points(entry.tree, at.numpy(), self.policy.config.surroundings))
        offsets = entry.clouds.points[0, around] - at[:, None]
        return torch.cat([features, offsets.flatten(1)], dim=-1)

    def places(self, observation: Observation, points: NDArray[np.int64]) -> Tensor:
        """Positions relative to the centre of the movable points, [len(points), 3]."""
        entry = self._entry(observation)
        return entry.clouds.points[0, torch.from_numpy(points)] - entry.middle

    @torch.inference_mode()
    def proposals(self, observation: Observation, point: int, rng: np.random.Generator) -> Proposals:
        """100 rotations at a point, from the Action Proposal Network of Where2Act's prior.

        Args:
            observation: with N points.
            point: index of the point.
            rng: of the noise that the network turns into rotations.
        """
        noise = rng.standard_normal((PROPOSALS, self.policy.config.noise_width)).astype(np.float32)
        features = self.features(observation, "prior", np.array([point]))
        frames = self.policy.prior.propose(features, torch.from_numpy(noise))
        return Proposals(point, self._told(observation, np.full(len(frames), point), frames))

    def frames(self, observation: Observation, actions: Sequence[Action]) -> Tensor:
        """Actions as inputs of the networks: approach and forward, and the pinch profile if the policy uses it.

        Returns:
            [A, 6 or more], view frame.
        """
        return self._told(observation, point_indices(actions), frames_in_view(observation, actions))

    def _told(self, observation: Observation, points: NDArray[np.int64], frames: Tensor) -> Tensor:
        """Frames, [A, 6], at points given by index, [A], with pinch profiles where networks are told them."""
        entry = self._entry(observation)
        if entry.dense is None:
            return frames
        profiles = np.empty((len(frames), PROFILE_WIDTH), np.float32)
        for point in np.unique(points):
            here = points == point
            profiles[here] = pinch_profiles(entry.dense, entry.clouds.points[0, point].numpy(), frames[here].numpy())
        return torch.cat([frames, torch.from_numpy(profiles)], dim=-1)

    @torch.inference_mode()
    def score_proposals(
        self, observation: Observation, proposals: Proposals, latent: Tensor, module: ModuleName = "aap"
    ) -> Tensor:
        """The AAP scores s_u|z of proposals, [S]."""
        return self._scores(observation, module, np.array([proposals.point]), proposals.frames, latent)

    @torch.inference_mode()
    def prior_score_proposals(self, observation: Observation, proposals: Proposals) -> Tensor:
        """Where2Act's scores of proposals, [S]."""
        return self._scores(observation, "prior", np.array([proposals.point]), proposals.frames)

    @torch.inference_mode()
    def information_proposals(self, observation: Observation, proposals: Proposals, latent: Tensor) -> Tensor:
        """The AIP scores s^AIP_u|z of proposals, [S]."""
        index = np.array([proposals.point])
        features = self.features(observation, "aip", index)
        scores = self.score_proposals(observation, proposals, latent)
        points = self.places(observation, index)
        return self.policy.aip.action_scores(features, points, proposals.frames, latent, scores)

    @torch.inference_mode()
    def information(self, observation: Observation, points: NDArray[np.int64], latent: Tensor) -> Float32:
        """The AIP actionability a^AIP_p|z of the points at the indices `points`, [len(points)].

        By default of the training it is an expected drop of AAP's loss, so it has no fixed range.
        """
        expected = self.policy.aap.affordance(self._told_of_points(observation, "aap", points), latent)
        told = self._told_of_points(observation, "aip", points)
        return self.policy.aip.affordance(told, latent, expected).numpy()

    @torch.inference_mode()
    def _told_of_points(
        self, observation: Observation, module: ModuleName, points: NDArray[np.int64] | None
    ) -> list[Tensor]:
        """What a module's D network is told of points, [N] or given by index, whatever was tried."""
        asked = np.arange(len(observation.points)) if points is None else points
        key = id(observation), module
        kept = self._asked.pop(key, None)
        if kept is None or kept.observation is not observation or not np.array_equal(kept.points, asked):
            features, places = self.features(observation, module, asked), self.places(observation, asked)
            kept = _AskedPoints(observation, asked, self._module(module).told_of_points(features, places))
        self._asked[key] = kept
        if len(self._asked) > MAX_ASKED_POINTS:
            self._asked.popitem(last=False)
        return kept.told

    def _entry(self, observation: Observation) -> _Entry:
        entry = self._entries.get(id(observation))
        if entry is None:
            points = points_in_view(observation)
            clouds = CloudBatch.of([points], [group_cloud(points, self.policy.config)])
            middle = middle_of(clouds.points[0], torch.from_numpy(observation.movable))
            dense = dense_in_view(observation) if self.policy.config.pinch_profile else None
            entry = self._entries[id(observation)] = _Entry(
                observation, clouds, cKDTree(points), middle, dense, encoded={}, codes={}
            )
            if len(self._entries) > MAX_CACHED_OBSERVATIONS:
                self._entries.popitem(last=False)
        self._entries.move_to_end(id(observation))
        return entry

    def _adaptive(self, module: ModuleName) -> Aap:
        """A network that encodes a history into z, and scores under it."""
        if module == "aap":
            return self.policy.aap
        self.policy.require(module)
        return self.policy.baseline(module, Aap)

    def _module(self, module: ModuleName) -> Prior | Aap | Aip:
        match module:
            case "prior":
                return self.policy.prior
            case "aip":
                return self.policy.aip
            case _:
                return self._adaptive(module)

    def _history_codes(self, history: Sequence[Interaction], module: ModuleName) -> tuple[Tensor, Tensor]:
        """Codes, [K, latent_width], and attention weights, [K], of interactions."""
        if not history:
            return torch.zeros(0, self.policy.config.latent_width), torch.zeros(0)
        parts = [self._interaction_code(interaction, module) for interaction in history]
        return torch.cat([code for code, _ in parts]), torch.cat([weight for _, weight in parts])

    def _interaction_code(self, interaction: Interaction, module: ModuleName) -> tuple[Tensor, Tensor]:
        observation, action, outcome = interaction.observation, interaction.action, interaction.outcome
        codes = self._entry(observation).codes
        # By value, because a robot's interactions may be read anew at each step.
        key = module, action.point_index, action.rotation.tobytes(), repr(outcome)
        if key not in codes:
            if not 0 <= outcome.motion < np.inf:
                # Networks make NaN of it, and of all that they predict with it.
                raise UsageError(
                    f"an outcome has the motion {outcome.motion:g}; give how far the part moved, 0 or more"
                )
            index = np.array([action.point_index])
            codes[key] = self._adaptive(module).interaction_codes(
                self.features(observation, module, index),
                self.places(observation, index),
                self.frames(observation, [action]),
                torch.tensor([outcome.motion], dtype=torch.float32),
                torch.tensor([float(outcome.success)]),
                torch.from_numpy(outcome_details([outcome.kind], [outcome.grasp_opening])),
            )
        return codes[key]


def movable_points(observation: Observation) -> NDArray[np.int64]:
    """Indices of the points that the task may act on.

    Raises:
        UsageError: there are none.
    """
    points = np.flatnonzero(observation.movable)
    if not len(points):
        raise UsageError("the observation has no movable point; look from another side, or mark the points to act on")
    return points


def dense_in_view(observation: Observation) -> Float32:
    """The surface at the full resolution of its sensor, [M, 3], view frame.

    Raises:
        UsageError: it was not kept.
    """
    if observation.dense is None:
        raise UsageError(
            "the policy is told what lies between the fingers, and the observation keeps no depth image; use a policy "
            "without that input, such as the bundled pull-sparse, or collect with --collection.camera.keep-depth"
        )
    view = view_from_world(observation.world_from_camera).astype(np.float32)
    return observation.dense.points() @ view.T


def point_indices(actions: Sequence[Action]) -> NDArray[np.int64]:
    """Indices of the points that actions touch, [A]."""
    return np.array([action.point_index for action in actions], dtype=np.int64)


def frames_in_view(observation: Observation, actions: Sequence[Action]) -> Tensor:
    """Approach and forward of actions in the observation's view frame, [A, 6]."""
    view = view_from_world(observation.world_from_camera)
    rows = [np.concatenate([view @ action.approach, view @ action.forward]) for action in actions]
    return torch.from_numpy(np.array(rows, dtype=np.float32).reshape(-1, 6))


MOST_POINTS, NEAR_M = 8, 0.05
"""Points at which an action within the arm's reach is looked for, and how far apart they are, m."""


def reachable_action(
    observation: Observation,
    points: NDArray[np.int64],
    choose: Callable[[NDArray[np.int64]], int],
    act: Callable[[int], tuple[Proposals, Tensor]],
) -> Action:
    """The best action at a point; where the arm is known, the best that it reaches, at the next point if need be.

    Once nothing is reached at the first point, points come first that `reachable_points` finds in reach.

    Args:
        observation: with or without an arm.
        points: indices of the points that may be chosen, [C].
        choose: chooses the best of those at some places in `points`, [1 or more]; returns the place in `points`.
        act: gives proposals at a point, and their scores, [S].

    Returns:
        If the arm reaches none: the best action at the first point, whose trajectory is then None.
    """
    places: Float = observation.points[points].astype(np.float64)
    left, likely, best = np.ones(len(points), np.bool_), np.ones(len(points), np.bool_), None
    for _ in range(MOST_POINTS):
        chosen = choose(np.flatnonzero(left & likely if (left & likely).any() else left))
        point = int(points[chosen])
        proposals, scores = act(point)
        if best is None:
            best = action_from_frame(observation, point, proposals.frames[int(scores.argmax())])
        if observation.reach is None:
            return best
        best_first = proposals.frames[scores.argsort(descending=True, stable=True)]
        reached = first_in_reach(observation, (action_from_frame(observation, point, frame) for frame in best_first))
        if reached is not None:
            return reached
        likely = reachable_points(observation)[points]
        left &= np.linalg.norm(places - places[chosen], axis=1) > NEAR_M
        if not left.any():
            break
    assert best is not None, "there is a first point"
    return best


def first_in_reach(observation: Observation, actions: Iterable[Action]) -> Action | None:
    """The first action that the arm reaches, or the first of all where no arm is known; None where it reaches none."""
    reach = observation.reach
    return next((action for action in actions if reach is None or reach.trajectory(action) is not None), None)


def action_from_frame(observation: Observation, point: int, frame: Tensor) -> Action:
    """The action at a point of the observation whose approach and forward, [6], are given in the view frame."""
    view = view_from_world(observation.world_from_camera)
    approach, forward = frame[:FRAME_WIDTH].double().numpy().reshape(2, 3) @ view
    approach /= np.linalg.norm(approach)
    rotation: Float = gripper_rotation(approach, forward)
    return Action(point, observation.points[point].astype(np.float64), rotation)
