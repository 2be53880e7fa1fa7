"""The methods that are compared: each differs from ours in one thing, and does that thing at test time."""

import dataclasses
import hashlib
import json
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors.torch import load, save
from torch import Tensor

from cluster.cli.commands.run import main as run_command
from shared.errors import StoreError, UsageError
from shared.plan import EvaluationConfig
from shared.policies.adaptation import Adapter, action_from_frame, frames_in_view, movable_points, point_indices
from shared.policies.critics import Critic, critic_named
from shared.policies.imagined_outcomes import ASKED, BEST, CANDIDATES, SURE, USUAL_MOTION
from shared.policies.methods import METHODS, BaselineName, CriticName, Method, baselines_of, versions_of
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.policies.proposers import (
    LEAST_POINTS,
    THRESHOLD,
    FpsProposer,
    SpreadAipProposer,
    actionable_points,
    distances_to,
    proposer_named,
)
from shared.policies.where2act_interaction import TRIES, Where2ActInteraction
from shared.types import Action, Interaction, Observation, Outcome, OutcomeKind
from tests.support.small_networks import TINY
from tests.support.small_policies import BASELINES, CRITICS, history_of, observation_of, policy_with_all

FPS = ("fps", "purefps", "argfps", "where2act-fps")


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    policy = policy_with_all()
    # At its start this baseline says what the prior says; here it should say something else.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        policy.baselines["where2act-interaction"] = Where2ActInteraction(TINY)
    return Adapter(policy)


def actions_of(observation: Observation, count: int) -> list[Action]:
    return [interaction.action for interaction in history_of(observation, count, seed=5)]


def everywhere(observation: Observation) -> NDArray[np.int64]:
    return np.arange(len(observation.points))


# Critics at test time


@pytest.mark.parametrize("name", CRITICS)
def test_a_point_is_believed_the_same_whichever_are_asked_about_with_it(adapter: Adapter, name: CriticName) -> None:
    observation = observation_of()
    critic, history, some = critic_named(name, adapter), history_of(observation, 2), movable_points(observation)[::3]
    whole = critic.affordance(observation, everywhere(observation), history)
    np.testing.assert_allclose(critic.affordance(observation, some, history), whole[some], atol=1e-5)


@pytest.mark.parametrize("name", CRITICS)
def test_the_order_of_the_history_does_not_matter(adapter: Adapter, name: CriticName) -> None:
    observation = observation_of()
    history = history_of(observation, 4)
    critic, actions = critic_named(name, adapter), actions_of(observation, 6)
    for believed in (
        lambda tries: critic.affordance(observation, everywhere(observation), tries),
        lambda tries: critic.predict(observation, actions, tries),
    ):
        scores = believed(history)
        assert ((scores >= 0) & (scores <= 1)).all()
        np.testing.assert_allclose(scores, believed(history[::-1]), atol=1e-5)
        moved = np.abs(scores - believed([])).max()
        assert moved == 0 if name == "where2act" else moved > 1e-4


@pytest.mark.parametrize("name", CRITICS)
def test_proposals_are_scored_like_single_actions(adapter: Adapter, name: CriticName) -> None:
    observation = observation_of()
    critic: Critic = critic_named(name, adapter)
    history, action = history_of(observation, 3), actions_of(observation, 1)[0]
    proposals = adapter.proposals(observation, action.point_index, np.random.default_rng(0))
    proposals = dataclasses.replace(proposals, frames=frames_in_view(observation, [action]).expand(3, 6))
    expected = critic.predict(observation, [action], history)
    np.testing.assert_allclose(critic.predict_proposals(observation, proposals, history), expected.repeat(3), atol=1e-5)


def test_with_no_history_adaptation_is_plain_where2act(adapter: Adapter) -> None:
    observation = observation_of()
    critic, actions = critic_named("where2act-adaptation", adapter), actions_of(observation, 6)
    told = critic.affordance(observation, everywhere(observation), [])
    assert np.array_equal(told, adapter.prior_affordance(observation))
    assert np.array_equal(critic.predict(observation, actions, []), adapter.prior_score(observation, actions))


def test_a_success_raises_and_a_failure_lowers_what_adaptation_says(adapter: Adapter) -> None:
    observation = observation_of()
    critic = critic_named("where2act-adaptation", adapter)
    before = critic.affordance(observation, everywhere(observation), [])
    action = actions_of(observation, 1)[0]
    for success in (True, False):
        history = [Interaction(observation, action, Outcome(OutcomeKind.OK, 0.1, success))]
        change = critic.affordance(observation, everywhere(observation), history) - before
        assert (change > 0).all() if success else (change < 0).all()
        # |r - s_u| sim_pq, with similarities in (0, 1).
        surprise = abs(success - critic.predict(observation, [action], [])[0])
        assert np.abs(change).max() < surprise


