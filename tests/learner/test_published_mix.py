"""The published mix of rows: weights by hand and by law, the shift of the base rate, and the figures of a store."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.data.dataset import load_dataset
from learner.data.features import FrozenFeatures
from learner.evaluation.table import PRIOR_METHOD, evaluate_store
from learner.metrics import PULL_MIX, PUSH_MIX, RowMix, f_score, mix_for, shifted_threshold
from learner.stages.trainers import row_critic
from shared.errors import UsageError
from shared.plan import InteractionRecord, Job, Plan, RolloutRecord
from shared.policies.policy import Policy
from shared.store import Store
from shared.types import OutcomeKind, Role
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.small_networks import TINY

RATES = st.floats(0.001, 0.999)


def test_row_weights_of_one_pull_rollout_are_those_computed_by_hand() -> None:
    success = np.array([True, False, False, False, True])
    valid = np.array([True, True, True, False, True])
    # 7 rows of 2 successes, 8 of 4 held grasps, 17 of 5 interactions.
    both, held, missed = 7 / 2 + 8 / 4 + 17 / 5, 8 / 4 + 17 / 5, 17 / 5
    assert PULL_MIX.weights(success, valid) == pytest.approx([both, held, held, missed, both])
    assert PUSH_MIX.weights(success, valid)[0] == pytest.approx(10 / 2 + 10 / 4 + 12 / 5)


@given(st.sampled_from([PULL_MIX, PUSH_MIX]), st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40))
def test_row_weights_sum_to_the_published_rows_and_rank_by_label(mix: RowMix, rows: list[tuple[bool, bool]]) -> None:
    success, held = (np.array([row[k] for row in rows], dtype=bool) for k in (0, 1))
    weights = mix.weights(success, held)
    if not success.any():
        assert not weights.any()  # The published scripts drop such a rollout.
        return
    assert weights.sum() == pytest.approx(mix.rows) == pytest.approx(32)
    for best, next_best in ((success, held & ~success), (held, ~held & ~success)):
        if best.any() and next_best.any():
            assert weights[best].min() > weights[next_best].max()


def test_mix_for_a_primitive_follows_its_fingers() -> None:
    assert mix_for("pull") == mix_for("pull-up") == PULL_MIX
    assert mix_for("push") == mix_for("push-left") == PUSH_MIX
    with pytest.raises(UsageError, match="unknown primitive 'shove'"):
        mix_for("shove")


@given(RATES, RATES, st.floats(0.001, 0.999))
def test_shifted_threshold_is_where_the_shifted_logit_crosses_zero(old: float, new: float, score: float) -> None:
    shift = np.log(new / (1 - new)) - np.log(old / (1 - old))
    logit = np.log(score / (1 - score)) + shift
    if abs(logit) > 1e-6:
        assert (score >= shifted_threshold(old, new)) == (logit > 0)
    assert shifted_threshold(old, old) == pytest.approx(0.5)


def test_shifted_threshold_where_nothing_fails_or_nothing_was_weighted() -> None:
    assert shifted_threshold(1.0, 1.0) == 0.5
    assert shifted_threshold(0.3, 1.0) == 0.0
    assert np.isnan(shifted_threshold(0.0, float("nan")))


@pytest.mark.parametrize(("kind", "valid"), [(kind, kind.value in ("ok", "no-contact")) for kind in OutcomeKind])
def test_valid_outcomes_are_those_whose_primitive_ran_to_its_end(kind: OutcomeKind, valid: bool) -> None:
    assert kind.is_valid == valid


def store_of_queries(path: Path, task: str, successes: bool = True) -> tuple[Store, list[RolloutRecord]]:
    """An evaluation store of nothing but queries; in the second rollout none succeeds, or in none does."""
    setting = fabricate_setting(points=64).model_copy(update={"task": task})
    plan = Plan(setting=setting, proposer="evaluation", policy_version=1)
    job = Job(plan.key, 0, 4)
    rollouts = []
    for record in fabricate_rollouts(plan, job, interactions=16):
        rows = [row for row in record.interactions if not row.outcome.success or (successes and record.index != 1)]
        rollouts.append(as_queries(record, rows))
    store = Store.create(path, setting)
    store.commit(plan, job, rollouts, {})
    store.publish_policy(1, policy(task).to_files())
    return store, rollouts


def as_queries(record: RolloutRecord, rows: list[InteractionRecord]) -> RolloutRecord:
    queries = (replace(row, step=step, role=Role.QUERY) for step, row in enumerate(rows))
    return replace(record, interactions=tuple(queries))


def policy(task: str) -> Policy:
    return Policy.untrained(task, TINY, seed=2).with_trained("prior").with_trained("aap")


@pytest.mark.parametrize("task", ["push", "pull"])
def test_table_weighs_stored_queries_as_the_published_rows(tmp_path: Path, task: str) -> None:
    store, rollouts = store_of_queries(tmp_path / "store", task)
    prior = next(row for row in evaluate_store(store, 1, (1,)) if row.method == PRIOR_METHOD)
    mix = PULL_MIX if task == "pull" else PUSH_MIX
    kinds = [[row.outcome for row in record.interactions] for record in rollouts]
    success = [np.array([outcome.success for outcome in own]) for own in kinds]
    valid = [np.array([outcome.kind in (OutcomeKind.OK, OutcomeKind.NO_CONTACT) for outcome in own]) for own in kinds]
    weights = np.concatenate([mix.weights(*pair) for pair in zip(success, valid, strict=True)])
    true = np.concatenate(success)
    assert weights.sum() == pytest.approx(32 * 3)  # One of four rollouts has no success.
    assert prior.mix_base_rate == pytest.approx(weights[true].sum() / weights.sum())
    assert prior.base_rate == pytest.approx(true.mean())
    scores = scores_of(store)
    for figure, threshold in (
        (prior.mix_f_score, 0.5),
        (prior.shifted_f_score, shifted_threshold(true.mean(), prior.mix_base_rate)),
    ):
        claimed = scores >= threshold
        below = weights[claimed].sum() + weights[true].sum()
        assert figure == pytest.approx(2 * weights[claimed & true].sum() / below)
    assert prior.shifted_f_score_low <= prior.shifted_f_score <= prior.shifted_f_score_high
    # The natural figures are of all rows alike.
    assert prior.f_score == pytest.approx(f_score(scores >= 0.5, true))
    assert sum(prior.counts.mix_true) == pytest.approx(weights[true].sum())
    assert sum(prior.counts.queries) == len(true)


def scores_of(store: Store) -> np.ndarray:
    """Where2Act's scores of all queries, in order of rollout and step."""
    dataset = load_dataset(store, TINY)
    critic = row_critic("where2act", policy(store.setting.task), FrozenFeatures(dataset))
    return np.concatenate([critic(index, index[:0]).numpy() for index in dataset.rollouts])


