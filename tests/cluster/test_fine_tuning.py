"""A run that starts from a policy: fine-tuned on other objects, judged on those that nobody has seen."""

import json
from pathlib import Path

import pytest

from adaafford.pretrained import load_policy
from cluster.campaign.campaign import steps_of
from cluster.campaign.estimate import estimate
from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import CampaignConfig, EvaluateSettings
from cluster.evaluation.run_evaluation import evaluate_run
from cluster.runs.run_folder import RunFolder
from cluster.runs.warm_start import seen_by, warm_start
from collector.objects.catalogue import scan
from collector.objects.procedural import generate
from learner.stages.jobs import read_policy_folder
from shared.plan import ObjectRef
from shared.store import Store
from tests.support.as_toml import as_toml
from tests.support.finished_run import make_finished_run
from tests.support.small_trainings import FAST


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_finished_run(tmp_path_factory.mktemp("source") / "run", objects=6)


def test_the_stages_begin_with_what_is_adopted() -> None:
    config = CampaignConfig.model_validate({"task": "push-faucet", "alternations": 1, "start_from": "push-faucet"})
    names = [step.name for step in steps_of(config)]
    begun = ["objects", "collect-random", "adopt", "publish-1", "collect-aip-1", "train-aap-2", "train-aip-2"]
    assert names[: len(begun)] == begun
    costs = [stage.stage for stage in estimate(config).stages]
    assert costs[:4] == ["collect-random", "collect-aip-1", "train-aap-2", "train-aip-2"]


def test_what_is_adopted_remembers_what_it_has_seen(source: RunFolder, tmp_path: Path) -> None:
    warm_start(str(source.path), "push-faucet", tmp_path)
    seen = set(json.loads((tmp_path / "done.json").read_text())["objects"])
    assert seen == {ref.content_hash for ref in source.objects_used().train} == seen_by(str(source.path))
    assert read_policy_folder(tmp_path).trained >= {"prior", "aap", "aip"}


def test_what_a_policy_has_seen_is_found_by_whatever_it_is_called(source: RunFolder, tmp_path: Path) -> None:
    seen = seen_by(str(source.path))
    assert adaafford(["export-policy", str(source.path), "--out", str(tmp_path / "exported")]) == 0
    version = source.store / "policies" / "000001"
    for place in (tmp_path / "exported", tmp_path / "exported" / "weights.safetensors", version):
        load_policy(place)
        assert seen_by(str(place)) == seen
    (tmp_path / "exported" / "done.json").unlink()
    assert not seen_by(str(tmp_path / "exported"))


def test_the_policies_that_come_along_say_what_they_have_seen(tmp_path: Path) -> None:
    made = {seed: tmp_path / str(seed) for seed in (51, 2)}
    for seed, folder in made.items():
        generate(folder, {"Faucet": 5}, seed)
    contents = {seed: {entry.ref.content_hash for entry in scan(folder).usable} for seed, folder in made.items()}
    # It was trained on, or judged by, 240 of 300 faucets of seed 51.
    seen = seen_by("push-faucet")
    assert len(seen) == 240
    assert seen & contents[51]
    assert not seen & contents[2]
    assert seen_by("pull-closed-door")


@pytest.mark.parametrize("name", ["pull", "pull-closed-door", "push-faucet"])
def test_a_policy_does_not_say_what_its_predecessor_has_seen(name: str) -> None:
    assert seen_by(name)
    assert not seen_by(name) & seen_by(f"{name}-sparse")


@pytest.mark.slow
def test_a_run_that_started_from_a_policy_is_not_evaluated_on_what_that_has_seen(
    source: RunFolder, tmp_path: Path
) -> None:
    made = make_finished_run(tmp_path / "run", objects=2)  # Of the same objects, and trained on fewer.
    warm_start(str(source.path), "push-faucet", made.adopted)
    used = made.objects_used()
    own = {ref.content_hash for ref in used.train}
    assert seen_by(str(made.path)) == own | seen_by(str(source.path)) > own
    told = EvaluateSettings(objects=source.objects_folder(), methods=("where2act",), trials=1, queries=1)
    evaluate_run(made.path, told.model_copy(update={"workers": 0}), tmp_path / "out")
    tested = {ref.content_hash for ref in Store.open(tmp_path / "out" / "store").setting.objects}
    assert tested
    assert not tested & (own | seen_by(str(source.path)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--start-from", "no-such-policy"], "no policy 'no-such-policy'"),
        (["--start-from", "pull-closed-door"], "a policy for 'pull-closed-door', but the run is of 'push-faucet'"),
        (["--start-from", "push-faucet", "--alternations", "0"], "alternations must be at least 1"),
    ],
)
def test_what_cannot_be_started_from_is_said_in_a_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = ["--task", "push-faucet", "--workers", "0", "--procedural.per-category", "4", "--out", str(tmp_path / "run")]
    assert adaafford(["run", *told, *arguments]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_a_run_goes_on_from_another_on_other_objects(source: RunFolder, tmp_path: Path) -> None:
    settings = {name: getattr(FAST, name).model_dump(mode="json") for name in ("prior", "aap", "aip")}
    config = {
        "start_from": str(source.path),
        "rollouts": {"random": 6, "aip": 6, "evaluation": 2},
        "collection": {"camera": {"points": 256, "image_size": 128}, "rollout": {"interactions": 8, "continued": 2}},
        "learner": settings,
        "evaluation": {"methods": ["ours-no-iteration", "ours-final"], "budgets": [1], "queries": 2},
    }
    (tmp_path / "c.toml").write_text(as_toml(config))
    told = ["--task", "push-faucet", "--workers", "0", "--seed", "5", "--procedural.per-category", "8"]
    made = tmp_path / "run"
    assert adaafford(["run", "--config", str(tmp_path / "c.toml"), *told, "--out", str(made)]) == 0
    rows = json.loads((made / "training" / "evaluate" / "results.json").read_text())["rows"]
    assert {row["method"] for row in rows} >= {"ours-no-iteration", "ours-final"}
    tested: set[ObjectRef] = set(RunFolder(made).objects_used().test)
    assert tested
    assert not {ref.content_hash for ref in tested} & seen_by(str(source.path))
    learned = json.loads((made / "training" / "aip-2" / "done.json").read_text())["objects"]
    assert set(learned) >= seen_by(str(source.path))
