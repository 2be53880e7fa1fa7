"""Training: each loss can be driven down, reaches what it should and nothing else, and survives a kill."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import nn

from cluster.cli.main import run
from learner.data import features
from learner.data.dataset import Dataset, load_dataset
from learner.data.features import MOST_ENCODERS, FrozenAap, FrozenFeatures, ProposalPool, frozen_features
from learner.data.sampling import Batch, order_rows
from learner.evaluation.curve import (
    Answers,
    Asked,
    Candidates,
    answer,
    curve_rows,
    proposal_gains,
    rows_of,
    tries_by_aip,
    tries_by_information,
)
from learner.evaluation.table import NO_TRIES_METHOD, PRIOR_METHOD, evaluate
from learner.settings import METRICS_FILE, AapConfig, AffordanceConfig, AipConfig, PriorConfig, TrainingConfig
from learner.stages import jobs
from learner.stages.aap import AapStage, OracleStage, SeenRows, predict
from learner.stages.affordance import AapCritic, AffordanceStage, AipCritic, Critic, PriorCritic
from learner.stages.aip import AipStage
from learner.stages.jobs import DONE_FILE, Memory, StageJob, read_policy_folder, run_stage
from learner.stages.oracle import OracleCritic, Teacher
from learner.stages.prior import PriorStage
from learner.training.checkpoint import Cursor
from learner.training.loop import CHECKPOINT_FILE, Stage, StepResult, rate_factor, train
from shared.errors import UsageError
from shared.io.files import TEMPORARY_PREFIX
from shared.networks.actions import outcome_details
from shared.networks.network_config import NetworkConfig
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.imagined_outcomes import SURE
from shared.policies.policy import WEIGHTS_FILE, Policy
from shared.types import Role
from tests.support.killed_writers import kill_while_writing
from tests.support.small_networks import TINY
from tests.support.small_trainings import (
    EVERYTHING,
    FAST,
    Killed,
    KilledError,
    descend,
    fabricated_plan,
    fabricated_rollouts,
    make_store,
)


def fresh(dataset: Dataset, seed: int = 0, config: NetworkConfig = TINY) -> tuple[Policy, FrozenFeatures]:
    policy = Policy.untrained("push", config, seed)
    return policy, FrozenFeatures.with_pool(dataset, np.random.default_rng(0))


Weights = dict[str, torch.Tensor]
"""Of a network, by name."""


@pytest.fixture(scope="module")
def aap_of_coins(coin_dataset: Dataset) -> Weights:
    """Of an AAP that has learnt to read a try, for all tests of what comes after it."""
    policy, known = fresh(coin_dataset)
    descend(AapStage(policy.aap, known, EVERYTHING, AapConfig(context=4, batch_rollouts=8)), 40)
    return {name: tensor.clone() for name, tensor in policy.aap.state_dict().items()}


def after_aap(dataset: Dataset, weights: Weights) -> tuple[Policy, FrozenFeatures]:
    policy, known = fresh(dataset)
    policy.aap.load_state_dict(weights)
    return policy, known


def test_each_loss_of_the_prior_can_be_driven_down(dataset: Dataset) -> None:
    policy, _ = fresh(dataset)
    config = PriorConfig(proposals=20, batch_clouds=3)
    before, after = descend(PriorStage(policy.prior, dataset, EVERYTHING, config), 80)
    assert after["critic"] < 0.3 * before["critic"]
    assert after["proposal"] < 0.5 * before["proposal"]


def test_aap_learns_to_read_a_try(coin_dataset: Dataset) -> None:
    policy, known = fresh(coin_dataset)
    stage = AapStage(policy.aap, known, EVERYTHING, AapConfig(context=4, batch_rollouts=8))
    descend(stage, 80)
    figures = stage.validate()
    assert figures["bce_after_4"] < 0.25
    assert figures["f_score_after_4"] > 0.9
    # Without a try the coin may only be guessed, unless the cloud is learnt by heart.
    assert figures["bce_after_0"] > 2 * figures["bce_after_4"]


@pytest.mark.parametrize(("detailed", "unknown"), [(True, 0.0), (True, 1.0), (False, 0.0)])
def test_aap_is_told_the_kind_of_an_outcome_where_it_is_not_left_out(
    coin_dataset: Dataset, detailed: bool, unknown: float
) -> None:
    rows, config = coin_dataset.rows, AapConfig(context=4, batch_rollouts=8, unknown_details=unknown)
    losses = []
    for kind, width in (("ok", 0.03), ("no-grasp", 0.0)):
        details = torch.from_numpy(outcome_details([kind] * len(rows), [width] * len(rows)))
        told = dataclasses.replace(coin_dataset, rows=dataclasses.replace(rows, details=details))
        policy, known = fresh(told, config=TINY.model_copy(update={"outcome_details": detailed}))
        loss = AapStage(policy.aap, known, EVERYTHING, config).loss(np.random.default_rng(7)).losses["critic"]
        losses.append(float(loss.detach()))
    assert (losses[0] != losses[1]) is (detailed and not unknown)


def test_the_oracle_knows_and_aap_learns_from_it(coin_dataset: Dataset) -> None:
    policy, _ = fresh(coin_dataset)
    critic = OracleCritic(policy.aap)
    config = AapConfig(training="privileged", context=4, batch_rollouts=8)
    oracle_stage = OracleStage(critic, coin_dataset, EVERYTHING, config)
    descend(oracle_stage, 60)
    assert oracle_stage.validate()["f_score"] > 0.95
    student, known = fresh(coin_dataset, 1)
    stage = AapStage(student.aap, known, EVERYTHING, config, Teacher.of(critic, known))
    before, after = descend(stage, 40)
    assert after["distillation"] < 0.5 * before["distillation"]


@pytest.mark.parametrize("training", ["paper", "inherited"])
def test_each_loss_of_aip_can_be_driven_down(
    coin_dataset: Dataset, aap_of_coins: Weights, training: Literal["paper", "inherited"]
) -> None:
    policy, known = after_aap(coin_dataset, aap_of_coins)
    frozen = FrozenAap.of(policy.aap, known)
    stage = AipStage(
        policy.aip, coin_dataset, EVERYTHING, AipConfig(training=training, batch_rollouts=4, draws=2), frozen
    )
    before, after = descend(stage, 100)
    # What a try will say is a coin itself, so that only the mean gain at each step can be learnt.
    assert after["critic"] < 0.75 * before["critic"]
    figures = stage.validate()
    assert figures["mean_gain"] > 0.01
    assert figures["critic"] < 1.1 * figures["critic_of_constant"]


def critics(policy: Policy, known: FrozenFeatures) -> dict[str, tuple[Critic, FrozenAap | None]]:
    """What supervises the D network of each module."""
    frozen = FrozenAap.of(policy.aap, known)
    policy.modules().eval().requires_grad_(False)
    return {
        "prior": (PriorCritic(policy.prior, ProposalPool.of(policy.prior, known)), None),
        "aap": (AapCritic(frozen, 5), frozen),
        "aip": (AipCritic(policy.aip, known.pool(policy.aip.encoder), frozen, 5), frozen),
    }


@pytest.mark.parametrize("loss", ["mean", "published"])
@pytest.mark.parametrize("module", ["prior", "aap", "aip"])
def test_an_affordance_network_follows_its_critic_and_nothing_else_moves(
    coin_dataset: Dataset, aap_of_coins: Weights, module: str, loss: Literal["mean", "published"]
) -> None:
    policy, known = after_aap(coin_dataset, aap_of_coins)
    critic, frozen = critics(policy, known)[module]
    config = AffordanceConfig(loss=loss, proposals=20, questions=640, points=64)
    pool, rng = ProposalPool.of(policy.prior, known), np.random.default_rng(0)
    stage = AffordanceStage(module, critic, coin_dataset, EVERYTHING, config, pool, rng, frozen)
    before = {name: tensor.clone() for name, tensor in policy.modules().state_dict().items()}
    descend(stage, 60)
    changed = {name for name, tensor in policy.modules().state_dict().items() if not torch.equal(tensor, before[name])}
    parts = {name.split(".")[1] for name in changed}
    assert {name.split(".")[0] for name in changed} == {module}
    assert parts == {"affordance_head", "place_encoder"} | ({"actionability_encoder"} if module == "aip" else set())
    figures = stage.validate()
    assert figures["affordance"] < figures["affordance_of_constant"]
    assert figures["affordance_rank_correlation"] > 0.5


def test_the_curve_falls_where_tries_tell_and_greedy_beats_chance(coin_dataset: Dataset, aap_of_coins: Weights) -> None:
    policy, known = after_aap(coin_dataset, aap_of_coins)
    frozen = FrozenAap.of(policy.aap, known)
    rollouts = EVERYTHING.validation
    candidates = Candidates.of(coin_dataset, rollouts, draws=2, seed=0)
    oracle = OracleCritic(policy.aap)
    answers = answer(known, candidates, frozen, policy.prior, policy.aip, oracle, (0, 1, 4))
    # Half of the 12 rows of two draws of each rollout, the same whatever was tried.
    assert len(answers.labels) == len(answers.objects) == len(rollouts) * 2 * 6
    rows = {(row.critic, row.tries): row for row in rows_of("coins", "", [answers])}
    assert list(rows) == [
        ("where2act", 0),
        *((critic, tries) for critic in ("random", "aip", "information") for tries in (0, 1, 4)),
        ("oracle", 0),
    ]
    assert rows["random", 1].bce < rows["random", 0].bce
    assert rows["random", 0].bce == rows["aip", 0].bce
    first, second = proposal_gains(known, candidates, frozen, policy.aip, 2)
    few = dataclasses.replace(candidates, count=1)
    assert len(proposal_gains(known, few, frozen, policy.aip)) == 1
    assert all(gain.greedy >= max(gain.random, gain.aip) for gain in (first, second))
    assert first.random > 0
    assert second.loss < first.loss


def test_gaps_are_closed_from_none_to_all_and_runs_pooled() -> None:
    labels = np.array([True, False, True, False])
    scores = {
        Asked("where2act", 0): [0.5, 0.5, 0.5, 0.5],
        Asked("random", 0): [0.6, 0.4, 0.6, 0.4],
        Asked("random", 1): [0.9, 0.1, 0.9, 0.1],
        Asked("oracle", 0): [0.9, 0.1, 0.9, 0.1],
    }
    answers = Answers(labels, np.array(["a", "a", "b", "c"]), {k: np.array(v) for k, v in scores.items()})
    rows = curve_rows("coins", [("seed-1", answers), ("seed-2", answers)])
    assert [row.run for row in rows] == [""] * 4 + ["seed-1"] * 4 + ["seed-2"] * 4
    prior, none, one, oracle = rows[:4]
    assert (prior.closed, one.closed, oracle.closed) == pytest.approx((0, 1, 1))
    assert (none.closed_from_none, one.closed_from_none) == pytest.approx((0, 1))
    assert none.closed == pytest.approx(np.log(0.5 / 0.6) / np.log(0.5 / 0.9))
    assert none.closed_low == pytest.approx(none.closed_high)
    assert (prior.questions, prior.objects, rows[4].questions) == (8, 3, 4)
    assert [row.bce for row in rows[:4]] == pytest.approx([row.bce for row in rows[4:8]])


def test_aip_chooses_each_candidate_once_and_the_best_by_its_critic(coin_dataset: Dataset) -> None:
    policy, known = fresh(coin_dataset)
    frozen = FrozenAap.of(policy.aap, known)
    candidates = Candidates.of(coin_dataset, EVERYTHING.validation, draws=1, seed=0)
    made = tries_by_aip(known, candidates.rows, frozen, policy.aip, candidates.count)
    assert torch.equal(made.sort(dim=1).values, candidates.rows.sort(dim=1).values)
    again = tries_by_aip(known, candidates.rows.flip(1), frozen, policy.aip, 2)
    assert torch.equal(again, made[:, :2])


def test_tries_by_information_move_beliefs_as_far_as_aap_expects(coin_dataset: Dataset, aap_of_coins: Weights) -> None:
    policy, known = after_aap(coin_dataset, aap_of_coins)
    frozen, aap, rows = FrozenAap.of(policy.aap, known), policy.aap, coin_dataset.rows
    candidates = Candidates.of(coin_dataset, EVERYTHING.validation, draws=1, seed=0).rows
    made = tries_by_information(candidates, frozen, 3)
    assert all(len(set(tries)) == 3 for tries in made.tolist())
    mine = candidates[0]
    asked = (frozen.features[mine], rows.xyz[mine], rows.frame[mine])

    def expected(row: int) -> float:
        """How far AAP expects its beliefs to move by one more try than the first."""
        before, total = made[0, :1], 0.0
        place = int((mine == row).nonzero())
        sure = (SURE, 1 - SURE)
        now = torch.sigmoid(aap.action_logits(*asked, frozen.latents(before)[-1])).double().clamp(*sure)
        odds = now[place]
        for success in (0.0, 1.0):
            motion = rows.motion[rows.success == success].median()
            told = (frozen.features[row], rows.xyz[row], rows.frame[row], motion, torch.tensor(success))
            code, weight = aap.interaction_codes(*(x[None] for x in told))
            z = aap.latent(torch.cat([frozen.codes[before], code]), torch.cat([frozen.weights[before], weight]))
            scores = torch.sigmoid(aap.action_logits(*asked, z)).double().clamp(*sure)
            moved = (scores * (scores / now).log() + (1 - scores) * ((1 - scores) / (1 - now)).log()).mean()
            total += float((odds if success else 1 - odds) * moved)
        return total

    with torch.no_grad():
        # All coins of a rollout tell the same, so that the best may be a tie.
        furthest = max(expected(row) for row in mine.tolist() if row != made[0, 0])
        assert expected(int(made[0, 1])) == pytest.approx(furthest, rel=1e-3)


def test_gains_are_differences_of_the_loss_on_the_same_rows(coin_dataset: Dataset) -> None:
    policy, known = fresh(coin_dataset)
    frozen = FrozenAap.of(policy.aap, known)
    stage = AipStage(policy.aip, coin_dataset, EVERYTHING, AipConfig(context=3), frozen)
    ordered = order_rows(coin_dataset, [0, 1], 12, np.random.default_rng(0))
    found = stage.gains(ordered)
    with torch.no_grad():
        logits = predict(policy.aap, SeenRows.of(Batch.of(coin_dataset, ordered), policy.aap.encoder), 3)[0]
    success = coin_dataset.rows.success[ordered.rows][:, None].expand_as(logits)
    losses = nn.functional.binary_cross_entropy_with_logits(logits, success, reduction="none")[..., 3:].mean(-1)
    torch.testing.assert_close(found.gains[..., 0], losses[:, :-1] - losses[:, 1:], rtol=1e-3, atol=1e-5)
    for k in range(3):
        torch.testing.assert_close(found.scores[:, k, 0], torch.sigmoid(logits[:, k, k]), rtol=1e-3, atol=1e-5)


def test_expected_gains_are_mean_divergences_over_both_outcomes_of_what_was_not_tried(coin_dataset: Dataset) -> None:
    policy, known = fresh(coin_dataset)
    frozen, aap, rows = FrozenAap.of(policy.aap, known), policy.aap, coin_dataset.rows
    stage = AipStage(policy.aip, coin_dataset, EVERYTHING, AipConfig(context=3, target="beliefs"), frozen)
    ordered = order_rows(coin_dataset, [0, 1], 7, np.random.default_rng(0))
    found = stage.gains(ordered)
    motions = {sense: float(rows.motion[(rows.success > 0) == sense].median()) for sense in (False, True)}

    def told(made: list[int], row: int, success: bool) -> torch.Tensor:
        given = (frozen.features[[row]], rows.xyz[[row]], rows.frame[[row]])
        outcome = torch.tensor([motions[success]]), torch.tensor([float(success)])
        code, weight = aap.interaction_codes(*given, *outcome)
        return aap.latent(torch.cat([frozen.codes[made], code]), torch.cat([frozen.weights[made], weight]))

    def believed(row: int, z: torch.Tensor) -> torch.Tensor:
        logits = aap.action_logits(frozen.features[[row]], rows.xyz[[row]], rows.frame[[row]], z)
        return torch.sigmoid(logits[0]).double()

    def worth(made: list[int], row: int, asked: list[int]) -> float:
        z, total = aap.latent(frozen.codes[made], frozen.weights[made]), 0.0
        odds = float(believed(row, z))
        for success, chance in ((True, odds), (False, 1 - odds)):
            after = told(made, row, success)
            for other in asked:
                p, q = believed(other, after), believed(other, z)
                moved = p * (p / q).log() + (1 - p) * ((1 - p) / (1 - q)).log()
                total += chance * float(moved) / len(asked)
        return total

    with torch.no_grad():
        for place in range(2):
            mine = ordered.rows[place].tolist()
            for k in range(3):
                assert found.mask[place, k].tolist() == [number >= k for number in range(7)]
                for number in range(k, 7):
                    expected = worth(mine[:k], mine[number], [row for row in mine[3:] if row != mine[number]])
                    assert float(found.gains[place, k, number]) == pytest.approx(expected, abs=1e-5)


def reached(stage: Stage, whole: nn.Module) -> set[str]:
    """Top-level parts of a module that a stage's loss sends a gradient to."""
    whole.zero_grad()
    torch.stack(list(stage.loss(np.random.default_rng(0)).losses.values())).sum().backward()
    return {name.split(".")[1] for name, p in whole.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}


