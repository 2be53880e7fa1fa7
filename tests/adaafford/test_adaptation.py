"""The test-time procedure: proposals are rotations on movable points, and the history is a set."""

import dataclasses

import numpy as np
import pytest

from shared.errors import UsageError
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import Adapter, action_from_frame, frames_in_view, movable_points
from shared.policies.policy import Policy
from shared.policies.proposers import REPEAT_M, TOP_POINTS, AipProposer, ExploitProposer, RepeatProposer, points_of
from shared.types import Action, Interaction, Outcome, OutcomeKind, Proposer
from tests.support.small_networks import TINY
from tests.support.small_policies import history_of, observation_of, policy_of


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    return Adapter(policy_of())


def proposers(adapter: Adapter, seed: int) -> list[Proposer]:
    return [
        AipProposer(adapter, np.random.default_rng(seed), budget=4, threshold=-1.0),
        ExploitProposer(adapter, np.random.default_rng(seed)),
        ExploitProposer(adapter, np.random.default_rng(seed), "where2act"),
        RepeatProposer(adapter, np.random.default_rng(seed)),
    ]


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("tries", [0, 3])
def test_a_proposal_is_a_rotation_at_a_movable_point(adapter: Adapter, which: int, tries: int) -> None:
    observation = observation_of()
    history = history_of(observation, tries)
    action = proposers(adapter, 1)[which].propose(observation, history)
    assert action is not None
    assert observation.movable[action.point_index]
    assert np.array_equal(action.point, observation.points[action.point_index])
    np.testing.assert_allclose(action.rotation.T @ action.rotation, np.eye(3), atol=1e-9)
    assert np.linalg.det(action.rotation) == pytest.approx(1.0)
    again = proposers(Adapter(adapter.policy), 1)[which].propose(observation, history)
    assert again is not None
    assert again.point_index == action.point_index
    assert np.array_equal(again.rotation, action.rotation)


def test_names_are_those_that_rows_hold(adapter: Adapter) -> None:
    assert [proposer.name for proposer in proposers(adapter, 0)] == ["aip", "aap", "where2act", "aap"]


def test_aip_stops_on_its_budget_and_below_its_threshold(adapter: Adapter) -> None:
    observation = observation_of()
    rng = np.random.default_rng(0)
    history = history_of(observation, 2)
    assert AipProposer(adapter, rng, budget=2, threshold=-1.0).propose(observation, history) is None
    assert AipProposer(adapter, rng, budget=3, threshold=-1.0).propose(observation, history) is not None
    assert AipProposer(adapter, rng, budget=3, threshold=1e6).propose(observation, history) is None
    assert AipProposer(adapter, rng, budget=3, threshold=1e6).propose(observation, []) is not None
    assert AipProposer(adapter, rng, budget=3, threshold=1e6, at_least=0).propose(observation, []) is None


def test_aip_takes_the_point_that_promises_most(adapter: Adapter) -> None:
    observation = observation_of()
    action = AipProposer(adapter, np.random.default_rng(0), budget=1).propose(observation, [])
    assert action is not None
    candidates = movable_points(observation)
    information = adapter.information(observation, candidates, adapter.z([]))
    assert action.point_index == candidates[information.argmax()]


def test_an_exploit_is_among_the_hundred_best_points(adapter: Adapter) -> None:
    observation = observation_of(points=600)
    scores = adapter.affordance(observation, [])
    best = set(sorted(movable_points(observation), key=lambda point: -scores[point])[:100])
    exploit = ExploitProposer(adapter, np.random.default_rng(2))
    for _ in range(5):
        action = exploit.propose(observation, [])
        assert action is not None
        assert action.point_index in best


@pytest.mark.parametrize(("share", "count"), [(0.01, 6), (0.001, 1), (0.0126, 8), (1.0, 600)])
def test_a_share_draws_points_from_the_best_of_the_whole_cloud(adapter: Adapter, share: float, count: int) -> None:
    observation = observation_of(points=600)
    candidates, rng = movable_points(observation), np.random.default_rng(2)
    proposers = {
        "exploit": (ExploitProposer(adapter, rng, share=share), adapter.affordance(observation, [])[candidates]),
        "aip": (
            AipProposer(adapter, rng, budget=99, share=share),
            adapter.information(observation, candidates, adapter.z([])),
        ),
    }
    for proposer, scores in proposers.values():
        best = set(candidates[np.argsort(-scores, kind="stable")[:count]])
        drawn = {action.point_index for _ in range(6) if (action := proposer.propose(observation, [])) is not None}
        assert drawn <= best
        assert len(drawn) > 1 or count == 1


