"""`adaafford curve`: trainings judged on stored rollouts of objects that they have not seen."""

import csv
import json
from pathlib import Path

import pytest

from adaafford.pretrained import load_policy
from cluster.cli.main import run
from cluster.evaluation.curves import CSV_FILE, FIGURE_FILE, JSON_FILE, MARKDOWN_FILE
from learner.alternation import Finished, alternate, trained_in
from learner.settings import AlternationConfig
from learner.stages.jobs import StageJob, objects_seen, run_stage
from learner.stages.trainers import ORACLE_FILE
from shared.plan import Plan
from tests.support.fabricate import fabricate_setting
from tests.support.small_trainings import FAST, fabricated_rollouts, make_store


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of four objects with two trainings on three of them: an alternation, and the paper's AAP."""
    folder = tmp_path_factory.mktemp("curve")
    plan = Plan(setting=fabricate_setting(objects=4, points=64))
    make_store(folder / "store", fabricated_rollouts(plan), plan)
    objects = {"train_objects": frozenset(("object-0", "object-1")), "validation_objects": frozenset(("object-2",))}
    privileged = FAST.model_copy(
        update={
            "aap": FAST.aap.model_copy(update={"training": "privileged"}),
            "alternation": AlternationConfig(rounds=1),
        }
    )
    job = StageJob("prior", folder / "store", folder / "seed-1", **objects)
    alternate(Finished(job), privileged)
    paper = FAST.model_copy(update={"aap": FAST.aap.model_copy(update={"training": "paper"})})
    run_stage(StageJob("aap", folder / "store", folder / "paper", folder / "seed-1" / "prior", **objects), paper)
    return folder


def arguments(folder: Path, *more: str) -> list[str]:
    runs = [f"privileged={folder / 'seed-1'}", f"paper={folder / 'paper'}"]
    return ["curve", "--store", str(folder / "store"), "--runs", *runs, "--draws", "2", *more]


def test_trainings_are_judged_between_where2act_and_the_oracle(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments(folder, "--out", str(tmp_path), "--json")) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == json.loads((tmp_path / JSON_FILE).read_text())
    # One object of four was seen by nobody; each of its two rollouts is drawn twice and asks about half of 12 rows.
    assert (told["rollouts"], told["left_out"]) == (2, 6)
    assert {row["questions"] for row in told["rows"]} == {2 * 2 * 6}
    tries = [(critic, number) for critic in ("random", "aip", "information") for number in (0, 1, 2, 4)]
    by_training = {
        name: [(row["critic"], row["tries"]) for row in told["rows"] if row["name"] == name and not row["run"]]
        for name in ("privileged", "paper")
    }
    assert by_training["privileged"] == [("where2act", 0), *tries, ("oracle", 0)]
    # An AAP alone has no AIP to choose for it, and is held against the oracle of the other training.
    assert by_training["paper"] == [("where2act", 0), *tries[:4], *tries[8:], ("oracle", 0)]
    assert list(told["gains"]) == ["privileged"]
    with (tmp_path / CSV_FILE).open() as file:
        assert len(list(csv.DictReader(file))) == len(told["rows"])
    assert "AAP, interactions by AIP" in (tmp_path / MARKDOWN_FILE).read_text()
    assert (tmp_path / FIGURE_FILE).read_bytes().startswith(b"\x89PNG")


def test_what_was_seen_is_written_down_from_stage_to_stage(folder: Path) -> None:
    found = trained_in(folder / "seed-1")
    assert found == folder / "seed-1" / "aip-1"
    assert (found / ORACLE_FILE).read_bytes() == (folder / "seed-1" / "aap-1" / ORACLE_FILE).read_bytes()
    hashes = {ref.content_hash for ref in fabricate_setting(objects=3).objects}
    assert objects_seen(found) == objects_seen(folder / "paper") == hashes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["--tries", "-1"], "give numbers from 0 to 64"),
        (["--tries", "12"], "leave 6 to try"),
        (["--draws", "0"], "from 1 to 100"),
        (["--seed", "-1"], "0 or more"),
        (["--threads", "0"], "from 1 to 1024"),
        (["--out", __file__], "no folder can be made of this name"),
        (["--runs", "seed-1"], "give NAME=RUN"),
        (["--runs", "a=nowhere"], "no finished training"),
    ],
)
def test_what_cannot_be_judged_is_said_in_one_line(
    folder: Path, changes: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments(folder, *changes)) == 2
    assert message in capsys.readouterr().err


def test_a_store_of_seen_objects_alone_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = Plan(setting=fabricate_setting(objects=3, points=64))
    make_store(tmp_path / "store", fabricated_rollouts(plan), plan)
    given = ["curve", "--store", str(tmp_path / "store"), "--runs", f"a={folder / 'paper'}"]
    assert run(given) == 2
    assert "have seen all its objects" in capsys.readouterr().err


def test_a_trainings_policy_is_exported_with_a_table(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / MARKDOWN_FILE
    table.write_text("# push\n\nHow much of the gap closed.\n")
    exporting = [
        "export-policy",
        str(folder / "seed-1"),
        "--store",
        str(folder / "store"),
        "--out",
        str(tmp_path / "p"),
    ]
    assert run([*exporting, "--results", str(table), "--origin", "coins"]) == 0
    card = (tmp_path / "p" / "README.md").read_text()
    for told in (
        "coins: 3 to learn from and to validate by",
        "## Results\n\nHow much of the gap closed.\n\n## Limits",
        "`adaafford adapt --policy FOLDER",
    ):
        assert told in card
    assert load_policy(tmp_path / "p").trained == {"prior", "aap", "aip"}
    for wrong, why in (
        (["--results", str(tmp_path / "none.md")], "none.md"),
        (["--store", str(tmp_path)], "is no store"),
    ):
        assert run([*exporting, *wrong]) == 2
        assert why in capsys.readouterr().err
    assert run(["export-policy", str(folder / "seed-1"), "--out", str(tmp_path / "p")]) == 2
    assert "add --store" in capsys.readouterr().err
