"""Evaluation by itself: intervals are honest, tables say what was found, and a stop changes nothing."""

import csv
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import EvaluateSettings
from cluster.evaluation.evaluate import PROPOSER, Evaluation
from cluster.evaluation.run_evaluation import evaluate_run, evaluate_without_run
from cluster.evaluation.tables import (
    CSV_FILE,
    MARKDOWN_FILE,
    RESULTS_FILE,
    EvaluationTable,
    as_markdown,
    evaluate_policy,
)
from cluster.workers.retries import JobError
from cluster.workers.session import CurrentWorkerGroup
from collector.objects.procedural.catalogue import generate
from collector.worker import Worker
from learner.evaluation.table import EvaluationRow, ObjectCounts
from learner.metrics import f_score, ratio_interval
from learner.settings import LearnerConfig
from learner.stages.jobs import CONFIG_FILE, DONE_FILE
from shared.errors import UsageError
from shared.formatting import csv_table
from shared.plan import EvaluationConfig, Plan, Setting
from shared.policies.methods import METHODS
from shared.policies.policy import WEIGHTS_FILE, Policy
from shared.store import Store
from shared.tasks import Task
from tests.support.finished_run import SMALL_NETWORK, make_finished_run

FAST = EvaluateSettings(methods=("where2act", "ours-random"), budgets=(1,), trials=2, queries=4, per_shard=1, workers=0)


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 5)), min_size=1, max_size=60))
def test_an_interval_of_f_scores_lies_where_f_scores_lie(rows: list[tuple[bool, bool, int]]) -> None:
    claimed, true = (np.array([row[k] for row in rows]) for k in (0, 1))
    low, high = ratio_interval(2 * (claimed & true), 1 * claimed + true, [row[2] for row in rows])
    whole = f_score(claimed, true)
    assert np.isnan(low) == np.isnan(high) == np.isnan(whole)
    if not np.isnan(whole):
        assert 0 <= low <= high <= 1


def test_objects_are_resampled_whole() -> None:
    """Ten equal rows of an object are no more evidence than one."""
    success = np.random.default_rng(1).random(30) < 0.4
    one = ratio_interval(success, np.ones(30), np.arange(30))
    ten = ratio_interval(np.repeat(success, 10), np.ones(300), np.repeat(np.arange(30), 10))
    assert one == ten
    rows = ratio_interval(np.repeat(success, 10), np.ones(300), np.arange(300))
    assert rows[1] - rows[0] < 0.5 * (one[1] - one[0])


def test_an_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng, truth, hits = np.random.default_rng(2), 0.3, 0
    for _ in range(100):
        rates = rng.beta(3, 7, size=40)
        success = rng.random((40, 10)) < rates[:, None]
        low, high = ratio_interval(success.ravel(), np.ones(400), np.repeat(np.arange(40), 10))
        hits += low <= truth <= high
    assert 85 <= hits <= 100


def test_one_object_says_nothing_of_others() -> None:
    low, high = ratio_interval([1, 0, 1], [1, 1, 1], [7, 7, 7])
    assert low == high == pytest.approx(2 / 3)
    assert np.isnan(ratio_interval([], [], [])).all()


def table_of(**values: object) -> EvaluationTable:
    row = {
        **{"method": "ours-final", "budget": 2, "f_score": 0.5, "f_score_low": 0.25, "f_score_high": 0.75},
        **{"sample_success": None, "sample_success_low": None, "sample_success_high": None, "trials": 0},
        **{"start_success": 0.4, "start_success_low": 0.2, "start_success_high": 0.6, "queries": 24},
        **{"best_f": 0.6, "bce": 0.5, "auc": None, "base_rate": 0.3, "mean_tries": 2.0, "gap_closed": None},
        **{"mix_f_score": 0.8, "mix_f_score_low": 0.7, "mix_f_score_high": 0.9, "mix_base_rate": 0.45},
        **{"shifted_f_score": None, "shifted_f_score_low": None, "shifted_f_score_high": None},
        **{"share_success": None, "share_success_low": None, "share_success_high": None},
        **{"repeat_success": None, "repeat_success_low": None, "repeat_success_high": None},
    }
    share = 0.01 if "share_success" in values else None
    return EvaluationTable(
        "push-faucet", 1, 4, 40, 2, share, "ab" * 32, {"a": "cd" * 32}, (EvaluationRow(**row | values),)
    )