def test_a_final_action_repeats_what_succeeded_near_it_where_the_critic_believes_in_it_most(adapter: Adapter) -> None:
    observation = observation_of(points=600)
    failed, other, best = history_of(observation, 3)
    failed, other, best = (
        dataclasses.replace(tried, outcome=Outcome(OutcomeKind.OK, 0.1 * success, success))
        for tried, success in ((failed, False), (other, True), (best, True))
    )
    history = [failed, other, best]
    action = RepeatProposer(adapter, np.random.default_rng(0)).propose(observation, history)
    assert action is not None
    expected = {
        (int(point), k): adapter.score(
            observation, [dataclasses.replace(tried.action, point_index=int(point))], history
        )
        for k, tried in enumerate((other, best))
        for point in movable_points(observation)
        if np.linalg.norm(observation.points[point] - tried.action.point) < REPEAT_M
    }
    point, which = max(expected, key=lambda key: float(expected[key][0]))
    assert action.point_index == point
    assert np.array_equal(action.rotation, (other, best)[which].action.rotation)


def test_where_nothing_succeeded_or_is_in_reach_a_final_action_is_an_exploit(adapter: Adapter) -> None:
    observation = observation_of(points=600)
    (tried,) = history_of(observation, 1)
    failed = dataclasses.replace(tried, outcome=Outcome(OutcomeKind.OK, 0.0, False))
    succeeded = dataclasses.replace(tried, outcome=Outcome(OutcomeKind.OK, 0.1, True))
    far = dataclasses.replace(succeeded, action=dataclasses.replace(succeeded.action, point=np.full(3, 9.0)))
    for history in ([], [failed], [far]):
        mine, exploit = (
            kind(adapter, np.random.default_rng(3), share=0.01).propose(observation, history)
            for kind in (RepeatProposer, ExploitProposer)
        )
        assert mine is not None
        assert exploit is not None
        assert mine.point_index == exploit.point_index
        assert np.array_equal(mine.rotation, exploit.rotation)


def test_a_share_of_a_published_cloud_is_the_published_number_of_points() -> None:
    cloud = dataclasses.replace(observation_of(), points=np.zeros((10_000, 3), np.float32))
    assert points_of(0.01, cloud) == TOP_POINTS == 100


def test_without_a_movable_point_nothing_is_proposed(adapter: Adapter) -> None:
    still = dataclasses.replace(observation_of(), movable=np.zeros(200, dtype=bool))
    with pytest.raises(UsageError, match="no movable point"):
        AipProposer(adapter, np.random.default_rng(0), budget=1).propose(still, [])


@pytest.mark.parametrize("motion", [float("nan"), float("inf"), -0.1])
def test_an_outcome_that_is_no_motion_is_refused(adapter: Adapter, motion: float) -> None:
    (tried,) = history_of(observation_of(), 1)
    wrong = dataclasses.replace(tried, outcome=dataclasses.replace(tried.outcome, motion=motion))
    with pytest.raises(UsageError, match=f"the motion {motion:g};"):
        adapter.affordance(tried.observation, [wrong])


@pytest.mark.parametrize("share", [0.0, 1.01, float("nan")])
def test_what_is_no_share_is_refused(adapter: Adapter, share: float) -> None:
    with pytest.raises(UsageError, match="share="):
        ExploitProposer(adapter, np.random.default_rng(0), share=share).propose(observation_of(), [])


def test_untrained_policies_are_refused() -> None:
    with pytest.raises(UsageError, match="not trained"):
        AipProposer(Adapter(Policy.untrained("push", TINY, 0)), np.random.default_rng(0), budget=1)


def test_the_order_of_the_history_does_not_matter_and_the_history_does(adapter: Adapter) -> None:
    observation = observation_of()
    history = history_of(observation, 5)
    adapted = adapter.affordance(observation, history)
    np.testing.assert_allclose(adapted, adapter.affordance(observation, history[::-1]), atol=1e-5)
    assert np.abs(adapted - adapter.affordance(observation, [])).max() > 1e-4
    assert ((adapted >= 0) & (adapted <= 1)).all()


