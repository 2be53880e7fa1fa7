"""Configuration: defaults under a preset under a file under flags; a run's folder keeps to one."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.main import run
from cluster.config.campaign_config import EXECUTION_SETTINGS, CampaignConfig, EvaluateSettings, RolloutCounts
from cluster.config.flags import early_flags, layered, parse_flags, preset_names
from cluster.runs.run_folder import begin, find
from shared.errors import UsageError
from shared.io.documents import differences


@dataclass(frozen=True, slots=True)
class Command:
    settings: Annotated[CampaignConfig, tyro.conf.arg(name="")]


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_valid(name: str) -> None:
    assert layered(CampaignConfig, name, None).task


def test_later_layers_win(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("seed = 5\n[rollouts]\nrandom = 7\naip = 6\n")
    from_file = layered(CampaignConfig, "smoke", file)
    flags = ["--rollouts.random", "8", "--collection.camera.points", "512"]
    chosen = parse_flags(Command, flags, "run", Command(from_file)).settings
    assert (chosen.seed, chosen.rollouts.random, chosen.rollouts.aip) == (5, 8, 6)
    assert chosen.rollouts.per_shard == layered(CampaignConfig, "smoke", None).rollouts.per_shard
    assert chosen.collection.camera.points == 512


def test_early_flags_are_found_among_others() -> None:
    assert early_flags(["--x.y", "1", "--preset=smoke", "--out", "z"], "preset", "config") == {
        "preset": "smoke",
        "config": None,
    }


@dataclass(frozen=True, slots=True)
class Evaluation:
    settings: Annotated[EvaluateSettings, tyro.conf.arg(name="")] = EvaluateSettings()
    runs: tuple[Path, ...] = ()
    sides: tuple[Literal["left", "right"], ...] = ()


@pytest.mark.parametrize("budgets", [["1,2,4"], ["1", "2", "4"], ["1,2", "4"]])
def test_lists_are_divided_by_commas_or_spaces(budgets: list[str]) -> None:
    flags = ["--budgets", *budgets, "--methods", "where2act,ours-final", "--runs", "a,b", "c"]
    parsed = parse_flags(Evaluation, flags, "evaluate", Evaluation())
    assert parsed.settings.budgets == (1, 2, 4)
    assert parsed.settings.methods == ("where2act", "ours-final")
    assert parsed.runs == (Path("a,b"), Path("c"))


@pytest.mark.parametrize(
    ("flags", "expected"), [(["--budgets", "1,x"], "'x'"), (["--sides", "left,up"], "invalid choice 'up'")]
)
def test_a_wrong_word_in_a_list_is_named(flags: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError) as refused:
        parse_flags(Evaluation, flags, "evaluate", Evaluation())
    assert expected in str(refused.value)
    assert capsys.readouterr().err == ""


ADAPT, COLLECT = ["--cloud", "a.ply", "--history", "h.json"], ["--store", "s"]


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["adapt", *ADAPT, "--polcy", "x"], "unknown --polcy; did you mean --policy?"),
        (["adapt", "--polcy", "x"], "unknown --polcy; did you mean --policy?"),
        (["adapt", "--cloud", "a.ply"], "missing: --history PATH"),
        (["adapt", "--cloud"], "Missing value for argument '--cloud'"),
        (
            ["adapt", *ADAPT, "--intrinsics", "1", "2", "3"],
            "--intrinsics: given 1 2 3; allowed: FLOAT FLOAT FLOAT FLOAT",
        ),
        (["adapt", *ADAPT, "--outcome", "moved"], "--outcome: given moved; allowed: FLOAT"),
        (["adapt", *ADAPT, "--kind", "moved"], "--kind: given 'moved'; allowed: ok, no-contact, "),
        (["collect", *COLLECT, "--workers", "1.5"], "--workers: given '1.5'; allowed: a whole number"),
        (["collect", *COLLECT, "--collection.camera.distance", "far"], "given 'far'; allowed: a number"),
        (
            ["collect", *COLLECT, "--collection.dynamics", "part_mass=2:1"],
            "--collection.dynamics: part_mass=2:1: setting 'dynamics.part_mass': needs low <= high, and low > 0 where "
            "log is set; given 2.0 to 1.0;",
        ),
        (
            ["collect", *COLLECT, "--collection.camera.points", "0"],
            "--collection.camera.points: Input should be greater than or equal to 64; given 0;",
        ),
        (
            ["collect", *COLLECT, "--collection.camera.points", "400", "--collection.camera.candidates", "100"],
            "--collection.camera: candidates (100) must be at least points (400);",
        ),
        (["collect", *COLLECT, "extra"], "unknown extra;"),
        (
            ["train", "prior", *COLLECT, "--out", "o", "--prior.steps", "-1"],
            "--prior.steps: Input should be greater than or equal to 1; given -1;",
        ),
        (
            ["objects", "import", "s", "--out", "o", "--front", "+q"],
            "--front: given '+q'; allowed: +x, -x, +y, -y, +z, -z;",
        ),
    ],
)
def test_wrong_flags_are_one_line(args: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(args) == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.endswith("--help` says more\n")
    assert line.count("\n") == 1


def test_an_unknown_method_is_named_before_a_run_is_looked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", "--run", "none", "--methods", "ours-final,hers"]) == 2
    assert "unknown method 'hers'; allowed: where2act, " in capsys.readouterr().err


values = st.recursive(st.integers(0, 2), lambda inner: st.dictionaries(st.sampled_from("abc"), inner), max_leaves=6)


@given(st.dictionaries(st.sampled_from("abc"), values), st.dictionaries(st.sampled_from("abc"), values))
def test_a_difference_is_found_if_there_is_one(before: dict[str, object], after: dict[str, object]) -> None:
    assert (not list(differences(before, after))) == (before == after)


def test_a_run_folder_remembers_its_configuration(tmp_path: Path) -> None:
    config = CampaignConfig(seed=4, objects=tmp_path)
    run = begin(tmp_path / "run", config)
    assert find(run.path) == (run, config)
    assert begin(tmp_path / "run", config) == run


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    begin(tmp_path / "run", CampaignConfig(seed=4))
    with pytest.raises(UsageError, match=r"holds another run \('rollouts.random' was 100, is now 7\)"):
        begin(tmp_path / "run", CampaignConfig(seed=4, rollouts=RolloutCounts(random=7)))


def test_how_many_workers_there_are_is_no_other_run(tmp_path: Path) -> None:
    run = begin(tmp_path / "run", CampaignConfig(workers=2))
    assert begin(tmp_path / "run", CampaignConfig(workers=0, rollout_limit_s=1.0)) == run
    assert CampaignConfig.model_fields.keys() >= EXECUTION_SETTINGS


def test_a_damaged_configuration_is_one_line(tmp_path: Path) -> None:
    run = begin(tmp_path / "run", CampaignConfig())
    run.config.write_text('{"config": {"sed": 1}}')
    with pytest.raises(UsageError, match="unknown setting 'sed'; did you mean 'seed'"):
        find(run.path)


@pytest.mark.parametrize(
    "text",
    [
        "seed = " + "[" * 20_000,
        "a." * 20_000 + "b = 1",
        "seed = " + "9" * 10_000,
        "seed = 0x" + "f" * 10_000,
        "seed = 1\nseed = 2",
        "seed = nan",
        "\n".join(f"a{k} = 1" for k in range(5000)),
        '"a\\u001b[2J" = 1',
        "x = {a = " * 2000,
    ],
)
def test_a_hostile_file_of_settings_is_refused_with_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(UsageError, match=r"mine\.toml") as caught:
        layered(CampaignConfig, None, tmp_path / "mine.toml")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


def test_a_pipe_of_settings_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "mine.toml")
    with pytest.raises(UsageError, match="not a regular file"):
        layered(CampaignConfig, None, tmp_path / "mine.toml")