@pytest.mark.parametrize("training", ["paper", "privileged"])
def test_gradients_reach_their_own_module_and_no_other(dataset: Dataset, training: str) -> None:
    policy, known = fresh(dataset)
    whole = nn.ModuleDict({"aap": policy.aap, "prior": policy.prior, "aip": policy.aip})
    stages = {
        "prior": PriorStage(policy.prior, dataset, EVERYTHING, PriorConfig(proposals=5)),
        "aap": AapStage(policy.aap, known, EVERYTHING, AapConfig(training=training)),
    }
    kept = {"affordance_head", "place_encoder"} | ({"encoder"} if training == "privileged" else set())
    for name, stage in stages.items():
        policy.prior.requires_grad_(name == "prior")
        of_this = kept if name == "aap" else kept - {"encoder"}
        learnt = {child for child, _ in getattr(policy, name).named_children()} - of_this
        assert reached(stage, whole) == learnt | ({"empty_latent"} if name == "aap" else set())
        others = [p for key, p in whole.named_parameters() if not key.startswith(name)]
        assert all(p.grad is None for p in others)
    before = {name: tensor.clone() for name, tensor in policy.aap.state_dict().items()}
    frozen = FrozenAap.of(policy.aap, known)
    aip = AipStage(policy.aip, dataset, EVERYTHING, AipConfig(), frozen)
    learnt = {child for child, _ in policy.aip.named_children()} - {
        "affordance_head",
        "place_encoder",
        "actionability_encoder",
    }
    assert reached(aip, whole) == learnt - {"encoder"}
    paper = AipStage(policy.aip, dataset, EVERYTHING, AipConfig(training="paper"), frozen)
    assert reached(paper, whole) == learnt
    descend(aip, 3)
    assert all(torch.equal(tensor, before[name]) for name, tensor in policy.aap.state_dict().items())
    assert all(p.grad is None for p in policy.aap.parameters())