def test_what_is_cached_changes_no_answer(adapter: Adapter) -> None:
    observation = observation_of()
    points, history = movable_points(observation), history_of(observation, 3)
    for known in ([], history[:1], history, history[:1]):
        for asked in (points, points[:7], None, points):
            expected = Adapter(adapter.policy).affordance(observation, known, points=asked)
            np.testing.assert_array_equal(adapter.affordance(observation, known, points=asked), expected)
    other = [dataclasses.replace(each, outcome=Outcome(OutcomeKind.OK, 0.9, success=True)) for each in history]
    expected = Adapter(adapter.policy).affordance(observation, other)
    np.testing.assert_array_equal(adapter.affordance(observation, other), expected)
    assert np.abs(expected - adapter.affordance(observation, history)).max() > 0


def test_turning_object_and_camera_together_changes_nothing(adapter: Adapter) -> None:
    observation = observation_of()
    angle = 0.8
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    pose = observation.world_from_camera.copy()
    pose[:3] = turn @ pose[:3]
    points = (observation.points @ turn.T).astype(np.float32)
    turned = dataclasses.replace(observation, points=points, world_from_camera=pose)
    history = history_of(observation, 3)
    turned_history = [
        Interaction(
            turned,
            Action(i.action.point_index, turn @ i.action.point, turn @ i.action.rotation),
            i.outcome,
        )
        for i in history
    ]
    np.testing.assert_allclose(
        adapter.affordance(observation, history), adapter.affordance(turned, turned_history), atol=2e-3
    )


def test_view_frames_come_back_as_the_action(adapter: Adapter) -> None:
    observation = observation_of(azimuth=140.0)
    action = history_of(observation, 1)[0].action
    back = action_from_frame(observation, action.point_index, frames_in_view(observation, [action])[0])
    np.testing.assert_allclose(back.rotation, action.rotation, atol=1e-6)


def test_scores_of_single_actions_are_those_of_proposals(adapter: Adapter) -> None:
    observation = observation_of()
    history = history_of(observation, 2)
    proposals = adapter.proposals(observation, int(movable_points(observation)[0]), np.random.default_rng(0))
    actions = [action_from_frame(observation, proposals.point, frame) for frame in proposals.frames[:5]]
    expected = adapter.score_proposals(observation, proposals, adapter.z(history))[:5].numpy()
    np.testing.assert_allclose(adapter.score(observation, actions, history), expected, atol=1e-4)
    assert adapter.prior_score(observation, actions).shape == (5,)


def test_a_cloud_is_encoded_once(adapter: Adapter) -> None:
    observation = observation_of(9)
    assert adapter.encode(observation) is adapter.encode(observation)
    assert adapter.encode(observation) is not adapter.encode(observation_of(9))


def test_networks_of_full_size_propose_where_something_moves() -> None:
    adapter, observation = Adapter(policy_of(NetworkConfig())), observation_of(points=2048)
    action = AipProposer(adapter, np.random.default_rng(0), budget=4).propose(observation, [])
    assert action is not None
    assert observation.movable[action.point_index]


def test_what_a_failure_tells_reaches_a_policy_with_outcome_details_alone() -> None:
    observation = observation_of()
    (made,) = history_of(observation, 1)
    outcomes = {
        "held": Outcome(OutcomeKind.OK, 0.0, False, grasp_opening=0.02),
        "slipped": Outcome(OutcomeKind.NO_GRASP, 0.0, False, grasp_opening=0.001),
        "kind alone": Outcome(OutcomeKind.OK, 0.0, False),
        "nothing": Outcome(OutcomeKind.UNKNOWN, 0.0, False),
    }
    for detailed, different in ((True, len(outcomes)), (False, 1)):
        adapter = Adapter(policy_of(TINY.model_copy(update={"outcome_details": detailed})))
        found = [adapter.z([dataclasses.replace(made, outcome=outcome)]) for outcome in outcomes.values()]
        assert len({z.numpy().tobytes() for z in found}) == different
        heat = adapter.affordance(observation, [dataclasses.replace(made, outcome=outcomes["nothing"])])
        assert np.isfinite(heat).all()
