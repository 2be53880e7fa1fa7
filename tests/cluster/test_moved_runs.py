"""Runs that were renamed, moved, copied or reached by another name, and what they need that lies elsewhere."""

import json
import os
import shutil
from pathlib import Path

import pytest

from cluster.campaign.campaign import Campaign
from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import CampaignConfig, SplitConfig
from cluster.evaluation.run_evaluation import _default_out
from cluster.reporting.model_card import PROCEDURAL, source_of_run
from cluster.runs.run_folder import RunFolder, begin, find
from cluster.runs.warm_start import seen_by
from collector.objects.catalogue import scan
from collector.objects.procedural.catalogue import generate
from shared.errors import UsageError
from shared.store import Store
from shared.store.provenance import changed_versions
from tests.support.finished_run import make_finished_run
from tests.support.killed_writers import kill_while_writing


def complaint(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    assert adaafford(list(args)) == 2
    said = capsys.readouterr().err
    assert said.startswith("adaafford: ") and said.count("\n") == 1
    return said


@pytest.fixture
def elsewhere(tmp_path: Path) -> RunFolder:
    """A run on objects that a user has, which are split already."""
    generate(tmp_path / "objects", {"Faucet": 4}, seed=1)
    run = make_finished_run(tmp_path / "own")
    shutil.rmtree(run.path)
    config = CampaignConfig(task="push-faucet", workers=0, alternations=0, objects=tmp_path / "objects")
    run = begin(tmp_path / "run", config)
    refs = [json.loads(entry.ref.model_dump_json()) for entry in scan(tmp_path / "objects").usable]
    used = {"folder": "objects", "train": refs[:2], "validation": [], "test": refs[2:], "refused": []}
    run.objects_file.write_text(json.dumps(used))
    return run


@pytest.fixture
def execute(monkeypatch: pytest.MonkeyPatch) -> list[CampaignConfig]:
    """Takes the place of what a campaign does; the configurations that it was to do."""
    seen: list[CampaignConfig] = []
    monkeypatch.setattr(Campaign, "execute", lambda self: seen.append(self._config))
    return seen


def test_a_run_finds_its_own_objects_wherever_it_is(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "a")
    assert run.objects_folder() == (tmp_path / "a" / "objects").resolve()
    shutil.copytree(run.path, tmp_path / "copy")
    run.path.rename(tmp_path / "b")
    (tmp_path / "link").symlink_to(tmp_path / "b")
    for name in ("b", "copy", "link"):
        found = find(tmp_path / name)[0]
        assert found.objects_folder() == (tmp_path / name).resolve() / "objects"
        assert source_of_run(found, None).origin == PROCEDURAL


def test_a_run_that_lost_its_own_objects_says_so(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "a")
    shutil.rmtree(run.generated_objects)
    with pytest.raises(UsageError, match="own objects are not there any more; restore the folder from a copy"):
        run.objects_folder()


def test_a_run_of_older_software_finds_its_objects_after_it_was_moved(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "a")
    used = json.loads(run.objects_file.read_text()) | {"folder": str((run.path / "objects").resolve())}
    run.objects_file.write_text(json.dumps(used))
    assert not run.places.exists()
    run.path.rename(tmp_path / "b")
    moved, config = find(tmp_path / "b")
    assert moved.objects_folder() == (tmp_path / "b" / "objects").resolve()
    assert begin(tmp_path / "b", config) == moved
    assert source_of_run(moved, None).origin == PROCEDURAL


def test_a_run_of_older_software_knows_the_objects_of_its_user(elsewhere: RunFolder, tmp_path: Path) -> None:
    document = json.loads(elsewhere.config.read_text())
    document["config"]["objects"] = str(tmp_path / "objects")
    elsewhere.config.write_text(json.dumps(document))
    elsewhere.places.unlink()
    assert elsewhere.objects_folder() == tmp_path / "objects"
    assert find(elsewhere.path)[1].objects == tmp_path / "objects"


def test_objects_that_moved_can_be_named_again(
    elsewhere: RunFolder, tmp_path: Path, execute: list[CampaignConfig]
) -> None:
    (tmp_path / "objects").rename(tmp_path / "disk")
    with pytest.raises(
        UsageError, match=rf"not there any more; .* `adaafford resume {elsewhere.path} --objects FOLDER`"
    ):
        elsewhere.objects_folder()
    assert adaafford(["resume", str(elsewhere.path), "--objects", str(tmp_path / "disk")]) == 0
    assert execute[0].objects == tmp_path / "disk"
    assert elsewhere.objects_folder() == tmp_path / "disk"
    assert find(elsewhere.path)[1].objects == tmp_path / "disk"


def test_objects_of_other_content_are_refused(
    elsewhere: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str], execute: list[CampaignConfig]
) -> None:
    generate(tmp_path / "other", {"Faucet": 4}, seed=2)
    before = elsewhere.places.read_bytes()
    said = complaint(capsys, "resume", str(elsewhere.path), "--objects", str(tmp_path / "other"))
    assert "4 of the objects wanted are not there or have other content, such as" in said
    assert elsewhere.places.read_bytes() == before
    assert execute == []