def test_tables_show_intervals_and_what_there_is_no_figure_of() -> None:
    shown = as_markdown(table_of())
    assert "| ours-final | 2 | 50.0 [25.0, 75.0] | - | 40.0 [20.0, 60.0] | - | 0 |" in shown
    assert "| 2 | 80.0 [70.0, 90.0] |\n" in shown  # Like-for-like columns stand last, where there are figures.
    assert "best share" not in shown.lower()
    both = as_markdown(table_of(share_success=0.25, share_success_low=0.1, share_success_high=0.5))
    assert "| 80.0 [70.0, 90.0] | 25.0 [10.0, 50.0] |\n" in both
    assert "drawn from the best 1% of the cloud" in both
    assert "| from the start, repeated |" in as_markdown(table_of(repeat_success=0.25))
    assert "30.0% succeed" in shown
    assert "of which 45.0% succeed (a critic that always says yes has an F-score of 62.1)" in shown
    read = list(csv.DictReader(io.StringIO(csv_table([row.model_dump() for row in table_of().rows], ["counts"]))))
    assert (read[0]["f_score"], read[0]["auc"]) == ("0.5", "")
    assert "counts" not in read[0]


@pytest.mark.parametrize("name", sorted(METHODS.names()))
def test_a_method_needs_the_networks_that_its_proposers_check_and_no_other(name: str) -> None:
    """Asked too little, a worker would meet the missing network in the middle of a collection."""
    from shared.policies.adaptation import Adapter
    from shared.policies.policy import Policy
    from shared.policies.proposers import proposer_named
    from tests.support.finished_run import SMALL_NETWORK

    method = METHODS.get(name)

    def make_proposers(trained: list[str]) -> None:
        policy = Policy.untrained("push", SMALL_NETWORK, 0)
        for module in trained:
            if module in ("where2act-interaction", "where2act-adaptation"):
                policy.begin_baseline(module, 0)
            policy.with_trained(module)
        for proposer in {method.critic, method.tries} - {None, "random"}:
            proposer_named(str(proposer), Adapter(policy), np.random.default_rng(0), 1)

    make_proposers([*method.modules])
    for missing in method.modules:
        with pytest.raises(UsageError, match=rf"{missing} is not trained"):
            make_proposers([module for module in method.modules if module != missing])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_finished_run(tmp_path_factory.mktemp("evaluation") / "run").path


def test_missing_networks_are_refused_before_anything_is_tried(finished: Path, tmp_path: Path) -> None:
    settings = FAST.model_copy(update={"methods": ("ours-final", "where2act-adaptation")})
    with pytest.raises(UsageError, match="where2act-adaptation is not trained"):
        evaluate_run(finished, settings, tmp_path / "out")
    assert Store.open(tmp_path / "out" / "store").committed() == []


def test_trials_of_two_policies_are_never_mixed(finished: Path, tmp_path: Path) -> None:
    store = Store.open(finished / "store")
    told = {**dict(store.setting), "kind": "evaluation", "evaluation": EvaluationConfig(methods=("where2act",))}
    evaluation = Store.create(tmp_path / "store", Setting(**told))
    evaluation.add_plan(Plan(setting=evaluation.setting, proposer=PROPOSER, policy_version=7))
    wanted = Evaluation(evaluation, store.read_policy, 1, 2, 1, finished / "objects", *[tmp_path] * 3)
    with pytest.raises(UsageError, match="trials of another policy"):
        wanted.execute(CurrentWorkerGroup(lambda *_: pytest.fail("a worker group was asked for")), print)


def row_of(method: str, budget: int, f_score: float) -> EvaluationRow:
    figures = dict.fromkeys(("best_f", "bce", "auc", "base_rate", "sample_success", "mean_tries"), 0.5)
    counts, told = ObjectCounts(*[()] * 9), {"method": method, "budget": budget, "queries": 1, "trials": 1}
    return EvaluationRow(f_score=f_score, counts=counts, **told, **figures)


