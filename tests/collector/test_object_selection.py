"""Which objects are used and which are tested on: lists, categories, and refusals in one line."""

import os
from pathlib import Path

import pytest

from cluster.cli.main import run
from cluster.config.campaign_config import CampaignConfig, ObjectSelection, SplitConfig
from cluster.config.objects import lists_of, objects_for, split_as_told
from collector.objects import procedural
from shared.errors import UsageError
from shared.plan import ObjectRef
from shared.tasks import TEST_CATEGORIES, TRAIN_CATEGORIES, expanded, task_named


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shelf")
    procedural.generate(out, {"Box": 3, "Faucet": 2, "Safe": 2, "Table": 1}, seed=3)
    return out


def listed(path: Path, *ids: str) -> Path:
    """A list file of these objects."""
    path.write_text("".join(f"{object_id} {object_id.split('-')[0].title()}\n" for object_id in ids))
    return path


def chosen(shelf: Path, task: str = "push", **selection: object) -> list[str]:
    settings = ObjectSelection.model_validate({"objects": shelf} | selection)
    catalogue, folder = objects_for(task_named(task), settings, shelf / "unused", 1, 0)
    assert folder == shelf
    return [entry.ref.id for entry in catalogue.usable]


def refs(*ids: str) -> tuple[ObjectRef, ...]:
    return tuple(ObjectRef(id=i, category=i.split("-")[0], content_hash="0" * 64) for i in ids)


ALL = refs("Box-0", "Box-1", "Box-2", "Box-3", "Door-0", "Door-1", "Safe-0", "Table-0")


def ids_of(objects: tuple[ObjectRef, ...]) -> set[str]:
    return {ref.id for ref in objects}


def test_the_papers_categories_are_those_that_can_be_made() -> None:
    assert (len(TRAIN_CATEGORIES), len(TEST_CATEGORIES)) == (10, 5)
    assert {*TRAIN_CATEGORIES, *TEST_CATEGORIES} == set(procedural.CATEGORIES)
    assert expanded(["train", "Box", "Lamp"]) == (*TRAIN_CATEGORIES, "Lamp")
    assert expanded(["Box,Lamp", "test"]) == ("Box", "Lamp", *TEST_CATEGORIES)


def test_categories_and_lists_narrow_what_is_used(shelf: Path, tmp_path: Path) -> None:
    some = listed(tmp_path / "some.txt", "box-0001", "safe-0000", "faucet-0001", "box-0009")
    assert len(chosen(shelf)) == 8
    assert chosen(shelf, categories=["test"]) == ["safe-0000", "safe-0001", "table-0000"]
    assert chosen(shelf, categories=["Box", "Table"]) == ["box-0000", "box-0001", "box-0002", "table-0000"]
    assert chosen(shelf, object_list=some) == ["box-0001", "faucet-0001", "safe-0000"]
    assert chosen(shelf, object_list=some, categories=["train"]) == ["box-0001", "faucet-0001"]
    assert chosen(shelf, "push-faucet", object_list=some) == ["faucet-0001"]
    with pytest.raises(UsageError, match=r"none of 8 .* a Box; only Lamp are asked for"):
        chosen(shelf, categories=["Lamp"])


def test_built_in_objects_are_made_of_the_categories_that_are_asked_for(tmp_path: Path) -> None:
    catalogue, folder = objects_for(
        task_named("push"), ObjectSelection(categories=("Box", "Safe")), tmp_path / "made", 1, 0
    )
    assert [entry.ref.id for entry in catalogue.usable] == ["box-0000", "safe-0000"]
    assert folder == tmp_path / "made"


@pytest.mark.parametrize(("task", "category"), [("push", "Lamp"), ("push-faucet", "Box")])
def test_built_in_objects_of_no_use_are_refused_before_any_is_made(tmp_path: Path, task: str, category: str) -> None:
    with pytest.raises(UsageError, match=rf"no built-in '{category}' for the task '{task}'; allowed: .*Faucet"):
        objects_for(task_named(task), ObjectSelection(categories=(category,)), tmp_path / "made", 1, 0)
    assert not (tmp_path / "made").exists()