def test_before_training_interaction_says_what_the_prior_says() -> None:
    adapter = Adapter(policy_with_all())
    observation = observation_of()
    critic, actions = critic_named("where2act-interaction", adapter), actions_of(observation, 6)
    for history in ([], history_of(observation, 4)):
        told = critic.predict(observation, actions, history)
        np.testing.assert_allclose(told, adapter.prior_score(observation, actions), atol=1e-6)
        believed = critic.affordance(observation, everywhere(observation), history)
        np.testing.assert_allclose(believed, adapter.prior_affordance(observation), atol=1e-6)


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_that_is_not_trained_is_not_used(name: BaselineName) -> None:
    policy = Policy.untrained("push", TINY, 0).with_trained("prior")
    with pytest.raises(UsageError, match=f"{name} is not trained"):
        critic_named(name, Adapter(policy))


# Furthest-point sampling


def try_repeatedly(adapter: Adapter, name: str, observation: Observation, count: int, seed: int = 0) -> list[Action]:
    """The test-time loop over an object that never moves."""
    proposer = proposer_named(name, adapter, np.random.default_rng(seed), count)
    history: list[Interaction] = []
    while len(history) < count and (action := proposer.propose(observation, history)) is not None:
        history.append(Interaction(observation, action, Outcome(OutcomeKind.OK, 0.0, False)))
    return [interaction.action for interaction in history]


@pytest.mark.parametrize("name", FPS)
def test_tries_are_rotations_at_different_movable_points_and_come_again(adapter: Adapter, name: str) -> None:
    observation = observation_of()
    actions = try_repeatedly(adapter, name, observation, 4)
    assert len({action.point_index for action in actions}) == 4
    for action, again in zip(actions, try_repeatedly(adapter, name, observation, 4), strict=True):
        assert observation.movable[action.point_index]
        np.testing.assert_allclose(action.rotation.T @ action.rotation, np.eye(3), atol=1e-9)
        assert action.point_index == again.point_index
        assert np.array_equal(action.rotation, again.rotation)


def test_each_pure_try_is_the_farthest_point_from_those_before(adapter: Adapter) -> None:
    observation = observation_of()
    candidates = movable_points(observation)
    actions = try_repeatedly(adapter, "purefps", observation, 5)
    for count in range(1, 5):
        tried = np.array([action.point for action in actions[:count]])
        distances = np.linalg.norm(observation.points[candidates][:, None] - tried[None], axis=-1).min(axis=1)
        assert actions[count].point_index == candidates[distances.argmax()]


@pytest.mark.parametrize(("name", "critic"), [("fps", "aap"), ("where2act-fps", "where2act")])
def test_each_try_is_the_farthest_among_the_actionable(adapter: Adapter, name: str, critic: CriticName) -> None:
    observation = observation_of(points=600)
    candidates = movable_points(observation)
    actions = try_repeatedly(adapter, name, observation, 4)
    history: list[Interaction] = []
    for count, action in enumerate(actions):
        scores = critic_named(critic, adapter).affordance(observation, candidates, history)
        among = candidates[actionable_points(scores)]
        assert action.point_index in among
        spread = distances_to(observation.points[among].astype(float), np.array([a.point for a in actions[:count]]))
        if count:
            assert spread is not None
            assert action.point_index == among[spread.argmax()]
        history.append(Interaction(observation, action, Outcome(OutcomeKind.OK, 0.0, False)))


