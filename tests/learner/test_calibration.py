"""Calibration: it finds a known shift and scale, leaves what is right, and judges by objects that it has not seen."""

import json
from pathlib import Path

import numpy as np
import pytest

from adaafford.pretrained import load_policy
from cluster.cli.main import run
from cluster.reporting.model_card import write_export
from learner.calibration import (
    MIN_SCALE,
    STRENGTHS,
    CalibratedCritic,
    CriticRows,
    Fit,
    calibrate,
    check,
    chosen_strength,
    critic_rows,
    fit_logits,
    held_out,
)
from learner.data.dataset import load_dataset
from learner.metrics import cross_entropy
from learner.stages.jobs import objects_seen
from shared.errors import UsageError
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.store.store import Store
from shared.types import Float
from tests.support.killed_writers import kill_while_writing
from tests.support.small_policies import policy_of
from tests.support.small_trainings import fabricated_plan, fabricated_rollouts, make_store

WEIGHTS = np.array([1.0, -2.0, 0.5, 0.3])


def sigmoid(logits: Float) -> Float:
    return 1.0 / (1.0 + np.exp(-logits))


def made_up(scale: float = 1.0, shift: float = 0.0, objects: int = 6, each: int = 600, seed: int = 0) -> CriticRows:
    """Questions whose successes are as likely as `scale` times the critic's logit and `shift` say."""
    rng = np.random.default_rng(seed)
    inputs = np.concatenate([rng.normal(size=(objects * each, 3)), np.ones((objects * each, 1))], axis=1)
    labels = rng.random(len(inputs)) < sigmoid(scale * inputs @ WEIGHTS + shift)
    names = np.array([f"object-{number}" for number in range(objects)]).repeat(each)
    return CriticRows(inputs, WEIGHTS, labels, names, np.zeros(len(inputs), np.int64))


@pytest.mark.parametrize(("scale", "shift"), [(0.4, -0.8), (1.7, 0.6), (1.0, 1.5)])
def test_a_known_scale_and_shift_are_found(scale: float, shift: float) -> None:
    rows = made_up(scale, shift)
    design, start = rows.design("scale")
    found = fit_logits(design, rows.labels, start, 1.0)
    assert found == pytest.approx([scale, shift], abs=0.15)
    logits = held_out(rows, "scale")
    assert cross_entropy(sigmoid(logits), rows.labels) < cross_entropy(sigmoid(rows.logits), rows.labels) - 0.005


def test_a_known_change_of_the_last_layer_is_found() -> None:
    rng, rows = np.random.default_rng(1), made_up()
    true = WEIGHTS + np.array([0.0, 1.5, 0.0, -0.5])
    labels = rng.random(len(rows.labels)) < sigmoid(rows.inputs @ true)
    changed = CriticRows(rows.inputs, WEIGHTS, labels, rows.objects, rows.interactions)
    design, start = changed.design("last-layer")
    assert fit_logits(design, labels, start, 1.0) == pytest.approx(true, abs=0.2)


@pytest.mark.parametrize("fit", ["scale", "last-layer"])
def test_a_calibrated_critic_stays_as_it_is(fit: Fit) -> None:
    rows = made_up()
    design, start = rows.design(fit)
    fitted = fit_logits(design, rows.labels, start, chosen_strength(rows, fit))
    assert fitted == pytest.approx(start, abs=0.15)
    assert fit_logits(design, rows.labels, start, STRENGTHS[-1]) == pytest.approx(start, abs=1e-4)
    after, before = sigmoid(held_out(rows, fit)), sigmoid(rows.logits)
    assert cross_entropy(after, rows.labels) == pytest.approx(cross_entropy(before, rows.labels), abs=3e-3)


def test_a_critic_that_ranks_worse_than_chance_is_not_turned_round() -> None:
    rows = made_up(scale=-1.0)
    design, start = rows.design("scale")
    assert fit_logits(design, rows.labels, start, 1.0)[0] == pytest.approx(MIN_SCALE, abs=1e-6)


@pytest.mark.parametrize("fit", ["scale", "last-layer"])
def test_held_out_figures_do_not_depend_on_what_they_judge(fit: Fit) -> None:
    rows = made_up(0.5, -1.0, objects=4, each=60)
    mine = rows.objects == "object-2"
    turned = CriticRows(rows.inputs, rows.weights, rows.labels ^ mine, rows.objects, rows.interactions)
    before, after = held_out(rows, fit), held_out(turned, fit)
    assert np.array_equal(before[mine], after[mine])
    assert not np.array_equal(before[~mine], after[~mine])