def test_a_run_without_such_a_setting_takes_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], execute: list[CampaignConfig]
) -> None:
    run = make_finished_run(tmp_path / "a")
    said = complaint(capsys, "resume", str(run.path), "--objects", str(tmp_path))
    assert "was begun without 'objects'; leave --objects out" in said
    said = complaint(capsys, "resume", str(run.path), "--start-from", "push-faucet")
    assert "was begun without 'start_from'; leave --start-from out" in said
    assert execute == []


def test_the_same_command_with_moved_objects_says_how_to_go_on(elsewhere: RunFolder, tmp_path: Path) -> None:
    config = CampaignConfig(task="push-faucet", workers=0, alternations=0, objects=tmp_path / "disk")
    with pytest.raises(UsageError, match=rf"`adaafford resume {elsewhere.path} --objects {tmp_path / 'disk'}`"):
        begin(elsewhere.path, config)


def test_what_a_run_publishes_names_no_place(tmp_path: Path) -> None:
    lists = SplitConfig(train_list=tmp_path / "lists" / "train.txt")
    config = CampaignConfig(
        objects=tmp_path / "objects",
        splits=lists,
        start_from=str(tmp_path),
        ray_address="gpu-server:6379",
        object_list=tmp_path / "lists" / "all.txt",
    )
    run = begin(tmp_path / "run", config)
    text = run.config.read_text()
    assert str(tmp_path) not in text and "gpu-server" not in text
    assert find(run.path)[1] == config
    assert begin(run.path, config) == run
    run.places.unlink()
    told = json.loads(text)["config"]
    assert (told["objects"], told["splits"]["train_list"]) == ("./objects", "./train.txt")
    assert told["start_from"] == f"./{tmp_path.name}", "no name of a policy that the package brings"


def test_a_kill_before_the_configuration_was_written_leaves_a_folder_that_is_free(tmp_path: Path) -> None:
    config = CampaignConfig(objects=tmp_path)
    run = begin(tmp_path / "run", config)
    run.config.unlink()
    assert run.places.exists()
    left = kill_while_writing(run.config)
    assert begin(run.path, config) == run
    assert not left.exists()
    run.config.unlink()
    assert begin(run.path, CampaignConfig()) == run
    assert find(run.path)[1].objects is None


def test_what_a_policy_has_seen_is_known_through_a_link(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "a")
    expected = {ref.content_hash for ref in run.objects_used().train}
    for source in (run.path, next(iter((run.store / "policies").iterdir()))):
        assert seen_by(str(source)) == expected
    (tmp_path / "policy").symlink_to(next(iter((run.store / "policies").iterdir())))
    assert seen_by(str(tmp_path / "policy")) == expected


def test_an_evaluation_goes_on_in_its_folder_after_its_objects_were_renamed(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "a")
    setting = Store.open(run.store).setting
    out = _default_out(run.evaluations, "v1", "1", setting, tmp_path / "partnet")
    assert out.name.startswith("push-faucet-partnet-v1-")
    out.mkdir(parents=True)
    assert _default_out(run.evaluations, "v1", "1", setting, tmp_path / "data-2") == out
    assert _default_out(run.evaluations, "v2", "2", setting, tmp_path / "data-2") != out


def test_other_software_is_named_with_what_differs() -> None:
    before = {"numpy": "0.0.1", "ray": "2.0", "sapien": "3.0"}
    now = {"numpy": "2.2", "sapien": "3.0", "torch": "2.7"}
    assert changed_versions(before, now) == "numpy 0.0.1 (now 2.2), ray 2.0 (now none), torch none (now 2.7)"
    assert changed_versions(now, now) == ""


def test_the_working_folder_does_not_matter(elsewhere: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(elsewhere.path.parent)
    config = CampaignConfig.model_validate({"objects": "objects", "task": "push-faucet", "workers": 0})
    run = begin(Path("relative"), config)
    monkeypatch.chdir("/")
    assert os.path.isabs(json.loads((elsewhere.path.parent / run.places).read_text())["objects"])  # noqa: PTH117


@pytest.mark.slow
def test_a_store_of_other_software_is_added_to_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    objects, store = tmp_path / "objects", tmp_path / "store"
    generate(objects, {"Faucet": 1}, seed=1)
    flags = ["--workers", "0", "--collection.camera.points", "64", "--collection.rollout.interactions", "1"]
    command = ["collect", "--task", "push-faucet", "--objects", str(objects), "--store", str(store), *flags]
    assert adaafford([*command, "--rollouts", "1"]) == 0
    assert "other software:" not in capsys.readouterr().err
    monkeypatch.setattr("shared.store.provenance.software_versions", lambda: {"numpy": "99.0"})
    assert adaafford([*command, "--rollouts", "2"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "other software:" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"{store}: begun with other software: ")
    assert "(now 99.0)" in lines[0]
