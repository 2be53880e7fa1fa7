"""Benchmarks of collection: what they print can be relied on, and nothing is wrong with their arithmetic."""

import json
import subprocess
import sys
import tomllib
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest

from benchmarks.published import PublishedSettings, measure
from benchmarks.script import run_script
from cluster.cli.benchmarks import fidelity
from cluster.cli.benchmarks.dynamics import ALL, DynamicsTrial, by_category
from cluster.cli.benchmarks.fidelity import PairedTrial, compare, summarise
from cluster.cli.commands.bench import keep
from cluster.cli.main import run
from collector.objects.catalogue import scan
from collector.objects.procedural import generate
from shared.config import CameraConfig, CollectionConfig, Fidelity, Timing
from shared.errors import UsageError
from shared.formatting import finite
from shared.plan import Plan, Setting
from shared.types import Outcome, OutcomeKind

HASTE = Timing(steps_per_second=120, leg_steps=60, hold_steps=30)
COARSE = Fidelity(name="coarse", approach=HASTE, drag=HASTE)
COARSE_FLAGS = [
    f"--reference.{name.replace('_', '-')}={value}" for name, value in COARSE.model_dump().items() if type(value) is int
]


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 1, "Faucet": 1}, seed=5)
    return folder


def bench(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, object]:
    """The object that a benchmark prints as its last line."""
    assert run(["bench", *args, "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert isinstance(found, dict)
    return found


def pair(expected: bool, got: bool, motions: tuple[float, float] = (0.0, 0.0)) -> PairedTrial:
    reference, candidate = Outcome(OutcomeKind.OK, motions[0], expected), Outcome(OutcomeKind.OK, motions[1], got)
    return PairedTrial("object", reference, candidate, 0.2, 0.1)


def test_a_fidelity_agrees_with_itself(objects: Path) -> None:
    refs = tuple(entry.ref for entry in scan(objects).usable)
    faucets = tuple(ref for ref in refs if ref.category == "Faucet")
    camera = CameraConfig(image_size=128, points=256, candidates=1000)
    for task, applies_to in (("push", refs), ("push-faucet", faucets)):
        plan = Plan(setting=Setting(task=task, seed=3, objects=applies_to, collection=CollectionConfig(camera=camera)))
        (result,) = compare(plan, objects, COARSE, [COARSE], 12, lambda: None)
        assert result.trials == result.stands_for == 12
        assert result.label_agreement == result.kind_agreement == result.positive_f1 == 1.0
        assert result.confusions == ()
        assert not result.motion_error_median > 0


def test_f1_and_agreement_count_what_they_say() -> None:
    pairs = [pair(True, True, (0.5, 0.4)), pair(True, False, (0.02, 0.0)), pair(False, True), pair(False, False)]
    result = summarise(pairs)
    assert result.label_agreement == 0.5
    assert result.positive_f1 == 0.5
    assert result.positives == result.candidate_positives == 2
    assert result.motion_error_median == pytest.approx(np.median([0.1, 0.02]))
    assert (result.near_threshold, result.near_threshold_other_labels) == (0, 0)
    about = summarise([*pairs, pair(True, False, (0.012, 0.009)), pair(False, False, (0.009, 0.009))])
    assert (about.near_threshold, about.near_threshold_other_labels) == (2, 1)
    assert (about.clear_label_agreement, about.clear_positive_f1) == (0.5, 0.5)
    assert about.label_agreement == 0.5
    assert dict(result.confusions) == {"ok success -> ok": 1, "ok -> ok success": 1}
    assert summarise([pair(False, False)]).positive_f1 == 1.0
    assert summarise([pair(True, False)]).positive_f1 == 0.0


def test_what_moves_nothing_is_executed_in_the_reference_in_part_and_counts_for_the_rest(objects: Path) -> None:
    refs = tuple(entry.ref for entry in scan(objects).usable)
    camera = CameraConfig(image_size=128, points=256, candidates=1000)
    plan = Plan(setting=Setting(task="push", seed=3, objects=refs, collection=CollectionConfig(camera=camera)))
    advanced: list[None] = []
    candidates = [COARSE, COARSE.model_copy(update={"version": 2})]
    every = compare(plan, objects, COARSE, candidates, 24, lambda: None)
    share = compare(plan, objects, COARSE, candidates, 24, lambda: advanced.append(None), quiet_share=0.25)
    assert len(advanced) == 24
    assert every[0].trials == every[1].trials == 24
    assert share[0].trials == share[1].trials < 24
    # All that moves anything is there, and each other one counts for four.
    assert share[0].positives == every[0].positives > 0
    assert share[0].stands_for == pytest.approx(share[0].positives + 4 * (share[0].trials - share[0].positives), abs=9)
    assert share[0].positive_f1 == share[0].label_agreement == 1.0
    assert share[0].positive_f1_low == share[0].positive_f1_high == 1.0


def test_the_reference_is_executed_again_with_the_hand_beside(objects: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refs = tuple(entry.ref for entry in scan(objects).usable)
    camera = CameraConfig(image_size=128, points=256, candidates=1000)
    plan = Plan(setting=Setting(task="push", seed=3, objects=refs, collection=CollectionConfig(camera=camera)))
    alone = compare(plan, objects, COARSE, [COARSE], 12, lambda: None)
    judged, itself = compare(plan, objects, COARSE, [COARSE], 12, lambda: None, again=True)
    assert replace(judged, reference_ms=0, candidate_ms=0) == replace(alone[0], reference_ms=0, candidate_ms=0)
    assert (itself.trials, itself.positives) == (judged.trials, judged.positives)
    assert itself.positive_f1 > 0.9
    assert 0 < itself.motion_error_median < 1e-3
    # As far as a hand that starts at another place: other trials.
    monkeypatch.setattr(fidelity, "DISPLACED", 0.5)
    elsewhere = compare(plan, objects, COARSE, [COARSE], 12, lambda: None, again=True)[-1]
    assert elsewhere.label_agreement < 1.0


def test_a_trial_counts_as_often_as_its_weight_says() -> None:
    pairs = [pair(True, True, (0.5, 0.5)), pair(True, False, (0.02, 0.0)), replace(pair(False, False), weight=8.0)]
    result = summarise(pairs)
    assert (result.trials, result.stands_for, result.positives) == (3, 10.0, 2)
    assert result.label_agreement == pytest.approx(0.9)
    assert result.positive_f1 == pytest.approx(2 / 3)
    nothing = summarise([])
    assert nothing.trials == 0
    assert np.isnan(nothing.label_agreement)


def test_only_pairs_that_ever_succeed_can_depend_on_the_draw() -> None:
    tried = {0: (True, True), 1: (True, False), 2: (False, False), 3: (True,)}
    trials = [
        DynamicsTrial("Door" if number else "Box", (0, 0, number), OutcomeKind.OK, success)
        for number, successes in tried.items()
        for success in successes
    ]
    found = by_category(trials)
    assert list(found) == ["Box", "Door", ALL]
    assert (found[ALL].trials, found[ALL].pairs, found[ALL].ever, found[ALL].depends) == (7, 3, 2, 1)
    assert found[ALL].base_rate == pytest.approx(4 / 7)
    assert found["Door"].depends_share == 1.0
    assert found["Box"].depends_share == 0.0
    assert np.isnan(by_category(trials[-1:])[ALL].depends_share)


def test_fidelity_prints_its_figures(capsys: pytest.CaptureFixture[str], objects: Path) -> None:
    found = bench(capsys, "fidelity", "--objects", str(objects), "--trials", "3", *COARSE_FLAGS)
    expected = "label_agreement positive_f1 trials positives motion_error_median reference_ms fast_ms"
    expected += " near_threshold near_threshold_other_labels clear_label_agreement clear_positive_f1"
    expected += " positive_f1_low positive_f1_high stands_for candidate_steps drawn quiet_share"
    assert set(expected.split()) <= found.keys()
    assert found["trials"] == 3
    assert "again" not in found
    flags = ["--trials", "3", "--versions", "1", "3", "--quiet-share", "0.5", "--again"]
    found = bench(capsys, "fidelity", "--objects", str(objects), *flags, *COARSE_FLAGS)
    by_version = found["by_version"]
    assert isinstance(by_version, dict)
    assert list(by_version) == ["1", "3"]
    assert by_version["3"].items() <= found.items()
    assert isinstance(found["again"], dict)
    assert found["again"]["trials"] == found["trials"]


def test_dynamics_prints_its_figures(capsys: pytest.CaptureFixture[str], objects: Path) -> None:
    flags = ["--rollouts", "2", "--draws", "2", "--actions", "2"]
    found = bench(capsys, "dynamics", "--objects", str(objects), *flags)
    assert {"base_rate", "outcomes", "depends_on_draw", "categories"} <= found.keys()
    assert isinstance(found["categories"], dict)
    assert set(found["categories"]) <= {"StorageFurniture", "Faucet"}


def test_collect_times_what_users_run(capsys: pytest.CaptureFixture[str], objects: Path, tmp_path: Path) -> None:
    flags = ["--rollouts", "1", "--repeats", "2", "--collection.rollout.interactions", "4"]
    found = bench(capsys, "collect", "--objects", str(objects), *flags, "--out", str(tmp_path))
    assert found["interactions"] == 4
    rate = found["interactions_per_core_second"]
    assert isinstance(rate, float)
    assert rate > 0
    stages = found["stage_seconds"]
    assert isinstance(stages, dict)
    assert stages.keys() == {"load", "settle", "observe", "propose", "simulate", "write", "other"}
    kept = [json.loads(path.read_text()) for path in tmp_path.glob("*-collect-push-*.json")]
    assert [document["result"] for document in kept] == [found]
    assert {"date", "hardware", "software"} <= kept[0].keys()


@pytest.mark.slow
def test_the_published_protocol_executes_some_of_the_stored_trials(
    capsys: pytest.CaptureFixture[str], objects: Path
) -> None:
    flags = ["--rollouts", "1", "--repeats", "1", "--sample", "2", "--collection.rollout.interactions", "4", "--json"]
    assert run_script("published", PublishedSettings, measure, ["--objects", str(objects), *flags]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["interactions"], found["published_trials"]) == (4, 2)
    assert found["times_published_protocol"] > found["times_published_protocol_with_short_settling"] > 0


def test_no_shipped_package_finds_the_scripts() -> None:
    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    shipped = settings["tool"]["setuptools"]["packages"]["find"]["include"]
    assert not any(fnmatch(name, pattern) for name in ("benchmarks", "examples") for pattern in shipped)


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["fidelty"], "fidelity, dynamics, collect, learner; given 'fidelty'"),
        ([], "given nothing"),
        (["fidelity", "--task", "pusk"], "unknown task 'pusk'; allowed: push"),
        (["fidelity", "--trials", "0"], "trials"),
        (["fidelity", "--quiet-share", "0"], "quiet_share"),
        (["dynamics", "--draws", "1"], "draws"),
        (["collect", "--objects", "/nowhere/at/all"], "/nowhere/at/all: no such folder"),
    ],
)
def test_bad_input_is_one_line(capsys: pytest.CaptureFixture[str], args: list[str], expected: str) -> None:
    assert run(["bench", *args]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert expected in err
    assert err.count("\n") == 1


def test_what_is_not_a_number_becomes_null_and_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    assert finite({"a": float("nan"), "b": [1.5, float("inf")]}) == {"a": None, "b": [1.5, None]}
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file"):
        keep({}, tmp_path / "file", "name")


@pytest.mark.slow
def test_a_worker_group_makes_what_one_worker_makes(objects: Path) -> None:
    flags = ["--rollouts", "2", "--repeats", "1", "--collection.rollout.interactions", "2"]
    script = (
        "from cluster.cli.main import main; main()"  # In a process of its own: Ray wants to be imported before SAPIEN.
    )
    command = [sys.executable, "-c", script, "bench", "collect", "--objects", str(objects), *flags]
    done = subprocess.run([*command, "--workers", "2", "--json"], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["same_digest"] is True
    assert found["workers_speedup"] > 0