def test_the_learning_rate_grows_and_falls_to_nothing_or_decays_as_published() -> None:
    cosine = [rate_factor(TrainingConfig(steps=200), step) for step in range(200)]
    top = int(np.argmax(cosine))
    assert 19 <= top <= 20
    assert cosine[:top] == sorted(cosine[:top])
    assert cosine[top:] == sorted(cosine[top:], reverse=True)
    assert max(cosine) == pytest.approx(1, abs=1e-3)
    assert cosine[-1] < 1e-3
    published = TrainingConfig(schedule="published")
    assert [rate_factor(published, step) for step in (0, 4999, 5000, 10_000)] == pytest.approx([1, 1, 0.9, 0.81])


@pytest.mark.parametrize("kills", [[5], [1, 1, 6], [0, 3]])
def test_a_killed_run_ends_with_the_bits_of_one_that_was_not(
    dataset: Dataset, tmp_path: Path, kills: list[int]
) -> None:
    config = TrainingConfig(steps=9, validate_every=2, checkpoint_seconds=0.0, decay_steps=3)
    results, weights, lines = [], [], []
    for name, deaths in (("whole", []), ("killed", kills)):
        out = tmp_path / name
        out.mkdir()
        for after in [*deaths, 10**6]:
            policy, _ = fresh(dataset)
            stage = AapStage(policy.aap, FrozenFeatures(dataset), EVERYTHING, AapConfig(context=3))
            try:
                results.append(train(Killed(stage, after), config, 3, out))
            except KilledError:
                with (out / METRICS_FILE).open("a", encoding="utf-8") as file:
                    file.write('{"step": 99')
                kill_while_writing(out / CHECKPOINT_FILE)
                continue
            weights.append(policy.to_files()[WEIGHTS_FILE])
        timeless = [json.loads(line) for line in (out / METRICS_FILE).read_text().splitlines()]
        lines.append([{k: v for k, v in line.items() if "second" not in k} for line in timeless])
        assert not list(out.glob(f"{TEMPORARY_PREFIX}*"))
    assert weights[0] == weights[1]
    assert lines[0] == lines[1]
    assert [dataclasses.replace(r, seconds=0.0) for r in results[:1]] == [
        dataclasses.replace(r, seconds=0.0) for r in results[1:]
    ]


