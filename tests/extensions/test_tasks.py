"""Tasks that a TOML file defines: what is said of bad ones, and that settings and stores hold all of a good one."""

import json
from pathlib import Path

import pytest

from cluster.cli.commands.collect import CollectSettings
from cluster.cli.main import run
from cluster.config.campaign_config import CampaignConfig
from cluster.config.flags import layered
from shared.config import parse
from shared.errors import StoreError, UsageError
from shared.plan import Setting
from shared.store import Store
from shared.tasks import TASKS, Task, read_task, task_of
from tests.support.fabricate import fabricate_setting

DOOR = """
name = "pull-door"
primitive = "pull"
part_names = ["door"]
closed = true
edge_share = 0.5
dynamics.joint_friction = {low = 0.1, high = 5.0, log = true}
"""
SMALL = "[camera]\nimage_size = 64\npoints = 64\ncandidates = 64\n[rollout]\ninteractions = 2\n"


@pytest.fixture
def door(tmp_path: Path) -> Path:
    file = tmp_path / "door.toml"
    file.write_text(DOOR)
    return file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('name = "push"\nprimitive = "push"', "there is already a task 'push'; choose another name"),
        ('name = "a/b"\nprimitive = "push"', "setting 'name': String should match"),
        ('name = "open"\nprimitve = "push"', "unknown setting 'primitve'; did you mean 'primitive'?"),
        ('name = "open"', "setting 'primitive': Field required"),
        ('name = "open"\nprimitive = "push"\npart_names = [""]', "setting 'part_names.0': String should have"),
        ('name = "open"\nprimitive = "push"\ndirections = []', "setting 'directions': Tuple should have at least 1"),
        ('name = "open"\nprimitive = "push"\nedge_share = 2', "setting 'edge_share': Input should be less"),
        ('name = "open"\nprimitive = "shove"', "unknown primitive 'shove'; allowed: push, push-left"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_task_file_with_a_mistake_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "task.toml"
    file.write_text(text)
    with pytest.raises(UsageError) as refused:
        read_task(file)
    assert str(refused.value).startswith(f"{file}: {said}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("command", [["collect", "--store"], ["run", "--out"], ["bench", "collect", "--out"]])
def test_the_mistake_in_a_task_file_is_what_a_command_says(
    tmp_path: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "task.toml").write_text('name = "open"\nprimitive = "push"\nclosd = true')
    assert run([*command, str(tmp_path / "new"), "--task", str(tmp_path / "task.toml")]) == 2
    assert "task.toml: unknown setting 'closd'; did you mean 'closed'?" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_settings_take_up_what_the_file_says(door: Path, tmp_path: Path) -> None:
    settings = CampaignConfig(task=str(door))
    assert settings.task == "pull-door"
    assert settings.task_record == read_task(door) == task_of(str(door))
    document = json.loads(settings.model_dump_json())
    door.unlink()
    assert parse(CampaignConfig, document, "config.json") == settings
    assert parse(CampaignConfig, document | {"task": "push"}, "config.json").task_record == TASKS.get("push")


def test_a_file_of_settings_may_name_the_file_of_a_task(door: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text(f"task = '{door}'\nrollouts = 3")
    assert layered(CollectSettings, None, tmp_path / "settings.toml").task_record.part_names == ("door",)


def test_a_setting_of_a_built_in_task_is_written_as_before() -> None:
    setting = fabricate_setting()
    assert "task_definition" not in setting.as_document()
    assert "task_definition" not in json.loads(setting.model_dump_json())
    assert "task_definition" not in json.loads(CampaignConfig().model_dump_json())


def test_a_store_holds_the_task_that_a_file_defined(door: Path, tmp_path: Path) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(SMALL.replace("[", "[collection."))
    command = [
        "collect",
        "--store",
        str(tmp_path / "store"),
        "--workers",
        "0",
        "--rollouts",
        "1",
        "--task",
        str(door),
    ]
    command += ["--categories", "StorageFurniture", "--procedural-per-category", "1", "--config", str(settings)]
    assert run(command) == 0
    task = read_task(door)
    door.unlink()
    store = Store.open(tmp_path / "store")
    assert (store.setting.task, store.setting.task_record) == ("pull-door", task)
    assert store.setting.terms.dynamics["joint_friction"].high == 5.0
    door.write_text(DOOR.replace("5.0", "6.0"))
    with pytest.raises((StoreError, UsageError), match="joint_friction"):
        Store.create(tmp_path / "store", store.setting.model_copy(update={"task_definition": read_task(door)}))


def test_a_setting_names_the_task_that_it_defines() -> None:
    document = fabricate_setting().as_document() | {
        "task_definition": Task(name="other", primitive="push").as_document()
    }
    with pytest.raises(ValueError, match="'other' is defined"):
        Setting.model_validate(document)
