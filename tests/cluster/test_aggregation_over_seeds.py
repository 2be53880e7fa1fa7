"""Several runs as one table: sums of counts by object, each run beside, and the paper's figures."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import CampaignConfig
from cluster.evaluation.tables import RESULTS_FILE
from cluster.reporting.aggregation import (
    CSV_FILE,
    FIGURE_FILE,
    JSON_FILE,
    MARKDOWN_FILE,
    Comparison,
    as_markdown,
    pool,
    write_comparison,
)
from cluster.runs.run_folder import ObjectsUsed, begin
from learner.metrics import ratio_interval
from shared.config import CollectionConfig
from shared.errors import UsageError
from shared.plan import EvaluationConfig, ObjectRef, Setting
from shared.store import Store
from shared.tasks import task_named

METHODS = (("where2act", 1), ("oracle", 0), ("ours-final", 1))


def counts_of(rng: np.random.Generator, objects: tuple[str, ...]) -> dict[str, list[object]]:
    queries = rng.integers(10, 20, len(objects))
    true = rng.binomial(queries, 0.5)
    claimed_true = rng.binomial(true, 0.7)
    trials = rng.integers(1, 5, len(objects))
    columns = {
        "queries": queries,
        "true": true,
        "claimed": claimed_true + rng.binomial(queries - true, 0.3),
        "hits": claimed_true,
        "trials": trials,
        "successes": rng.binomial(trials, 0.6),
        "start_trials": trials,
        "start_successes": rng.binomial(trials, 0.5),
        "mix_true": 1.5 * true,
        "mix_claimed": 1.5 * true + 0.5,
        "mix_hits": 1.5 * claimed_true,
        "shifted_claimed": 1.5 * true + 0.25,
        "shifted_hits": 1.5 * claimed_true,
    }
    return {"object": list(objects)} | {name: column.tolist() for name, column in columns.items()}


def make_run(
    path: Path, seed: int, contents: dict[str, str], task: str = "push-faucet", trained_on: str = "Faucet"
) -> dict[str, dict[str, list[int]]]:
    """A run with made-up results on faucets; returns the counts of each method."""
    run = begin(path, CampaignConfig(task=task))
    test = tuple(ObjectRef(id=name, category="Faucet", content_hash=content) for name, content in contents.items())
    train = (ObjectRef(id="t", category=trained_on, content_hash="0" * 64),)
    used = ObjectsUsed(folder="objects", train=train, validation=(), test=test, refused=())
    run.objects_file.write_text(used.model_dump_json())
    return make_results(run.training("evaluate"), seed, contents, task)


def make_results(folder: Path, seed: int, contents: dict[str, str], task: str) -> dict[str, dict[str, list[int]]]:
    """A folder with made-up results; returns the counts of each method."""
    rng = np.random.default_rng(seed)
    counts = {method: counts_of(rng, tuple(contents)) for method, _ in METHODS}
    figures = {"best_f": 0.5, "bce": 0.4, "auc": None, "base_rate": 0.25 + 0.1 * seed, "mean_tries": 1.0}
    figures |= {"f_score": 0.5, "sample_success": None, "trials": 3, "queries": 15}
    rows = [{"method": m, "budget": b, "counts": counts[m], **figures} for m, b in METHODS]
    known = contents | {"untried": "7" * 64}
    document = {"task": task, "seed": seed, "objects": len(contents), "rollouts": 10, "contents": known, "rows": rows}
    folder.mkdir(parents=True)
    (folder / RESULTS_FILE).write_text(json.dumps(document))
    return counts  # type: ignore[return-value]


@pytest.fixture
def runs(tmp_path: Path) -> tuple[list[Path], list[dict[str, dict[str, list[int]]]]]:
    """Two runs: "a" is another object in each, "b" the same in both."""
    told = ({"a": "1" * 64, "b": "9" * 64}, {"a": "2" * 64, "b": "9" * 64})
    paths = [tmp_path / "one", tmp_path / "two"]
    return paths, [
        make_run(path, seed, contents) for seed, (path, contents) in enumerate(zip(paths, told, strict=True))
    ]


def test_figures_are_of_all_trials_and_intervals_of_objects(
    runs: tuple[list[Path], list[dict[str, dict[str, list[int]]]]],
) -> None:
    paths, counts = runs
    found = pool(paths, None)
    one, two = (each["ours-final"] for each in counts)
    row = found.rows[[(row.method, row.budget) for row in found.rows].index(("ours-final", 1))]
    hits, named = (sum(one[name]) + sum(two[name]) for name in ("hits", "true"))
    claimed = sum(one["claimed"]) + sum(two["claimed"])
    assert row.shares["f_score"][0] == pytest.approx(2 * hits / (claimed + named))
    # "b" of both runs is one object; "a" is two.
    successes = [one["successes"][0], two["successes"][0], one["successes"][1] + two["successes"][1]]
    trials = [one["trials"][0], two["trials"][0], one["trials"][1] + two["trials"][1]]
    assert row.shares["sample_success"][1:] == pytest.approx(ratio_interval(successes, trials, [0, 1, 2]))
    weighed = {name: sum(one[name]) + sum(two[name]) for name in ("mix_hits", "mix_claimed", "mix_true")}
    expected = 2 * weighed["mix_hits"] / (weighed["mix_claimed"] + weighed["mix_true"])
    assert row.shares["mix_f_score"][0] == pytest.approx(expected)
    assert row.shares["mix_f_score"][1] <= expected <= row.shares["mix_f_score"][2]
    assert found.objects == 3
    assert found.base_rate == pytest.approx(0.3)
    assert row.by_run["sample_success"][1] == pytest.approx(sum(two["successes"]) / sum(two["trials"]))
    prior, oracle = (next(r for r in found.rows if r.method == name) for name in ("where2act", "oracle"))
    low, high = prior.shares["f_score"][0], oracle.shares["f_score"][0]
    expected = (row.shares["f_score"][0] - low) / (high - low) if high > low else float("nan")
    assert row.gap_closed == pytest.approx(expected, nan_ok=True)


def test_the_files_hold_it(runs: tuple[list[Path], object], tmp_path: Path) -> None:
    found: Comparison = pool(runs[0], None)
    write_comparison(tmp_path / "out", found)
    text = (tmp_path / "out" / MARKDOWN_FILE).read_text()
    assert text.count("*77.4*") == 3  # The paper's F-score of ours-final after one try, also beside the mix.
    assert "| method | interactions | F, published mix | paper | F, published mix, shifted | paper |" in text
    assert "seed 0 | seed 1" in text
    read = list(csv.DictReader((tmp_path / "out" / CSV_FILE).read_text().splitlines()))
    assert [row["method"] for row in read] == ["where2act", "ours-final", "oracle"]
    assert float(read[1]["f_score"]) == pytest.approx(found.rows[1].shares["f_score"][0])
    assert [row["paper_f_score"] for row in read] == ["0.6492", "0.7742", ""]
    assert "paper_start_success" not in read[0]
    assert json.loads((tmp_path / "out" / JSON_FILE).read_text())["seeds"] == [0, 1]
    assert (tmp_path / "out" / FIGURE_FILE).read_bytes().startswith(b"\x89PNG")


def test_results_of_older_versions_are_pooled_without_the_published_mix(
    runs: tuple[list[Path], object], tmp_path: Path
) -> None:
    path = runs[0][0] / "training" / "evaluate" / RESULTS_FILE
    document = json.loads(path.read_bytes())
    for row in document["rows"]:
        row["counts"] = {name: each for name, each in row["counts"].items() if not name.startswith(("mix", "shifted"))}
    path.write_text(json.dumps(document))
    found = pool(runs[0], None)
    row = found.rows[1]
    assert not np.isnan(row.shares["f_score"][0])
    assert np.isnan(row.shares["mix_f_score"]).all()
    assert [np.isnan(each) for each in row.by_run["mix_f_score"]] == [True, False]
    assert "published mix" not in as_markdown(found)
    write_comparison(tmp_path / "out", found)
    assert json.loads((tmp_path / "out" / JSON_FILE).read_bytes())["rows"][1]["mix_f_score"] is None


def test_exploits_by_share_are_pooled_where_all_runs_have_the_same_share(
    runs: tuple[list[Path], object],
) -> None:
    def tell(run: Path, share: float | None, counted: dict[str, list[int]]) -> None:
        path = run / "training" / "evaluate" / RESULTS_FILE
        document = json.loads(path.read_bytes()) | {"exploit_share": share}
        for row in document["rows"]:
            row["counts"] |= counted
        path.write_text(json.dumps(document))

    one, two = runs[0]
    counted = {"share_trials": [4, 4], "share_successes": [1, 2]}
    tell(one, 0.01, counted)
    assert np.isnan(pool(runs[0], None).rows[1].shares["share_success"][0])
    tell(two, 0.01, counted)
    found = pool(runs[0], None)
    assert found.rows[1].shares["share_success"][0] == pytest.approx(6 / 16)
    assert "drawn from the best 1% of the cloud" in as_markdown(found)
    tell(two, 0.05, counted)
    with pytest.raises(UsageError, match=r"different exploit_share \(0\.01, 0\.05\)"):
        pool(runs[0], None)


def test_novel_categories_stand_beside_the_papers_figures_of_such(tmp_path: Path) -> None:
    for trained_on, figure in (("Door", "*77.6*"), ("Faucet", "*72.8*")):
        path = tmp_path / trained_on
        make_run(path, 1, {"a": "1" * 64}, task="push", trained_on=trained_on)
        found = pool([path], None)
        assert found.novel_categories == (trained_on == "Door")
        # The paper's F-score of ours-final after one try, on its novel and on its training categories.
        assert figure in as_markdown(found)
    # What the policy that a run went on from was trained on, nobody knows.
    (tmp_path / "Door" / "training" / "adopted").mkdir()
    assert not pool([tmp_path / "Door"], None).novel_categories


def test_evaluations_of_several_seeds_are_found_by_how_their_names_begin(
    runs: tuple[list[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    contents, numbers = {"r": "7" * 64}, iter(range(10))
    ref = ObjectRef(id="r", category="Faucet", content_hash=contents["r"])
    for path, digest in zip(runs[0], ("11", "22"), strict=True):
        for name in ("real", "realm"):
            folder = path / "evaluations" / f"{name}-{digest}"
            make_results(folder, next(numbers), contents, "push-faucet")
            collection = task_named("push-faucet").resolve(CollectionConfig())
            told = {"kind": "evaluation", "task": "push-faucet", "seed": 1, "objects": (ref,)}
            Store.create(folder / "store", Setting(**told, collection=collection, evaluation=EvaluationConfig()))
    found = pool(runs[0], "real-")
    assert (found.objects, found.seeds) == (1, (0, 2))
    assert adaafford(["compare", str(runs[0][0]), "--evaluation", "real"]) == 2
    assert "several evaluations called 'real'; it has real-11, realm-11" in capsys.readouterr().err


def test_what_cannot_be_pooled_is_said_in_a_line(
    runs: tuple[list[Path], object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "door", 3, {"a": "3" * 64}, task="pull-closed-door")
    make_run(tmp_path / "novel", 4, {"a": "4" * 64}, trained_on="Door")
    shutil.copytree(runs[0][0], tmp_path / "copy")
    for arguments, message in (
        ([str(runs[0][0]), str(tmp_path / "door")], "different tasks (pull-closed-door, push-faucet)"),
        ([str(tmp_path)], "holds no run"),
        ([str(runs[0][0]), "--evaluation", "real"], "no finished evaluation called 'real'; evaluate the run first"),
        ([str(runs[0][0]), str(tmp_path / "novel")], "only some of the runs were tested on novel categories"),
        ([], "name the folders"),
        ([str(runs[0][0]), "--out", __file__], "no folder can be made of this name"),
        ([str(runs[0][0])] * 2, "each once"),
        ([str(runs[0][0]), str(tmp_path / "copy")], f"copy holds the very trials of {runs[0][0]}"),
    ):
        assert adaafford(["compare", *arguments]) == 2
        assert message in capsys.readouterr().err.splitlines()[-1]
    path = runs[0][0] / "training" / "evaluate" / RESULTS_FILE
    whole = path.read_text()
    for damage, message in (("7, ", "different lengths"), ("-", "not between 0")):
        for name in ("queries", "mix_true"):
            path.write_text(whole.replace(f'"{name}": [', f'"{name}": [{damage}'))
            with pytest.raises(UsageError, match=message):
                pool(runs[0], None)