def test_the_best_weights_are_kept_and_patience_ends_a_run(tmp_path: Path) -> None:
    class Wandering:
        name = "wandering"

        def __init__(self) -> None:
            self.module: nn.Module = nn.Linear(1, 1)
            self.scores = iter([3.0, 1.0, 2.0, 2.0, 2.0, 0.0])
            self.at_best: torch.Tensor | None = None

        def parameter_groups(self) -> list[object]:
            from learner.training.loop import ParameterGroup

            return [ParameterGroup(tuple(self.module.parameters()))]

        def loss(self, rng: np.random.Generator) -> StepResult:
            return StepResult({"x": self.module(torch.ones(1)).sum()}, 1)

        def validate(self) -> dict[str, float]:
            score = next(self.scores)
            if score == 1.0:
                self.at_best = next(self.module.parameters()).detach().clone()
            return {"score": score}

    stage = Wandering()
    result = train(stage, TrainingConfig(steps=100, validate_every=1, patience=3), 0, tmp_path)  # type: ignore[arg-type]
    assert (result.steps, result.best_step, result.metrics) == (5, 2, {"score": 1.0})
    assert stage.at_best is not None
    assert torch.equal(next(stage.module.parameters()), stage.at_best)


def test_a_cursor_survives_what_json_cannot_say() -> None:
    cursor = Cursor(best_metrics={"f": float("nan")}, step=3)
    assert np.isnan(Cursor.model_validate_json(cursor.model_dump_json()).best_metrics["f"])