def test_where2act_stands_at_every_budget_and_the_oracle_closes_the_gap(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.open(finished / "store")
    told = {**dict(store.setting), "kind": "evaluation", "evaluation": EvaluationConfig(budgets=(1, 4))}
    evaluation = Store.create(tmp_path / "store", Setting(**told))
    evaluation.publish_policy(1, store.read_policy(1))
    rows = [row_of("where2act", 0, 0.2), row_of("oracle", 0, 0.7), row_of("ours-final", 4, 0.6)]
    no_gap = [*rows[::2], row_of("oracle", 0, 0.1)]
    for known, closed in ((rows, {0.0, 1.0, 0.8}), (rows[::2], {None}), (no_gap, {None})):
        monkeypatch.setattr("cluster.evaluation.tables.evaluate_store", lambda *_, known=known: known)
        table = evaluate_policy(evaluation, 1, tmp_path / "no-oracle")
        assert [row.budget for row in table.rows if row.method == "where2act"] == [1, 4]
        assert {row.gap_closed and round(row.gap_closed, 9) for row in table.rows} == closed


def test_what_does_not_suit_is_refused_in_one_line(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generate(tmp_path / "boxes", {"Box": 1}, seed=1)
    for arguments, expected in (
        (["--run", str(tmp_path / "gone")], "holds no run"),
        (["--run", str(finished), "--policy-version", "7"], "there is no policy 7; published: 1"),
        (["--run", str(finished), "--policy", "7"], "give either --run RUN or --policy POLICY; given: both"),
        ([], "give either --run RUN or --policy POLICY; given: neither"),
        (["--run", str(finished), "--task", "pull"], "the policy is trained to push"),
        (["--run", str(finished), "--collection.camera.points", "99"], "--collection settings are for --policy"),
        (["--run", str(finished), "--budgets", "0"], "budgets"),
        (["--run", str(finished), "--exploit-share", "0"], "exploit_share"),
        (["--run", str(finished), "--task", "pusk"], "unknown task 'pusk'"),
        (["--run", str(finished), "--objects", str(tmp_path / "boxes")], "suits the task 'push-faucet'"),
    ):
        assert adaafford(["evaluate", *arguments, "--workers", "0"]) == 2
        line = capsys.readouterr().err
        assert expected in line
        assert line.count("\n") == 1
    assert not (finished / "evaluations").exists()


def test_what_was_trained_on_is_never_tested_on(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Given the folder that it was trained on, a run is tested on the rest of it."""
    tested = []

    def pretend(evaluation: Evaluation, _: EvaluateSettings) -> None:
        tested.append(evaluation.store.setting.objects)
        (evaluation.out / MARKDOWN_FILE).write_text("")

    monkeypatch.setattr("cluster.evaluation.run_evaluation._execute", pretend)
    used = json.loads((finished / "objects.json").read_bytes())
    for objects in (None, finished / "objects"):
        evaluate_run(finished, FAST.model_copy(update={"objects": objects}), tmp_path / f"out-{objects is None}")
    assert [[ref.id for ref in refs] for refs in tested] == [[ref["id"] for ref in used["test"]]] * 2


# A policy without a run


@pytest.fixture(scope="module")
def exported(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's policy alone, in a folder that says that it has seen the first of the run's test objects."""
    folder = tmp_path_factory.mktemp("exported") / "policy"
    folder.mkdir()
    for name, data in Store.open(finished / "store").read_policy(1).items():
        (folder / name).write_bytes(data)
    first = json.loads((finished / "objects.json").read_bytes())["test"][0]
    (folder / DONE_FILE).write_text(json.dumps({"stage": "exported", "objects": [first["content_hash"]]}))
    return folder


def test_evaluate_policy_takes_the_folder_of_a_training(
    finished: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda subject, *_: told.append(subject))
    stage = shutil.copytree(exported, tmp_path / "stage")
    (stage / CONFIG_FILE).write_text(LearnerConfig().model_dump_json())
    evaluate_without_run(str(stage), FAST.model_copy(update={"objects": finished / "objects"}), None)
    assert [subject.label for subject in told] == ["stage"]


@pytest.mark.parametrize("named", ["folder", "file"])
def test_evaluate_policy_without_run_tests_all_objects_but_those_it_has_seen(
    named: str, finished: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluations = []

    def pretend(evaluation: Evaluation, _: EvaluateSettings) -> None:
        evaluations.append(evaluation)
        (evaluation.out / MARKDOWN_FILE).write_text("")

    monkeypatch.setattr("cluster.evaluation.run_evaluation._execute", pretend)
    monkeypatch.chdir(tmp_path)
    source = exported if named == "folder" else exported / WEIGHTS_FILE
    for trials in (1, 2):  # More trials of the same go on in the same folder.
        told = FAST.model_copy(update={"objects": finished / "objects", "methods": (), "trials": trials})
        evaluate_without_run(str(source), told, None)
    one, more = evaluations
    used = json.loads((finished / "objects.json").read_bytes())
    wanted = {ref["id"] for ref in (*used["train"], *used["test"][1:])}
    assert {ref.id for ref in one.store.setting.objects} == wanted
    assert one.out == more.out
    assert one.out.parent == Path("evaluations")
    assert one.out.name.startswith("push-faucet-objects-policy-")
    # The first policy of the run is not known, so the method that uses it is left out.
    # A reference is compared only where it is named.
    left_out = {"ours-no-iteration", "ours-spread", "ours-gain", "ours-value"}
    ours = {name for name in METHODS.names() if name.startswith("ours-")}
    assert set(one.config.methods) == ({"where2act"} | ours) - left_out


def test_evaluate_policy_says_where_its_objects_cannot_be_known(
    finished: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lone = tmp_path / "lone"
    shutil.copytree(exported, lone)
    (lone / DONE_FILE).unlink()
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda *_: None)
    for source, said in ((lone, 1), (exported, 0)):
        evaluate_without_run(str(source), FAST.model_copy(update={"objects": finished / "objects"}), None)
        assert capsys.readouterr().err.count("has no record of its training objects") == said


def test_evaluate_policy_keeps_depth_images_where_its_networks_need_them(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda subject, *_: told.append(subject))
    for needed in (False, True):
        policy = Policy.untrained("push", SMALL_NETWORK.model_copy(update={"pinch_profile": needed}), 0)
        folder = tmp_path / str(needed)
        folder.mkdir()
        for name, data in policy.with_trained("prior").to_files().items():
            (folder / name).write_bytes(data)
        evaluate_without_run(str(folder), FAST.model_copy(update={"objects": finished / "objects"}), None)
    assert [subject.collection.camera.keep_depth for subject in told] == [False, True]
    assert told[1].collection == told[0].collection.keeping_depth()


def test_evaluate_policy_has_the_hand_of_the_policy_unless_another_is_named(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda subject, *_: told.append(subject))
    policy = Policy.untrained("push", SMALL_NETWORK, 0).with_trained("prior").of_hand("suction")
    for name, data in policy.to_files().items():
        (tmp_path / name).write_bytes(data)
    for hand in ("panda", "suction", "wide"):
        collection = FAST.collection.model_copy(update={"gripper": hand})
        settings = FAST.model_copy(update={"objects": finished / "objects", "collection": collection})
        evaluate_without_run(str(tmp_path), settings, None)
    assert [subject.collection.gripper for subject in told] == ["suction", "suction", "wide"]


def test_evaluate_policy_knows_the_task_that_a_file_defined_in_its_training(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Task] = []
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda subject, task, *_: told.append(task))
    mine = Task(name="push-slowly", primitive="push")
    policy = Policy.untrained(mine.name, SMALL_NETWORK, 0).with_trained("prior").defined_as(mine)
    for name, data in policy.to_files().items():
        (tmp_path / name).write_bytes(data)
    settings = FAST.model_copy(update={"objects": finished / "objects"})
    evaluate_without_run(str(tmp_path), settings, None)
    assert told == [mine]
    with pytest.raises(UsageError, match="the policy is trained to push"):
        evaluate_without_run(str(tmp_path), settings.model_copy(update={"task": "pull"}), None)


def test_evaluate_policy_with_a_run_is_the_evaluation_of_the_run(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    monkeypatch.setattr("cluster.evaluation.run_evaluation._evaluate", lambda subject, *_: told.append(subject))
    evaluate_run(finished, FAST, None)
    evaluate_without_run(str(finished), FAST, None)
    assert len({(subject.label, subject.evaluations, subject.root) for subject in told}) == 1


def test_evaluate_policy_refuses_what_does_not_suit_in_one_line(
    finished: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "untrained").mkdir()
    for name, data in Policy.untrained("push", SMALL_NETWORK, 0).to_files().items():
        (tmp_path / "untrained" / name).write_bytes(data)
    where = ["--objects", str(finished / "objects")]
    for arguments, expected in (
        (["no-such-policy", *where], "no policy 'no-such-policy': give a name"),
        (["push-faucet"], "brings no test objects; name a folder with --objects"),
        ([str(exported), *where, "--policy-version", "1"], "--policy-version is for --run"),
        ([str(exported), *where, "--methods", "ours-no-iteration"], "uses an earlier policy of a run"),
        ([str(exported), *where, "--task", "pull"], "the policy is trained to push"),
        ([str(exported), *where, "--collection.primitive", "pull"], "needs pull; name a task of the same primitive"),
        ([str(tmp_path / "untrained"), *where], "none of its networks is trained"),
        ([str(exported), "--objects", str(tmp_path / "gone")], "gone"),
    ):
        assert adaafford(["evaluate", "--policy", *arguments, "--workers", "0", "--out", str(tmp_path / "out")]) == 2
        lines = capsys.readouterr().err
        assert expected in lines
        assert lines.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_evaluate_policy_without_run_writes_the_table_and_never_mixes_policies(
    finished: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--objects", str(finished / "objects"), "--methods", "where2act", "--budgets", "1", "--trials", "1"]
    flags += ["--exploit-share", "0.01", "--queries", "2", "--workers", "0", "--out", str(tmp_path / "out")]
    flags += ["--collection.camera.points", "256", "--collection.camera.image-size", "128"]
    assert adaafford(["evaluate", "--policy", str(exported), *flags]) == 0
    assert "| where2act | 1 |" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / RESULTS_FILE).read_bytes())
    assert found["rollouts"] == found["objects"] == 3
    assert {row["method"] for row in found["rows"]} == {"where2act", "aap-no-tries"}  # No oracle came along.
    assert all("mix_f_score" in row and "shifted_f_score_low" in row for row in found["rows"])
    shares = {row["method"]: row["share_success"] for row in found["rows"]}
    assert shares["where2act"] is not None
    assert shares["aap-no-tries"] is None
    other = tmp_path / "other"
    shutil.copytree(exported, other)
    policy = Policy.untrained("push-faucet", SMALL_NETWORK, seed=8).with_trained("prior").with_trained("aap")
    for name, data in policy.to_files().items():
        (other / name).write_bytes(data)
    assert adaafford(["evaluate", "--policy", str(other), *flags]) == 2
    assert "holds trials of another policy; name another folder" in capsys.readouterr().err


@pytest.mark.slow
def test_a_stopped_evaluation_ends_in_the_same_table(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    evaluate_run(finished, FAST, whole)
    execute, calls = Worker.execute, []

    def dying(*args: object) -> object:
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return execute(*args)

    with monkeypatch.context() as patch, pytest.raises((KeyboardInterrupt, JobError)):
        patch.setattr(Worker, "execute", dying)
        evaluate_run(finished, FAST, stopped)
    begun = Store.open(stopped / "store")
    assert len(begun.committed()) == 1
    # One trial of one object; the other has had none.
    assert evaluate_policy(begun, 1, tmp_path / "no-oracle").objects == 1
    assert not (stopped / RESULTS_FILE).exists()
    evaluate_run(finished, FAST, stopped)
    for name in (RESULTS_FILE, CSV_FILE, MARKDOWN_FILE):
        assert (stopped / name).read_bytes() == (whole / name).read_bytes()
    found = json.loads((whole / RESULTS_FILE).read_bytes())
    assert (found["rollouts"], found["objects"]) == (4, 2)
    per_object = {row["method"]: row["trials"] for row in found["rows"]}
    assert per_object == {"where2act": 4, "aap-no-tries": 0, "ours-random": 4}