def test_table_counts_exploits_by_share_and_repeats_apart_from_all_others(tmp_path: Path) -> None:
    """Of one rollout in four rows: a query, an exploit, one by share, and a repeat."""
    setting = fabricate_setting(points=64)
    plan = Plan(setting=setting, proposer="evaluation", policy_version=1)
    roles, rollouts = (Role.QUERY, Role.EXPLOIT, Role.EXPLOIT_BY_SHARE, Role.REPEAT_AT_START), []
    for record in fabricate_rollouts(plan, Job(plan.key, 0, 6), interactions=4):
        pairs = zip(record.interactions, roles, strict=True)
        rows = [replace(row, role=role, method="" if role is Role.QUERY else PRIOR_METHOD) for row, role in pairs]
        rollouts.append(replace(record, interactions=tuple(rows)))
    for name, kept in (("all", 4), ("natural", 2)):
        store = Store.create(tmp_path / name, setting)
        own = [replace(record, interactions=record.interactions[:kept]) for record in rollouts]
        store.commit(plan, Job(plan.key, 0, 6), own, {})
        store.publish_policy(1, policy("push").to_files())
        prior = evaluate_store(store, 1, (1,))[0]
        success = [[row.outcome.success for row in record.interactions] for record in own]
        assert prior.sample_success == pytest.approx(np.mean([row[1] for row in success]))
        if name == "all":
            assert prior.share_success == pytest.approx(np.mean([row[2] for row in success]))
            assert prior.repeat_success == pytest.approx(np.mean([row[3] for row in success]))
            assert sum(prior.counts.share_trials) == sum(prior.counts.repeat_trials) == 6
        else:
            assert prior.share_success is prior.repeat_success is None
            assert prior.counts.share_trials == prior.counts.repeat_trials == ()


def test_table_without_any_success_has_no_figure_of_the_published_mix(tmp_path: Path) -> None:
    store, _ = store_of_queries(tmp_path / "store", "push", successes=False)
    prior = evaluate_store(store, 1, (1,))[0]
    figures = (prior.mix_f_score, prior.shifted_f_score, prior.mix_base_rate, prior.mix_f_score_low)
    assert figures == (None,) * 4
    assert prior.queries > 0
