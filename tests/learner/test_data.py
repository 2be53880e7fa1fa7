"""What the learner reads from a store, how it splits it, and how it measures."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.data.dataset import WAY_WIDTH, WAYS_WIDTH, Dataset, HiddenColumns, facts_of, load_dataset
from learner.data.sampling import Batch, draw_turns, order_rows, split, turn_facts
from learner.metrics import area_under_roc, best_f_score, calibration_error, discrimination, f_score
from learner.settings import AugmentationConfig
from learner.training.losses import (
    action_scoring_loss,
    distillation_loss,
    information_gains,
    masked_mean,
    proposal_loss,
    top_score,
)
from shared.config import DynamicsRanges
from shared.errors import StoreError, UsageError
from shared.geometry import view_from_world
from shared.hidden import ALWAYS_DRAWN
from shared.networks.actions import GRASP_SCALE, middle_of, orthonormal_frames, outcome_details
from shared.plan import RolloutRecord
from shared.store.store import Store
from shared.types import OutcomeKind
from tests.support.fabricate import fabricate_setting
from tests.support.small_networks import TINY
from tests.support.small_trainings import fabricated_plan, fabricated_rollouts, make_store


@pytest.fixture(scope="module")
def records() -> list[RolloutRecord]:
    return fabricated_rollouts(fabricated_plan())


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make_store(tmp_path_factory.mktemp("data") / "store"), TINY)


def test_every_cloud_is_there_once_and_every_row_in_the_view_frame(
    dataset: Dataset, records: list[RolloutRecord]
) -> None:
    assert len(dataset.clouds.points) == sum(len(r.observations) for r in records)
    assert len(dataset.rows) == sum(len(r.interactions) for r in records)
    for rollout, index in zip(records, dataset.rollouts, strict=True):
        for interaction, row in zip(rollout.interactions, index.tolist(), strict=True):
            view = view_from_world(rollout.observations[interaction.observation].world_from_camera)
            cloud = dataset.clouds.points[dataset.rows.cloud[row]]
            middle = cloud[dataset.movable[dataset.rows.cloud[row]]].mean(dim=0)
            torch.testing.assert_close(cloud[dataset.rows.point[row]] - middle, dataset.rows.xyz[row])
            np.testing.assert_allclose(dataset.rows.xyz[row] + middle, view @ interaction.action.point, atol=1e-6)
            expected = np.concatenate([view @ interaction.action.approach, view @ interaction.action.forward])
            np.testing.assert_allclose(dataset.rows.frame[row], expected, atol=1e-6)
            assert bool(dataset.rows.success[row]) == interaction.outcome.success


def test_rows_have_the_kind_and_the_grasp_width_of_their_outcome(tmp_path: Path, records: list[RolloutRecord]) -> None:
    first, second, *others = records[0].interactions
    held = dataclasses.replace(first, outcome=dataclasses.replace(first.outcome, grasp_opening=0.03))
    changed = [dataclasses.replace(records[0], interactions=(held, second, *others)), *records[1:]]
    loaded = load_dataset(make_store(tmp_path / "store", changed), TINY)
    outcomes = [interaction.outcome for record in changed for interaction in record.interactions]
    told = outcome_details([one.kind for one in outcomes], [one.grasp_opening for one in outcomes])
    np.testing.assert_array_equal(loaded.rows.details[torch.cat(loaded.rollouts)], told)
    assert loaded.rows.details[loaded.rollouts[0][0], -2:].tolist() == pytest.approx([1.0, 0.03 * GRASP_SCALE])


def test_failed_infrastructure_is_no_label(tmp_path: Path, records: list[RolloutRecord]) -> None:
    first = records[0].interactions[0]
    lost = dataclasses.replace(first.outcome, kind=OutcomeKind.ABANDONED, success=False, motion=0.0)
    kept = (dataclasses.replace(first, outcome=lost), *records[0].interactions[1:])
    changed = [dataclasses.replace(records[0], interactions=kept), *records[1:]]
    loaded = load_dataset(make_store(tmp_path / "store", changed), TINY)
    assert len(loaded.rollouts[0]) == len(records[0].interactions) - 1
    assert int(loaded.rows.step[loaded.rollouts[0]].min()) == 1


def test_an_empty_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no interaction to learn from"):
        load_dataset(Store.create(tmp_path / "store", fabricate_setting(points=64)), TINY)


def test_no_object_is_on_both_sides(dataset: Dataset) -> None:
    parts = split(dataset, None, None)
    sides = [{dataset.objects[k] for k in side} for side in (parts.train, parts.validation)]
    assert sides[0]
    assert sides[1]
    assert not sides[0] & sides[1]
    assert sides[0] | sides[1] == set(dataset.objects)
    assert split(dataset, {"object-1"}, {"object-2"}).train == dataset.rollouts_of({"object-1"})
    with pytest.raises(UsageError, match="object-1"):
        split(dataset, {"object-1", "object-2"}, {"object-1"})
    with pytest.raises(UsageError, match="for validation"):
        split(dataset, {"object-1"}, {"unheard-of"})


@given(st.integers(0, 10_000), st.integers(1, 14), st.integers(0, 9))
@settings(max_examples=40)
def test_context_and_questions_never_overlap(dataset: Dataset, seed: int, size: int, limit: int) -> None:
    ordered = order_rows(dataset, [0, 3, 3, 5], size, np.random.default_rng(seed))
    context = ordered.longest_context(limit)
    asked = ordered.asked(context)
    for number, rollout in enumerate([0, 3, 3, 5]):
        rows = ordered.rows[number][ordered.valid[number]].tolist()
        assert len(set(rows)) == len(rows) == min(size, 12)
        assert set(rows) <= set(dataset.rollouts[rollout].tolist())
        for prefix in range(context + 1):
            questions = ordered.rows[number][asked[number, prefix]].tolist()
            assert not set(questions) & set(rows[:prefix])
            assert set(questions) | set(rows[:prefix]) == set(rows)
    assert torch.equal(ordered.clouds[ordered.cloud], dataset.rows.cloud[ordered.rows])


def test_continued_tries_come_first_in_their_own_order(dataset: Dataset) -> None:
    continued = torch.zeros(len(dataset.rows), dtype=torch.bool)
    tries = dataset.rollouts[2][[1, 5, 7]]
    continued[tries] = True
    marked = dataclasses.replace(dataset, rows=dataclasses.replace(dataset.rows, continued=continued))
    ordered = order_rows(marked, [2], 12, np.random.default_rng(0), continued_first=1.0)
    assert ordered.rows[0, :3].tolist() == tries.tolist()
    assert sorted(ordered.rows[0].tolist()) == sorted(dataset.rollouts[2].tolist())


def hidden_of(axis: np.ndarray, through: np.ndarray, room: tuple[float, float] = (2.0, 0.0)) -> HiddenColumns:
    """One row whose part turns about `axis` through a point."""
    return HiddenColumns(
        twist=np.concatenate([axis, np.cross(through, axis)])[None],
        room=np.array([room]),
        dynamics={name: np.ones(1) for name in ALWAYS_DRAWN},
        ranges=DynamicsRanges(),
        view=np.eye(3)[None],
        middle=np.zeros((1, 3)),
    )


def ways_of(hidden: HiddenColumns) -> np.ndarray:
    """Room and twist of both ways, [2, WAY_WIDTH]."""
    return facts_of(hidden)[0, -WAYS_WIDTH:].reshape(2, WAY_WIDTH)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("side", [-0.4, 0.4])
def test_facts_tell_a_hinges_side_and_the_ways_it_may_turn(side: float, sign: float) -> None:
    axis, through = np.array([0, 0, sign]), np.array([-0.45, side, 0.0])
    ways = ways_of(hidden_of(axis, through))
    # The way about +z comes first; a joint that may only turn the other way has no room there.
    free, shut = (0, 1) if sign > 0 else (1, 0)
    np.testing.assert_allclose(ways[free], [2.0, *axis, *np.cross(through, axis)])
    assert (ways[shut] == 0).all()


def test_facts_do_not_depend_on_which_way_a_file_counts_a_joint() -> None:
    axis, through = np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.3, 0.0])
    one, other = hidden_of(axis, through, (2.0, 0.5)), hidden_of(-axis, through, (0.5, 2.0))
    np.testing.assert_allclose(facts_of(one), facts_of(other), atol=1e-6)


def test_facts_tell_the_same_motion_from_any_middle() -> None:
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3))
    hidden = hidden_of(np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.3, 0.0]))
    middle = np.array([0.2, -0.4, 0.3])
    (w, v), (same, moved) = (
        ways_of(one)[0, 1:].reshape(2, 3) for one in (hidden, dataclasses.replace(hidden, middle=middle[None]))
    )
    np.testing.assert_allclose(np.cross(same, points - middle) + moved, np.cross(w, points) + v, atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
def test_facts_turn_as_the_object_does(mirrored: bool) -> None:
    rng = np.random.default_rng(2)
    turn = draw_turns(1, AugmentationConfig(mirror=False, turn_deg=60.0), rng)
    if mirrored:
        turn = turn @ torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    matrix = turn[0].double().numpy()
    axis, through = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.3, 0.0])
    # A mirrored hinge turns the other way round its mirrored axis.
    seen = hidden_of(np.linalg.det(matrix) * (matrix @ axis), matrix @ through)
    before = torch.from_numpy(facts_of(hidden_of(axis, through)).astype(np.float32))[None]
    np.testing.assert_allclose(turn_facts(turn, before)[0].numpy(), facts_of(seen), atol=1e-5)


def test_turns_keep_the_vertical_and_all_lengths() -> None:
    turns = draw_turns(50, AugmentationConfig(), np.random.default_rng(0))
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(50, 3, 3))
    assert (turns[:, 2] == torch.tensor([0.0, 0.0, 1.0])).all()
    assert set(torch.linalg.det(turns).round().tolist()) == {-1.0, 1.0}


def test_a_batch_is_turned_as_one(dataset: Dataset) -> None:
    ordered = order_rows(dataset, [0, 1, 2], 12, np.random.default_rng(0))
    turns = draw_turns(3, AugmentationConfig(turn_deg=90.0), np.random.default_rng(3))
    batch = Batch.of(dataset, ordered, turns)
    plain = Batch.of(dataset, ordered)
    # A row's point is still the point of its cloud that it names.
    middles = middle_of(batch.clouds.points, dataset.movable[ordered.clouds])
    torch.testing.assert_close(batch.clouds.points[batch.cloud, batch.point] - middles[batch.cloud], batch.xyz)
    for one, other in ((batch.frame[..., :3], plain.frame[..., :3]), (batch.xyz, plain.xyz)):
        torch.testing.assert_close(one.norm(dim=-1), other.norm(dim=-1))
    along, before = ((b.xyz * b.frame[..., :3]).sum(-1) for b in (batch, plain))
    torch.testing.assert_close(along, before)


def test_metrics_of_an_example_worked_by_hand() -> None:
    scores, labels = [0.9, 0.6, 0.4, 0.2], [True, False, True, False]
    found = discrimination(scores, labels)
    assert found.f_score == pytest.approx(2 * 1 / (2 + 2))  # One hit, two claims, two successes.
    assert found.best_f_score == pytest.approx(2 * 2 / (3 + 2))  # At 0.4: two hits, three claims.
    assert found.auc == pytest.approx(3 / 4)  # Of four pairs, only (0.4, 0.6) is the wrong way round.
    assert found.bce == pytest.approx(-np.mean(np.log([0.9, 0.4, 0.4, 0.8])))
    assert (found.base_rate, found.rows) == (0.5, 4)


def test_metrics_know_what_is_not_defined() -> None:
    nothing = discrimination([], [])
    assert np.isnan([nothing.f_score, nothing.best_f_score, nothing.bce, nothing.auc, nothing.base_rate]).all()
    assert np.isnan(area_under_roc(np.array([0.1, 0.2]), np.array([True, True])))


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), min_size=2, max_size=20))
@settings(max_examples=60)
def test_metrics_agree_with_trying_everything(rows: list[tuple[int, bool]]) -> None:
    scores, labels = np.array([s / 4 for s, _ in rows]), np.array([r for _, r in rows])
    if labels.any():
        best = max(f_score(scores >= threshold, labels) for threshold in set(scores))
        assert best_f_score(scores, labels) == pytest.approx(best)
    if labels.any() and not labels.all():
        pairs = [(a > b) + 0.5 * (a == b) for a in scores[labels] for b in scores[~labels]]
        assert area_under_roc(scores, labels) == pytest.approx(np.mean(pairs))


def test_losses_of_examples_worked_by_hand() -> None:
    logits = torch.tensor([[0.0, 2.0]])
    mask = torch.tensor([[True, False]])
    assert action_scoring_loss(logits, torch.ones(1, 2), mask).item() == pytest.approx(np.log(2))
    assert information_gains(torch.tensor([0.9, 0.5, 0.6])).tolist() == pytest.approx([0.4, -0.1])
    assert top_score(torch.tensor([[0.1, 0.9, 0.5]]), 2).item() == pytest.approx(0.7)
    assert masked_mean(torch.tensor([np.nan, 2.0]), torch.tensor([False, True])).item() == 2.0
    assert masked_mean(torch.ones(2), torch.zeros(2, dtype=torch.bool)).item() == 0.0
    same = torch.randn(3, 1, 4)
    assert distillation_loss(same.expand(3, 2, 4), same[:, 0], torch.ones(3, 2, dtype=torch.bool)).item() == 0.0


def test_the_proposal_loss_is_that_of_the_best_draw() -> None:
    draws = orthonormal_frames(torch.randn(2, 5, 6, generator=torch.Generator().manual_seed(0)))
    assert proposal_loss(draws, draws[:, 3]).item() == pytest.approx(0.0, abs=3e-3)
    assert proposal_loss(draws[:0], draws[:0, 0]).item() == 0.0


@given(st.integers(1, 40), st.integers(0, 40), st.floats(0.0, 1.0))
def test_a_constant_is_off_by_its_distance_from_the_base_rate(failures: int, successes: int, score: float) -> None:
    labels = np.array([False] * failures + [True] * successes)
    found = calibration_error(np.full(len(labels), score), labels)
    assert found == pytest.approx(abs(score - labels.mean()))


def test_scores_that_come_true_are_calibrated() -> None:
    rng = np.random.default_rng(0)
    scores = rng.random(20_000)
    labels = rng.random(20_000) < scores
    assert calibration_error(scores, labels) < 0.02
    assert calibration_error(1.0 - scores, labels) > 0.4
    assert np.isnan(calibration_error(np.zeros(0), np.zeros(0, dtype=bool)))