def test_spread_aip_chooses_in_the_half_of_the_points_far_from_its_interactions(adapter: Adapter) -> None:
    observation = observation_of()
    movable, history = movable_points(observation), list[Interaction]()
    for count in range(4):
        among = movable
        if history:
            tried = np.array([interaction.action.point for interaction in history])
            spread = distances_to(observation.points[movable].astype(float), tried)
            assert spread is not None
            among = movable[np.argsort(-spread)[: (len(movable) + 1) // 2]]
        best = among[adapter.information(observation, among, adapter.z(history)).argmax()]
        proposer = SpreadAipProposer(adapter, np.random.default_rng(count), 4, at_least=4)
        action = proposer.propose(observation, history)
        assert action is not None
        assert action.point_index == best
        history.append(Interaction(observation, action, Outcome(OutcomeKind.OK, 0.0, False)))
    assert proposer_named("aip-spread", adapter, np.random.default_rng(0), 4).propose(observation, history) is None


def test_the_threshold_falls_until_enough_points_are_above_it() -> None:
    scores = np.random.default_rng(0).uniform(0, 1, 300).astype(np.float32)
    assert set(actionable_points(scores)) == set(np.flatnonzero(scores > THRESHOLD))
    low = scores * 0.4
    kept = actionable_points(low)
    assert len(kept) == LEAST_POINTS
    assert low[kept].min() > np.delete(low, kept).max()
    assert len(actionable_points(low[:10])) == 10


def test_weighted_distance_begins_at_the_top_and_weighs_both(adapter: Adapter) -> None:
    observation = observation_of()
    candidates = movable_points(observation)
    first, second = try_repeatedly(adapter, "argfps", observation, 2)
    critic = critic_named("aap", adapter)
    assert first.point_index == candidates[critic.affordance(observation, candidates, []).argmax()]
    history = [Interaction(observation, first, Outcome(OutcomeKind.OK, 0.0, False))]
    weights = critic.affordance(observation, candidates, history)
    distances = np.linalg.norm(observation.points[candidates] - first.point, axis=1)
    assert second.point_index == candidates[(distances * weights).argmax()]
    proposer = proposer_named("argfps", adapter, np.random.default_rng(0), 1)
    assert isinstance(proposer, FpsProposer)
    assert proposer.choose(np.array([1.0, 2.0, 3.0]), np.array([0.9, 0.8, 0.1], np.float32)) == 1


def test_imagined_interactions_are_read_as_if_they_had_happened(adapter: Adapter) -> None:
    observation = observation_of()
    history, actions = history_of(observation, 2), actions_of(observation, 3)
    points, frames = point_indices(actions), adapter.frames(observation, actions)
    for before in ([], history):
        for motion, success in ((0.0, False), (0.05, True)):
            latents = adapter.imagined(observation, points, frames, (motion, success), before)
            beliefs = adapter.beliefs(observation, points, frames, latents)
            for action, latent, believed in zip(actions, latents, beliefs, strict=True):
                after = [*before, Interaction(observation, action, Outcome(OutcomeKind.OK, motion, success))]
                torch.testing.assert_close(latent, adapter.z(after))
                np.testing.assert_allclose(believed, adapter.score(observation, actions, after), rtol=1e-4)


@pytest.mark.parametrize("name", ["information-gain", "information-value"])
def test_the_action_whose_imagined_outcomes_are_worth_the_most_is_proposed(
    adapter: Adapter, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    observation, compared, asked = observation_of(), list[list[Action]](), list[list[Action]]()
    history = history_of(observation, 2)

    def actions_of(points: NDArray[np.int64], frames: Tensor) -> list[Action]:
        return [action_from_frame(observation, int(p), frame) for p, frame in zip(points, frames, strict=True)]

    imagined, beliefs = Adapter.imagined, Adapter.beliefs

    def spied(self: Adapter, seen: Observation, points: NDArray[np.int64], frames: Tensor, *rest: Any) -> Tensor:
        compared.append(actions_of(points, frames))
        return imagined(self, seen, points, frames, *rest)

    def heard(self: Adapter, seen: Observation, points: NDArray[np.int64], frames: Tensor, latents: Tensor) -> Tensor:
        asked.append(actions_of(points, frames))
        return beliefs(self, seen, points, frames, latents)

    monkeypatch.setattr(Adapter, "imagined", spied)
    monkeypatch.setattr(Adapter, "beliefs", heard)
    proposed = proposer_named(name, adapter, np.random.default_rng(0), 4).propose(observation, history)
    assert proposed is not None
    actions, questions = compared[0], asked[-1]
    assert len({action.point_index for action in actions}) == len(actions)
    assert len(actions) == min(CANDIDATES, len(movable_points(observation)))
    assert len(questions) == len(actions) * (ASKED if name == "information-gain" else 1)
    motion = float(np.median([i.outcome.motion for i in history if i.outcome.success] or [USUAL_MOTION]))
    now = adapter.score(observation, questions, history).clip(SURE, 1 - SURE).astype(float)

    def worth(after: list[Interaction]) -> float:
        believed = adapter.score(observation, questions, after).clip(SURE, 1 - SURE).astype(float)
        if name == "information-value":
            return float(np.sort(believed)[-BEST:].mean())
        moved = believed * np.log(believed / now) + (1 - believed) * np.log((1 - believed) / (1 - now))
        return float(moved.mean())

    def expected(action: Action) -> float:
        odds = float(adapter.score(observation, [action], history)[0])
        outcomes = Outcome(OutcomeKind.OK, motion, True), Outcome(OutcomeKind.OK, 0.0, False)
        good, bad = (worth([*history, Interaction(observation, action, outcome)]) for outcome in outcomes)
        return odds * good + (1 - odds) * bad

    values = [expected(action) for action in actions]
    chosen = next(k for k, action in enumerate(actions) if action.point_index == proposed.point_index)
    assert values[chosen] == pytest.approx(max(values), abs=1e-5)


def test_an_unknown_proposer_is_refused_with_those_there_are(adapter: Adapter) -> None:
    with pytest.raises(UsageError, match="argfps"):
        proposer_named("afps", adapter, np.random.default_rng(0), 1)


# Methods


@pytest.mark.parametrize("name", sorted(METHODS.names()))
def test_every_method_runs_the_loop(adapter: Adapter, name: str) -> None:
    method, observation = METHODS.get(name), observation_of()
    history: list[Interaction] = []
    for budget in method.budgets((4, 1)):
        if method.tries not in (None, "random"):
            tries = proposer_named(str(method.tries), adapter, np.random.default_rng(1), 4)
            while len(history) < budget and (action := tries.propose(observation, history)) is not None:
                history.append(Interaction(observation, action, Outcome(OutcomeKind.OK, 0.02, len(history) % 2 == 0)))
        exploit = proposer_named(method.critic, adapter, np.random.default_rng(2), 4).propose(observation, history)
        assert exploit is not None
        assert observation.movable[exploit.point_index]


def test_methods_say_what_they_need() -> None:
    assert baselines_of(["where2act", "ours-final"]) == []
    assert baselines_of(["where2act-adaptation", "ours-fps", "where2act-interaction"]) == list(BASELINES)
    assert versions_of(["ours-final", "ours-fps"], 3) == [3]
    assert versions_of(["ours-no-iteration", "ours-final"], 3) == [1, 3]
    assert versions_of(["ours-no-iteration"], 1) == [1]
    assert METHODS.get("where2act-interaction").budgets((1, 2)) == [TRIES]
    assert Method("aip", "aap").budgets((4, 1, 4)) == [1, 4]


def test_a_misspelt_method_is_refused_when_the_evaluation_is_planned() -> None:
    with pytest.raises(UsageError, match=r"unknown method 'ours-fsp'; allowed: where2act, .*ours-argfps"):
        run_command(["--evaluation.methods", "ours-fsp", "--dry-run"])
    with pytest.raises(ValidationError, match="should match pattern"):
        EvaluationConfig.model_validate({"methods": ["ours/fps"]})


# Policies


def test_a_policy_with_baselines_comes_back_bit_for_bit_and_one_without_is_as_before() -> None:
    policy = policy_with_all()
    files = policy.to_files()
    again = Policy.from_files(files)
    assert again.trained == policy.trained
    assert again.to_files() == files
    without = Policy.from_files(Policy.untrained("push", TINY, 0).with_trained("prior").to_files())
    assert not without.baselines
    assert set(without.modules().keys()) == {"prior", "aap", "aip"}


def test_hostile_baselines_are_refused() -> None:
    files = policy_with_all().to_files()
    tensors, document = load(files[WEIGHTS_FILE]), json.loads(files[POLICY_FILE])

    def refused(weights: dict[str, torch.Tensor], trained: list[str], message: str) -> None:
        data = save(weights)
        told = document | {"trained": trained, "weights_sha256": hashlib.sha256(data).hexdigest()}
        with pytest.raises(StoreError, match=message):
            Policy.from_files({WEIGHTS_FILE: data, POLICY_FILE: json.dumps(told).encode()})

    name = "where2act-adaptation.similarity_head.bias"
    refused(tensors, ["prior"], "unknown")
    refused({key: tensor for key, tensor in tensors.items() if key != name}, document["trained"], "missing")
    refused(tensors | {name: torch.full_like(tensors[name], np.nan)}, document["trained"], "not finite")
    refused(tensors | {name: torch.zeros(3)}, document["trained"], r"needs torch\.float32")
    refused(tensors, ["where2act"], "has the network 'where2act'; install the package")
    refused(tensors, ["../x"], "damaged or foreign")