@pytest.fixture(scope="module")
def trained(folder: Path, dataset: Dataset) -> Path:
    """Folders of all three stages, privileged AAP included."""
    privileged = FAST.model_copy(update={"aap": FAST.aap.model_copy(update={"training": "privileged"})})
    run_stage(StageJob("prior", folder / "store", folder / "prior"), FAST)
    run_stage(StageJob("aap", folder / "store", folder / "aap", folder / "prior"), privileged)
    run_stage(StageJob("aip", folder / "store", folder / "aip", folder / "aap"), FAST)
    return folder


def test_the_stages_end_in_a_policy_with_all_three_modules(trained: Path) -> None:
    policy = read_policy_folder(trained / "aip")
    assert policy.trained == {"prior", "aap", "aip"}
    assert (trained / "aap" / "oracle.safetensors").is_file()
    assert json.loads((trained / "aip" / DONE_FILE).read_text())["steps"] == 4
    before, after = (read_policy_folder(trained / name).modules().state_dict() for name in ("aap", "aip"))
    changed = {name.split(".")[0] for name, tensor in before.items() if not torch.equal(tensor, after[name])}
    assert changed <= {"aip"}


def test_a_finished_stage_is_not_run_again(trained: Path) -> None:
    stamp = (trained / "prior" / WEIGHTS_FILE).stat().st_mtime_ns
    run_stage(StageJob("prior", trained / "store", trained / "prior"), FAST)
    assert (trained / "prior" / WEIGHTS_FILE).stat().st_mtime_ns == stamp
    with pytest.raises(UsageError, match="other data or settings"):
        run_stage(StageJob("prior", trained / "store", trained / "prior"), FAST.model_copy(update={"seed": 1}))