@pytest.mark.parametrize(("successes", "failures", "objects"), [(9, 50, 3), (50, 9, 3), (50, 50, 2), (0, 100, 4)])
def test_too_few_interactions_are_refused(successes: int, failures: int, objects: int) -> None:
    labels = np.array([True] * successes + [False] * failures)
    names = np.array([f"object-{number % objects}" for number in range(len(labels))])
    with pytest.raises(UsageError, match=f"{successes} successes and {failures} failures on {objects} objects are too"):
        check(labels, names)


# Policies and stores.


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return make_store(tmp_path_factory.mktemp("calibration") / "store")


@pytest.fixture(scope="module")
def policy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy")
    for name, data in policy_of().to_files().items():
        (folder / name).write_bytes(data)
    return folder


def logits_of(policy: Policy, store: Store) -> dict[CalibratedCritic, Float]:
    dataset = load_dataset(store, policy.config)
    return {name: rows.logits for name, rows in critic_rows(policy, dataset, range(8), 0).items()}


def test_a_policy_says_scale_times_what_it_said_and_bias(store: Store) -> None:
    policy = policy_of().with_trained("prior")
    policy.trained -= {"aip"}  # AIP would choose other interactions after the fit.
    dataset = load_dataset(store, policy.config)
    before, own = logits_of(policy, store), policy.aap.affordance_head.output.bias.clone()
    found = calibrate(policy, critic_rows(policy, dataset, range(8), 0))
    after = logits_of(policy, store)
    assert found.keys() == before.keys() == {"where2act", "aap"}
    for name, fitted in found.items():
        assert (fitted.scale, fitted.bias) != (1.0, 0.0)
        assert after[name] == pytest.approx(fitted.scale * before[name] + fitted.bias, abs=1e-4)
    scaled = found["aap"].scale * own + found["aap"].bias
    assert policy.aap.affordance_head.output.bias == pytest.approx(scaled, abs=1e-6), "D follows its critic"
    assert [row.interactions for row in found["aap"].rows] == [0, 1, 2, 4]
    assert {row.objects for row in found["aap"].rows} == {4}


@pytest.mark.parametrize("fit", ["scale", "last-layer"])
def test_the_command_writes_a_policy_with_a_card(
    store: Store, policy_folder: Path, fit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    line = ["calibrate", "--policy", str(policy_folder), "--store", str(store.where), "--out", str(out)]
    assert run([*line, "--fit", fit, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["fit"], told["objects"], told["left_out"]) == (fit, 4, 0)
    rows = [row for name in ("where2act", "aap") for row in told[name]["rows"]]
    assert [(row["critic"], row["interactions"]) for row in rows] == [
        ("where2act", 0), ("aap", 0), ("aap", 1), ("aap", 2), ("aap", 4),
    ]  # fmt: skip
    before, after = logits_of(load_policy(policy_folder), store), logits_of(load_policy(out), store)
    assert not np.array_equal(before["where2act"], after["where2act"])
    card = (out / "README.md").read_text()
    assert "96 interactions" in card
    assert "with 4 objects" in card
    assert objects_seen(out) == {ref.content_hash for ref in store.setting.objects}
    assert "had no card" in card
    # What it was fitted to is no test of it any more.
    assert run(["calibrate", "--policy", str(out), *line[3:5], "--out", str(tmp_path / "again")]) == 2
    assert "the policy has seen all objects" in capsys.readouterr().err


def test_what_cannot_be_calibrated_is_refused_in_one_line(
    store: Store, policy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--store", str(store.where), "--out", str(tmp_path / "out")]
    own = ["--policy", str(policy_folder)]
    few = make_store(tmp_path / "few", fabricated_rollouts(fabricated_plan(), 2))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "lone").mkdir()
    for name in (WEIGHTS_FILE, POLICY_FILE):
        (tmp_path / "lone" / name).write_bytes(Policy.untrained("push", policy_of().config, 0).to_files()[name])
    for given, expected in (
        (["--policy", "pull-closed-door", *where], "a policy for 'pull-closed-door', but"),
        ([*own, "--store", str(tmp_path / "gone"), *where[2:]], "gone"),
        ([*own, *where[:2], "--out", str(tmp_path / "full")], "holds something that is not an exported policy"),
        (["--policy", str(tmp_path / "lone"), *where], "prior is not trained"),
        ([*own, "--store", str(few.where), *where[2:]], "failures on 2 objects are too few to calibrate on"),
        ([*own, *where[:2], "--out", str(policy_folder)], "name another folder, so that it is kept"),
        ([*own, *where, "--seed", "-1"], "--seed -1"),
    ):
        assert run(["calibrate", *given]) == 2, given
        line = capsys.readouterr().err
        assert expected in line
        assert line.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_export_that_was_killed_is_completed_by_the_next(tmp_path: Path) -> None:
    out, files = tmp_path / "out", {WEIGHTS_FILE: b"weights", POLICY_FILE: b"{}"}
    out.mkdir()
    kill_while_writing(out / WEIGHTS_FILE)
    write_export(out, files)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == files
