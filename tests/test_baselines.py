"""The paper's baselines: each differs from ours in one thing, and does that thing."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from torch import nn

from learner.configuration import AdaptationConfig, InteractionConfig, LearnerConfig
from learner.critics import OracleScores, row_critic
from learner.data import Dataset, load_dataset
from learner.evaluation import NO_TRIES_METHOD, ORACLE_METHOD, PRIOR_METHOD, evaluate, evaluate_store
from learner.frozen import FrozenPrior
from learner.oracle import OracleCritic, read_oracle
from learner.prior import PriorStage
from learner.recipes import ORACLE_FILE
from learner.stages import StageJob, read_policy_folder, run_stage
from learner.where2act_adaptation import AdaptationStage
from learner.where2act_interaction import InteractionStage
from shared.adaptation import Adapter, frames_in_view, movable_points
from shared.critics import Critic, critic_named
from shared.errors import StoreError, UsageError
from shared.fps import LEAST_POINTS, THRESHOLD, FpsProposer, actionable_points, distances_to
from shared.methods import METHODS, BaselineName, CriticName, Method, baselines_of, method_named, versions_of
from shared.networks.aap import Aap
from shared.networks.where2act_interaction import TRIES, Where2ActInteraction
from shared.plan import EvaluationConfig
from shared.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.proposers import proposer_named
from shared.records import InteractionRecord, RolloutRecord
from shared.vocabulary import Action, Interaction, Observation, Outcome, OutcomeKind, Role
from tests.test_adaptation import history_of, observation_of
from tests.test_learner_data import fabricated_plan, fabricated_rollouts, make_store
from tests.test_learner_training import EVERYTHING, FAST, QUICK, descend
from tests.test_networks import TINY

BASELINES: tuple[BaselineName, ...] = ("where2act-interaction", "where2act-adaptation")
CRITICS: tuple[CriticName, ...] = ("where2act", "aap", *BASELINES)
FPS = ("fps", "purefps", "argfps", "where2act-fps")
ALL = FAST.model_copy(
    update={
        "interaction": InteractionConfig(steps=4, validate_every=2, affordance=QUICK),
        "adaptation": AdaptationConfig(steps=4, validate_every=2),
    }
)


def policy_with_all(seed: int = 0) -> Policy:
    """Untrained weights that pass for trained, apart from what keeps a baseline at its start."""
    policy = Policy.untrained("push", TINY, seed)
    for name in BASELINES:
        policy.begin_baseline(name, seed)
        policy.with_trained(name)
    return policy.with_trained("prior").with_trained("aap").with_trained("aip")


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    policy = policy_with_all()
    # Not at its start, where it says what the prior says.
    policy.where2act_interaction = Where2ActInteraction(TINY)
    return Adapter(policy)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("baselines")


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return load_dataset(make_store(folder / "store"), TINY)


@pytest.fixture(scope="module")
def coin_dataset(dataset: Dataset) -> Dataset:
    """All tries of a rollout succeed, or none does: only a try tells which."""
    success = torch.zeros(len(dataset.rows))
    for number, rows in enumerate(dataset.rollouts):
        success[rows] = float(number % 2)
    return dataclasses.replace(dataset, rows=dataclasses.replace(dataset.rows, success=success, motion=success * 0.3))


def actions_of(observation: Observation, count: int) -> list[Action]:
    return [interaction.action for interaction in history_of(observation, count, seed=5)]


# Critics at test time


@pytest.mark.parametrize("name", CRITICS)
def test_the_order_of_the_history_does_not_matter(adapter: Adapter, name: CriticName) -> None:
    observation = observation_of()
    history = history_of(observation, 4)
    critic, actions = critic_named(name, adapter), actions_of(observation, 6)
    for believed in (
        lambda tries: critic.affordance(observation, tries),
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
    assert np.array_equal(critic.affordance(observation, []), adapter.prior_affordance(observation))
    assert np.array_equal(critic.predict(observation, actions, []), adapter.prior_score(observation, actions))


def test_a_success_raises_and_a_failure_lowers_what_adaptation_says(adapter: Adapter) -> None:
    observation = observation_of()
    critic = critic_named("where2act-adaptation", adapter)
    before = critic.affordance(observation, [])
    action = actions_of(observation, 1)[0]
    for success in (True, False):
        history = [Interaction(observation, action, Outcome(OutcomeKind.OK, 0.1, success))]
        change = critic.affordance(observation, history) - before
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
        np.testing.assert_allclose(
            critic.affordance(observation, history), adapter.prior_affordance(observation), atol=1e-6
        )


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
        scores = critic_named(critic, adapter).affordance(observation, history)[candidates]
        among = candidates[actionable_points(scores)]
        assert action.point_index in among
        spread = distances_to(observation.points[among].astype(float), np.array([a.point for a in actions[:count]]))
        if count:
            assert spread is not None
            assert action.point_index == among[spread.argmax()]
        history.append(Interaction(observation, action, Outcome(OutcomeKind.OK, 0.0, False)))


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
    assert first.point_index == candidates[critic.affordance(observation, [])[candidates].argmax()]
    history = [Interaction(observation, first, Outcome(OutcomeKind.OK, 0.0, False))]
    weights = critic.affordance(observation, history)[candidates]
    distances = np.linalg.norm(observation.points[candidates] - first.point, axis=1)
    assert second.point_index == candidates[(distances * weights).argmax()]
    proposer = proposer_named("argfps", adapter, np.random.default_rng(0), 1)
    assert isinstance(proposer, FpsProposer)
    assert proposer.choose(np.array([1.0, 2.0, 3.0]), np.array([0.9, 0.8, 0.1], np.float32)) == 1


def test_an_unknown_proposer_is_refused_with_those_there_are(adapter: Adapter) -> None:
    with pytest.raises(UsageError, match="argfps"):
        proposer_named("afps", adapter, np.random.default_rng(0), 1)


# Methods


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_runs_the_loop(adapter: Adapter, name: str) -> None:
    method, observation = method_named(name), observation_of()
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
    assert METHODS["where2act-interaction"].budgets((1, 2)) == [TRIES]
    assert Method("aip", "aap").budgets((4, 1, 4)) == [1, 4]


def test_a_misspelt_method_is_refused_when_the_evaluation_is_planned() -> None:
    with pytest.raises(ValueError, match="unknown method 'ours-fsp'"):
        EvaluationConfig(methods=("ours-fsp",))


# Policies


def test_a_policy_with_baselines_comes_back_bit_for_bit_and_one_without_is_as_before() -> None:
    policy = policy_with_all()
    files = policy.to_files()
    again = Policy.from_files(files)
    assert again.trained == policy.trained
    assert again.to_files() == files
    without = Policy.from_files(Policy.untrained("push", TINY, 0).with_trained("prior").to_files())
    assert without.where2act_interaction is without.where2act_adaptation is None
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
    refused(tensors, ["where2act"], "damaged or foreign")


# Training


def stage_of(
    name: BaselineName, dataset: Dataset, policy: Policy, **settings: object
) -> InteractionStage | AdaptationStage:
    policy.begin_baseline(name, 0)
    policy.modules().requires_grad_(False)
    prior = FrozenPrior.of(policy.prior.eval(), dataset)
    if name == "where2act-interaction":
        assert policy.where2act_interaction is not None
        config = InteractionConfig.model_validate({"batch_rollouts": 8, **settings})
        return InteractionStage(policy.where2act_interaction.requires_grad_(True), dataset, EVERYTHING, config, prior)
    assert policy.where2act_adaptation is not None
    config_of = AdaptationConfig.model_validate({"batch_rollouts": 8, **settings})
    return AdaptationStage(policy.where2act_adaptation.requires_grad_(True), dataset, EVERYTHING, config_of, prior)


def test_interaction_learns_to_read_its_tries(coin_dataset: Dataset) -> None:
    stage = stage_of("where2act-interaction", coin_dataset, Policy.untrained("push", TINY, 0))
    before = stage.validate()
    descend(stage, 80)
    after = stage.validate()
    assert after["score"] < 0.4 * before["score"]
    assert after["f_score"] > 0.9


def test_adaptation_learns_that_points_of_one_object_are_alike(coin_dataset: Dataset) -> None:
    stage = stage_of("where2act-adaptation", coin_dataset, Policy.untrained("push", TINY, 0))
    before, after = descend(stage, 150)
    assert after["correction"] < 0.5 * before["correction"]
    figures = stage.validate()
    assert figures["bce_with_tries"] < 0.5 * figures["bce_without_tries"]
    assert figures["f_with_tries"] > 0.9


@pytest.mark.parametrize("name", BASELINES)
def test_gradients_reach_the_baseline_and_nothing_else(dataset: Dataset, name: BaselineName) -> None:
    policy = Policy.untrained("push", TINY, 0)
    stage = stage_of(name, dataset, policy)
    # One step away from the start, where the head that reads z is zero.
    descend(stage, 2)
    before = {key: tensor.clone() for key, tensor in policy.modules().state_dict().items()}
    policy.modules().zero_grad()
    torch.stack(list(stage.loss(np.random.default_rng(0)).losses.values())).sum().backward()
    reached = {
        key.split(".")[1] for key, p in stage_module(policy, name) if p.grad is not None and p.grad.abs().sum() > 0
    }
    expected = {
        "where2act-interaction": {child for child, _ in Aap(TINY).named_children()}
        - {"affordance_head", "place_encoder"},
        "where2act-adaptation": {"distance_encoder", "similarity_head"},
    }
    assert reached == expected[name]
    descend(stage, 2)
    changed = {
        key.split(".")[0]
        for key, tensor in policy.modules().state_dict().items()
        if not torch.equal(tensor, before[key])
    }
    assert changed == {name}


def stage_module(policy: Policy, name: str) -> list[tuple[str, nn.Parameter]]:
    return [(key, p) for key, p in policy.modules().named_parameters() if key.startswith(name)]


def test_the_tries_of_interaction_are_spread_and_no_questions(dataset: Dataset) -> None:
    stage = stage_of("where2act-interaction", dataset, Policy.untrained("push", TINY, 0))
    assert isinstance(stage, InteractionStage)
    ordered = stage.order([0, 3], 12, np.random.default_rng(0))
    again = stage.order([0, 3], 12, np.random.default_rng(0))
    assert torch.equal(ordered.rows, again.rows)
    for number, rows in zip((0, 3), ordered.rows, strict=True):
        assert sorted(rows.tolist()) == sorted(dataset.rollouts[number].tolist())
    places = dataset.rows.xyz[ordered.rows]
    spread = torch.cdist(places[:, :TRIES], places[:, :TRIES]) + 9 * torch.eye(TRIES)
    others = torch.cdist(places[:, TRIES:], places[:, TRIES:]) + 9 * torch.eye(12 - TRIES)
    assert (spread.amin(dim=(1, 2)) > others.amin(dim=(1, 2))).all()


# From a store to the table


@pytest.fixture(scope="module")
def trained(folder: Path, dataset: Dataset) -> Path:
    """Folders of all stages, each starting from the one before."""
    before: Path | None = None
    for stage in ("prior", "aap", "aip", *BASELINES):
        run_stage(StageJob(stage, folder / "store", folder / stage, before), ALL)  # type: ignore[arg-type]
        before = folder / stage
    return folder


def test_a_stage_adds_its_baseline_and_leaves_the_rest(trained: Path) -> None:
    without, policy = read_policy_folder(trained / "aip"), read_policy_folder(trained / BASELINES[-1])
    assert policy.trained == {"prior", "aap", "aip", *BASELINES}
    before, after = without.modules().state_dict(), policy.modules().state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())
    for stage in BASELINES:
        run_stage(StageJob(stage, trained / "store", trained / f"{stage}-2", trained / "prior"), ALL)
        again = read_policy_folder(trained / f"{stage}-2").modules()
        expected = policy.modules()[stage].state_dict()
        assert all(torch.equal(t, expected[name]) for name, t in again[stage].state_dict().items()), stage


def test_a_baseline_needs_a_prior(trained: Path) -> None:
    with pytest.raises(UsageError, match="--out of 'prior'"):
        run_stage(StageJob("where2act-interaction", trained / "store", trained / "x"), ALL)


def as_evaluation(rollout: RolloutRecord, methods: tuple[str, ...]) -> RolloutRecord:
    """Four queries, then of each method the same four tries and the same exploit."""
    rows: list[InteractionRecord] = []

    def add(place: int, role: Role, method: str = "", budget: int = -1) -> None:
        row = rollout.interactions[place]
        rows.append(dataclasses.replace(row, step=len(rows), method=method, role=role, budget=budget))

    for place in range(4):
        add(place, Role.QUERY)
    for method in methods:
        for place in range(4, 8) if METHODS[method].tries is not None else ():
            add(place, Role.CONTEXT, method)
        add(8, Role.EXPLOIT, method, 4)
    return dataclasses.replace(rollout, interactions=tuple(rows))


def test_the_table_has_a_row_for_every_method(trained: Path, tmp_path: Path) -> None:
    plan, methods = fabricated_plan(), tuple(METHODS)
    rollouts = [as_evaluation(rollout, methods) for rollout in fabricated_rollouts(plan, 3)]
    store = make_store(tmp_path / "store", rollouts, plan)
    final, first = read_policy_folder(trained / BASELINES[-1]), policy_with_all(seed=9)
    store.publish_policy(2, final.to_files())
    with pytest.raises((StoreError, UsageError)):
        evaluate_store(store, 2, (2, 4))
    store.publish_policy(1, first.to_files())
    oracle = read_oracle(trained / "aap" / ORACLE_FILE, TINY)
    table = {(row.method, row.budget): row for row in evaluate_store(store, 2, (2, 4), oracle)}
    adapted = [name for name in METHODS if name != PRIOR_METHOD]
    assert list(table) == [
        *((name, 0) for name in (PRIOR_METHOD, NO_TRIES_METHOD, ORACLE_METHOD)),
        *((name, budget) for name in adapted for budget in METHODS[name].budgets((2, 4))),
    ]
    assert all(np.isfinite(row.bce) and row.queries == 12 for row in table.values())
    assert all(row.trials == 3 for (name, budget), row in table.items() if budget == 4)
    assert table[ORACLE_METHOD, 0].trials == table[NO_TRIES_METHOD, 0].trials == 0
    # All methods made the same tries: those that share critic and policy agree, and no others.
    assert table["ours-fps", 4].bce == table["ours-final", 4].bce
    different = ("ours-final", "ours-no-iteration", *BASELINES)
    assert len({table[name, 4].bce for name in different}) == len(different)


def test_rows_are_judged_as_they_would_be_seen(trained: Path, dataset: Dataset) -> None:
    """A critic gives a stored row the score that it gives the same action before a camera."""
    policy = read_policy_folder(trained / BASELINES[-1])
    record = fabricated_rollouts(fabricated_plan())[0]
    history = [
        Interaction(record.observations[row.observation], row.action, row.outcome) for row in record.interactions[:4]
    ]
    asked = record.interactions[5]
    index = dataset.rollouts[0]
    for name in CRITICS:
        seen = critic_named(name, Adapter(policy)).predict(
            record.observations[asked.observation], [asked.action], history
        )
        stored = row_critic(name, policy, dataset)(index[5:6], index[:4])
        np.testing.assert_allclose(seen, stored.numpy(), atol=1e-4, err_msg=name)


def test_an_oracle_comes_back_and_a_hostile_one_is_refused(trained: Path, dataset: Dataset, tmp_path: Path) -> None:
    path = trained / "aap" / ORACLE_FILE
    oracle = read_oracle(path, TINY)
    assert isinstance(oracle, OracleCritic)
    scores = OracleScores(oracle, dataset)(torch.arange(5), torch.arange(0))
    assert ((scores > 0) & (scores < 1)).all()
    (tmp_path / "cut").write_bytes(path.read_bytes()[:-9])
    with pytest.raises(StoreError, match="safetensors"):
        read_oracle(tmp_path / "cut", TINY)
    with pytest.raises(StoreError, match=r"another network|needs torch\.float32"):
        read_oracle(path, LearnerConfig().network)


def test_the_prior_is_what_its_own_stage_says(dataset: Dataset) -> None:
    policy = Policy.untrained("push", TINY, 0)
    index = torch.arange(10)
    stage = PriorStage(policy.prior, dataset, EVERYTHING, ALL.prior)
    torch.testing.assert_close(stage.scores(index), FrozenPrior.of(policy.prior, dataset).scores[index])


def test_an_unknown_method_in_a_store_is_refused(trained: Path, tmp_path: Path) -> None:
    plan = fabricated_plan()
    rollouts = [as_evaluation(rollout, ("ours-final",)) for rollout in fabricated_rollouts(plan, 2)]
    odd = [
        dataclasses.replace(
            r, interactions=(*r.interactions[:-1], dataclasses.replace(r.interactions[-1], method="theirs"))
        )
        for r in rollouts
    ]
    data = load_dataset(make_store(tmp_path / "store", odd, plan), TINY)
    with pytest.raises(StoreError, match="'theirs'"):
        evaluate(data, {1: read_policy_folder(trained / "aip")}, 1, (1,))
