"""The learnt baselines: trained like every other network, and judged with all methods in one table."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from learner.data.dataset import Dataset, load_dataset
from learner.data.features import FrozenFeatures, FrozenPrior
from learner.evaluation.table import NO_TRIES_METHOD, ORACLE_METHOD, PRIOR_METHOD, evaluate, evaluate_store
from learner.settings import AdaptationConfig, InteractionConfig, LearnerConfig, TrainingConfig
from learner.stages.jobs import StageJob, read_policy_folder, run_stage
from learner.stages.oracle import OracleCritic, Teacher, read_oracle
from learner.stages.prior import PriorStage
from learner.stages.trainers import ORACLE_FILE, row_critic
from learner.stages.where2act_adaptation import AdaptationStage
from learner.stages.where2act_interaction import InteractionStage
from learner.training.loop import train
from shared.errors import StoreError, UsageError
from shared.networks.aap import Aap
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.adaptation import Adapter
from shared.policies.critics import critic_named
from shared.policies.methods import METHODS, BaselineName
from shared.policies.policy import Policy
from shared.policies.where2act_interaction import TRIES
from shared.types import Interaction, Role
from tests.support.small_networks import TINY
from tests.support.small_policies import BASELINES, CRITICS, policy_with_all
from tests.support.small_trainings import (
    EVERYTHING,
    FAST,
    QUICK,
    Killed,
    KilledError,
    descend,
    fabricated_plan,
    fabricated_rollouts,
    make_store,
)

ALL = FAST.model_copy(
    update={
        "interaction": InteractionConfig(steps=4, validate_every=2, affordance=QUICK),
        "adaptation": AdaptationConfig(steps=4, validate_every=2),
    }
)


def stage_of(name: BaselineName, dataset: Dataset, policy: Policy) -> InteractionStage | AdaptationStage:
    policy.begin_baseline(name, 0)
    policy.modules().requires_grad_(False)
    prior = FrozenPrior.of(policy.prior.eval(), FrozenFeatures(dataset))
    if name == "where2act-interaction":
        assert policy.baselines["where2act-interaction"] is not None
        network = policy.baselines["where2act-interaction"].requires_grad_(True)
        return InteractionStage(network, dataset, EVERYTHING, InteractionConfig(batch_rollouts=8), prior)
    assert policy.baselines["where2act-adaptation"] is not None
    similarities = policy.baselines["where2act-adaptation"].requires_grad_(True)
    return AdaptationStage(similarities, dataset, EVERYTHING, AdaptationConfig(batch_rollouts=8), prior)


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


@pytest.mark.parametrize("name", BASELINES)
def test_a_killed_baseline_ends_with_the_bits_of_one_that_was_not(
    dataset: Dataset, tmp_path: Path, name: BaselineName
) -> None:
    config = TrainingConfig(steps=5, validate_every=2, checkpoint_seconds=0.0)
    weights = []
    for run, deaths in (("whole", []), ("killed", [3])):
        (tmp_path / run).mkdir()
        policy = Policy.untrained("push", TINY, 0)
        for after in [*deaths, 10**6]:
            stage = stage_of(name, dataset, policy)
            with contextlib.suppress(KilledError):
                train(Killed(stage, after), config, 3, tmp_path / run)
        weights.append(policy.modules()[name].state_dict())
    assert all(torch.equal(tensor, weights[1][key]) for key, tensor in weights[0].items())


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
        run_stage(StageJob(stage, folder / "store", folder / stage, before), ALL)
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
        for place in range(4, 8) if METHODS.get(method).tries is not None else ():
            add(place, Role.CONTEXT, method)
        add(8, Role.EXPLOIT, method, 4)
    return dataclasses.replace(rollout, interactions=tuple(rows))


def test_the_table_has_a_row_for_every_method(trained: Path, tmp_path: Path) -> None:
    plan, methods = fabricated_plan(), tuple(METHODS.names())
    rollouts = [as_evaluation(rollout, methods) for rollout in fabricated_rollouts(plan, 3)]
    store = make_store(tmp_path / "store", rollouts, plan)
    final, first = read_policy_folder(trained / BASELINES[-1]), policy_with_all(seed=9)
    store.publish_policy(2, final.to_files())
    with pytest.raises((StoreError, UsageError)):
        evaluate_store(store, 2, (2, 4))
    store.publish_policy(1, first.to_files())
    oracle = read_oracle(trained / "aap" / ORACLE_FILE, TINY)
    table = {(row.method, row.budget): row for row in evaluate_store(store, 2, (2, 4), oracle)}
    adapted = [name for name in METHODS.names() if name != PRIOR_METHOD]
    assert list(table) == [
        *((name, 0) for name in (PRIOR_METHOD, NO_TRIES_METHOD, ORACLE_METHOD)),
        *((name, budget) for name in adapted for budget in METHODS.get(name).budgets((2, 4))),
    ]
    assert all(np.isfinite(row.bce) and row.queries == 12 for row in table.values())
    assert all(row.trials == 3 for (name, budget), row in table.items() if budget == 4)
    assert table[ORACLE_METHOD, 0].trials == table[NO_TRIES_METHOD, 0].trials == 0
    # All methods made the same tries: those that share critic and policy agree, and no others.
    # Up to rounding, since some builds of PyTorch sum a row of a batch according to its place.
    assert table["ours-fps", 4].bce == pytest.approx(table["ours-final", 4].bce, rel=1e-6)
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
        stored = row_critic(name, policy, FrozenFeatures(dataset))(index[5:6], index[:4])
        np.testing.assert_allclose(seen, stored.numpy(), atol=1e-4, err_msg=name)


def test_an_oracle_comes_back_and_a_hostile_one_is_refused(trained: Path, dataset: Dataset, tmp_path: Path) -> None:
    path = trained / "aap" / ORACLE_FILE
    oracle = read_oracle(path, TINY)
    assert isinstance(oracle, OracleCritic)
    scores = Teacher.of(oracle, FrozenFeatures(dataset)).scores[:5]
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
    torch.testing.assert_close(stage.scores(index), FrozenPrior.of(policy.prior, FrozenFeatures(dataset)).scores[index])


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
