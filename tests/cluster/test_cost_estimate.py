"""The cost of a campaign, told beforehand: of the stages that there will be, and without a trace."""

import dataclasses
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster.campaign.campaign import steps_of
from cluster.campaign.estimate import RATES, Estimate, Rates, StageCost, estimate, multiply_adds
from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import CampaignConfig, RolloutCounts, SplitConfig
from cluster.config.flags import layered
from collector.objects.catalogue import for_task, scan, split
from collector.objects.procedural import generate
from learner.alternation import Publish
from shared.networks.network_config import NETWORKS
from shared.policies.methods import METHODS
from shared.tasks import task_named

KEEP = "--collection.camera.keep-depth"
RATE_VALUES = {name: rate for name, rate in dataclasses.asdict(RATES).items() if name != "measured"}


def stage(found: Estimate, name: str) -> StageCost:
    return next(each for each in found.stages if each.stage == name)


@given(
    alternations=st.integers(0, 3),
    adopts=st.booleans(),
    methods=st.sets(st.sampled_from(METHODS.names()), min_size=1).map(sorted),
)
@settings(max_examples=10)
def test_what_a_campaign_does_is_what_is_paid_for(alternations: int, adopts: bool, methods: list[str]) -> None:
    told = {"alternations": alternations + adopts, "start_from": "push-faucet" if adopts else None}
    config = CampaignConfig.model_validate({**told, "evaluation": {"methods": methods}})
    found = estimate(config)
    paid = {each.stage: each for each in found.stages}
    steps = steps_of(config)
    assert list(paid) == [step.name for step in steps if step.name in paid]
    for step in steps:
        free = step.name in ("objects", "adopt", "report") or isinstance(step, Publish)
        assert free != (step.name in paid)
    assert all(each.core_s > 0 and each.size_bytes > 0 for each in found.stages)
    doubled = estimate(config, Rates("twice", **{name: 2 * rate for name, rate in RATE_VALUES.items()}))
    assert sum(each.core_s for each in doubled.stages) == pytest.approx(2 * sum(each.core_s for each in found.stages))


def test_the_published_scale_is_the_published_one() -> None:
    """972 shapes; 4 draws of 32 interactions each; 10 trials a test shape of every method."""
    config = layered(CampaignConfig, "paper", None)
    found = estimate(config)
    train, validation, test = found.objects
    assert train + validation + test == pytest.approx(972, abs=5)
    assert stage(found, "collect-random").interactions == (train + validation) * 4 * 32
    assert set(config.evaluation.methods) == {name for name in METHODS.names() if not METHODS.get(name).reference}
    assert config.learner.network == NETWORKS["published"]
    assert stage(found, "evaluate").interactions % (10 * test) == 0


def test_cost_grows_with_what_is_asked_for() -> None:
    def of(**changes: object) -> Estimate:
        return estimate(CampaignConfig.model_validate({"task": "push", **changes}))

    once, twice = of(rollouts={"random": 80}), of(rollouts={"random": 160})
    assert stage(twice, "collect-random").core_s == pytest.approx(2 * stage(once, "collect-random").core_s)
    assert stage(twice, "collect-random").size_bytes == pytest.approx(2 * stage(once, "collect-random").size_bytes)
    exact = of(collection={"fidelity": {"name": "reference"}})
    assert stage(exact, "collect-random").core_s > 5 * stage(once, "collect-random").core_s
    assert stage(of(task="pull"), "collect-random").core_s > stage(once, "collect-random").core_s
    some, all_methods = of(evaluation={"methods": ["where2act"]}), of(evaluation={"methods": METHODS.names()})
    assert stage(all_methods, "evaluate").core_s > 3 * stage(some, "evaluate").core_s


def test_a_share_costs_an_action_at_each_budget_and_aip_its_tries_again() -> None:
    def evaluated(**told: object) -> int:
        methods = {"methods": ["where2act", "ours-random", "ours-final"], "budgets": [1, 4]}
        config = CampaignConfig.model_validate({"task": "push", "evaluation": methods | told})
        return stage(estimate(config), "evaluate").interactions

    trials = CampaignConfig().rollouts.evaluation
    assert evaluated(exploit_share=0.01) - evaluated() == trials * (3 * 2 + 4)
    assert evaluated(repeats=True) - evaluated() == trials * 2 * 2


def test_rates_are_of_their_stages_alone() -> None:
    config = CampaignConfig(task="pull")
    slow = dataclasses.replace(RATES, pull_s=10 * RATES.pull_s)
    before, after = estimate(config), estimate(config, slow)
    changed = [one.stage for one, two in zip(before.stages, after.stages, strict=True) if one != two]
    assert changed == ["collect-random", "collect-aip-1", "evaluate"]


def test_depth_images_cost_time_and_disk_where_they_are_kept() -> None:
    kept = {"camera": {"keep_depth": True}}
    without = estimate(CampaignConfig())
    stored = estimate(CampaignConfig.model_validate({"collection": kept}))
    profiled = estimate(
        CampaignConfig.model_validate({"collection": kept, "learner": {"network": {"pinch_profile": True}}})
    )
    clouds = CampaignConfig().rollouts.random * CampaignConfig().collection.rollout.interactions
    added = stage(stored, "collect-random").size_bytes - stage(without, "collect-random").size_bytes
    assert 0 < added <= clouds * 448**2 * RATES.depth_pixel_bytes
    for name in ("collect-random", "collect-aip-1", "evaluate"):
        assert stage(stored, name).core_s > stage(without, name).core_s
    for name in ("train-prior", "train-aap-1", "train-aip-1", "train-aap-2", "evaluate"):
        assert stage(profiled, name).core_s > stage(stored, name).core_s
    larger = {"camera": {"keep_depth": True, "image_size": 896}}
    doubled = estimate(CampaignConfig.model_validate({"collection": larger}))
    assert stage(doubled, "evaluate").size_bytes > stage(stored, "evaluate").size_bytes


def test_a_dry_run_counts_the_depth_images_that_a_policy_needs(capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for flags in (["--learner.network.pinch-profile"], ["--learner.network.pinch-profile", KEEP], [KEEP], []):
        assert adaafford(["run", "--dry-run", *flags]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1]
    assert len(set(said)) == 3


def test_larger_networks_and_clouds_cost_more() -> None:
    small, published = (NETWORKS[name] for name in ("small", "published"))
    assert multiply_adds(small, 2048) < multiply_adds(small, 4096) < multiply_adds(published, 10_000)


def test_counts_may_be_of_each_object() -> None:
    assert RolloutCounts().total(4, 10) == 4
    assert RolloutCounts(per_object=True).total(4, 10) == 40


def test_a_dry_run_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert adaafford(["run", "--dry-run", "--preset", "laptop", "--out", "run"]) == 0
    out = capsys.readouterr().out
    assert "collect-random" in out
    assert "48,000" in out
    assert "measured" in out
    assert list(tmp_path.iterdir()) == []


def test_a_run_needs_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert adaafford(["run"]) == 2
    assert "needs --out FOLDER" in capsys.readouterr().err


def test_the_objects_of_a_folder_are_counted_as_they_will_be_split(tmp_path: Path) -> None:
    generate(tmp_path, {"Faucet": 8, "Box": 1}, seed=1)
    found = estimate(CampaignConfig(task="push-faucet", objects=tmp_path))
    entries = for_task(scan(tmp_path), task_named("push-faucet")).usable
    parts = split([entry.ref for entry in entries], SplitConfig().fractions, CampaignConfig().seed)
    assert found.objects == (len(parts.train), len(parts.validation), len(parts.test))
    assert sum(found.objects) == 8