def test_lists_say_what_is_trained_and_tested_on(tmp_path: Path) -> None:
    train = listed(tmp_path / "train.txt", "Box-0", "Box-1", "Box-2", "Door-0", "gone-0")
    test = listed(tmp_path / "test.txt", "Box-3", "Safe-0")
    both = SplitConfig(train_list=train, test_list=test)
    assert lists_of(both) == (train, test)
    parts = split_as_told(ALL, both, 0)
    assert ids_of(parts.test) == {"Box-3", "Safe-0"}
    assert ids_of(parts.train) | ids_of(parts.validation) == {"Box-0", "Box-1", "Box-2", "Door-0"}
    assert parts.train and parts.validation and not ids_of(parts.train) & ids_of(parts.validation)
    alone = split_as_told(ALL, SplitConfig(train_list=train), 0)
    assert ids_of(alone.test) == {"Box-3", "Door-1", "Safe-0", "Table-0"}
    others = split_as_told(ALL, SplitConfig(test_list=test), 0)
    assert ids_of(others.test) == {"Box-3", "Safe-0"}
    assert len(others.train) + len(others.validation) == 6
    assert lists_of(SplitConfig(train_list=train)) == ()


def test_categories_may_be_kept_for_the_test(tmp_path: Path) -> None:
    parts = split_as_told(ALL, SplitConfig(test_categories=("test",)), 0)
    assert ids_of(parts.test) == {"Safe-0", "Table-0"}
    assert ids_of(parts.train) | ids_of(parts.validation) == ids_of(ALL) - ids_of(parts.test)
    assert split_as_told(ALL[::-1], SplitConfig(test_categories=("test",)), 0) == parts


def test_nothing_is_tested_on_that_is_trained_on(tmp_path: Path) -> None:
    train, test = listed(tmp_path / "train.txt", "Box-0", "Box-1"), listed(tmp_path / "test.txt", "Box-1")
    with pytest.raises(UsageError, match=r"'Box-1' is in .*train.txt too"):
        split_as_told(ALL, SplitConfig(train_list=train, test_list=test), 0)
    with pytest.raises(ValueError, match="not by both"):
        SplitConfig(test_list=test, test_categories=("test",))


def test_a_run_may_be_resumed_from_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = CampaignConfig(object_list=Path("all.txt"), splits=SplitConfig(test_list=Path("test.txt")))
    assert (config.object_list, config.splits.test_list) == (tmp_path / "all.txt", tmp_path / "test.txt")


def make_hostile(path: Path, how: str) -> Path:
    """A list that must not be believed."""
    match how:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "huge":
            path.write_bytes(b"a Box\n" * 200_000)
        case "binary":
            path.write_bytes(bytes(range(256)))
        case "escape":
            path.write_text("../../etc Box\n")
        case "long":
            path.write_text("x" * 5000 + " Box\n")
        case "control":
            path.write_text("a\x1b[2J Box\n")
    return path


@pytest.mark.parametrize("how", ["pipe", "folder", "huge", "binary", "escape", "long", "control", "missing"])
@pytest.mark.parametrize("command", ["check", "collect", "run"])
def test_a_hostile_list_is_refused_with_one_line(
    shelf: Path, tmp_path: Path, how: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(make_hostile(tmp_path / "list.txt", how))
    match command:
        case "check":
            args = ["objects", "check", str(shelf), "--object-list", path]
        case "collect":
            args = ["collect", "--objects", str(shelf), "--object-list", path, "--store", str(tmp_path / "store")]
        case _:
            args = ["run", "--objects", str(shelf), "--task", "push", "--splits.test-list", path]
            args += ["--out", str(tmp_path / "run"), "--workers", "0"]
    assert run(args) == 2
    captured = capsys.readouterr()
    line = captured.err.splitlines()[-1]
    assert line.startswith(f"adaafford: {path}: ")
    assert "Traceback" not in captured.err
    assert "\x1b" not in line
    assert len(line) < 400


def test_check_takes_a_list_and_categories(shelf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = listed(tmp_path / "some.txt", "box-0001", "safe-0000")
    assert run(["objects", "check", str(shelf), "--object-list", str(some), "--categories", "test"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "box-0001  refused: a Box; only Table, WashingMachine, Bucket, KitchenPot, Safe are asked for",
        "safe-0000  usable: Safe, 2 movable parts",
        "1 usable, 1 refused",
    ]