def test_stages_of_one_process_make_the_same_and_read_and_encode_once(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads, encoded, memory = [], [], Memory()
    monkeypatch.setattr(jobs, "load_dataset", lambda *told: loads.append(told) or load_dataset(*told))
    monkeypatch.setattr(features, "frozen_features", lambda *told: encoded.append(told) or frozen_features(*told))
    privileged = FAST.model_copy(update={"aap": FAST.aap.model_copy(update={"training": "privileged"})})
    before: Path | None = None
    for stage, config in (("prior", FAST), ("aap", privileged), ("aip", FAST)):
        run_stage(StageJob(stage, trained / "store", tmp_path / stage, before), config, None, memory)
        before = tmp_path / stage
        assert (before / WEIGHTS_FILE).read_bytes() == (trained / stage / WEIGHTS_FILE).read_bytes()
    assert len(loads) == 1
    assert len(encoded) == 2, "the prior's encoder and AAP's, which is the oracle's"
    run_stage(
        StageJob("prior", trained / "store", tmp_path / "other"), FAST.model_copy(update={"seed": 1}), None, memory
    )
    assert len(loads) == 2, "another seed draws another pool"


def test_features_of_the_encoders_asked_for_last_are_remembered(dataset: Dataset) -> None:
    known = FrozenFeatures(dataset)
    encoders = [Policy.untrained("push", TINY, seed).prior.encoder.eval() for seed in range(MOST_ENCODERS + 1)]
    found = [known.rows(encoder) for encoder in encoders[:-1]]
    assert known.rows(encoders[0]) is found[0]
    known.rows(encoders[-1])
    assert known.rows(encoders[0]) is found[0], "asked for just before"
    again = known.rows(encoders[1])
    assert again is not found[1]
    assert torch.equal(again, found[1])


def test_a_checkpoint_of_another_run_is_refused(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained / "prior", tmp_path / "out")
    (tmp_path / "out" / DONE_FILE).unlink()
    (tmp_path / "out" / "checkpoint.safetensors").write_bytes(b"not one")
    assert run(["train", "prior", "--store", str(trained / "store"), "--out", str(tmp_path / "out")]) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["prior", "--store", "NOWHERE", "--out", "x"], "NOWHERE"),
        (["aap", "--store", "STORE", "--out", "x"], "--init"),
        (["aap", "--store", "STORE", "--out", "x", "--init", "NOWHERE"], "policy.json"),
        (["prior", "--store", "STORE", "--out", "x", "--train-objects", "NOWHERE"], "NOWHERE"),
        (["prior", "--store", "STORE", "--out", "x", "--config", "NOWHERE"], "NOWHERE"),
        (["aip", "--store", "STORE", "--out", "x", "--init", "PRIOR"], "aap is not trained"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    places = {"STORE": str(trained / "store"), "PRIOR": str(trained / "prior")}
    assert run(["train", *[places.get(argument, argument) for argument in arguments]]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_misspelt_setting_is_named(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.toml").write_text("[prior]\nlearning_rat = 1.0\n")
    arguments = ["prior", "--store", str(trained / "store"), "--out", str(tmp_path / "x")]
    assert run(["train", *arguments, "--config", str(tmp_path / "c.toml")]) == 2
    assert "did you mean 'learning_rate'" in capsys.readouterr().err


def as_evaluation(rollout: RolloutRecord) -> RolloutRecord:
    """Six queries, then two tries and one exploit of each of two methods."""
    labels = [("", Role.QUERY, -1)] * 6
    for method in ("ours-final", "ours-random"):
        labels += [(method, Role.CONTEXT, -1)] * 2 + [(method, Role.EXPLOIT, 2)]

    def labelled(interaction: InteractionRecord, method: str, role: Role, budget: int) -> InteractionRecord:
        return dataclasses.replace(interaction, method=method, role=role, budget=budget)

    rows = [labelled(i, *label) for i, label in zip(rollout.interactions, labels, strict=True)]
    return dataclasses.replace(rollout, interactions=tuple(rows))


def test_the_table_counts_what_was_tried(trained: Path, tmp_path: Path) -> None:
    plan = fabricated_plan()
    rollouts = [as_evaluation(rollout) for rollout in fabricated_rollouts(plan)]
    store = make_store(tmp_path / "store", rollouts, plan)
    policy = read_policy_folder(trained / "aip")
    data = load_dataset(store, TINY)
    table = {(row.method, row.budget): row for row in evaluate(data, {1: policy}, 1, (1, 2))}
    assert list(table) == [
        (PRIOR_METHOD, 0),
        (NO_TRIES_METHOD, 0),
        *((method, budget) for method in ("ours-random", "ours-final") for budget in (1, 2)),
    ]
    queries = [i.outcome.success for r in rollouts for i in r.interactions if i.role is Role.QUERY]
    for (method, budget), row in table.items():
        assert row.queries == len(queries)
        assert row.base_rate == pytest.approx(np.mean(queries))
        exploits = [i.outcome.success for r in rollouts for i in r.interactions if (i.method, i.budget) == (method, 2)]
        assert row.trials == (len(exploits) if budget == 2 else 0)
        if budget == 2:
            assert row.sample_success == pytest.approx(np.mean(exploits))
        assert row.mean_tries == budget
    assert table["ours-final", 1].bce != table["ours-final", 2].bce != table[NO_TRIES_METHOD, 0].bce
