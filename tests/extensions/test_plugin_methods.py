"""The example package: what it adds is collected, trained, judged and listed without a change in ours."""

from pathlib import Path

import pytest

from cluster.cli.main import run
from learner.data.dataset import load_dataset
from learner.data.features import FrozenFeatures
from learner.evaluation.table import evaluate_store
from learner.settings import LearnerConfig
from learner.stages.jobs import StageJob, read_policy_folder, run_stage
from learner.stages.trainers import check_baselines, row_critic, settings_of
from shared.errors import StoreError, UsageError
from shared.plan import Plan, found_by_name
from shared.policies.adaptation import Adapter
from shared.policies.critics import critic_named
from shared.policies.methods import BASELINES
from shared.policies.policy import Policy
from shared.store import Store
from shared.tasks import read_task
from shared.types import Interaction
from tests.learner.test_baselines import as_evaluation
from tests.support.example_package import PACKAGE, install_here
from tests.support.small_networks import TINY
from tests.support.small_trainings import FAST, fabricated_plan, fabricated_rollouts, make_store

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = "camera = {image_size = 64, points = 64, candidates = 64}\nrollout = {interactions = 4, context = 2}\n"
LEARNER = FAST.model_copy(update={"baselines": {"surprise": {"steps": 20, "validate_every": 10, "learning_rate": 0.1}}})


@pytest.fixture(autouse=True)
def _installed(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package installed in this process, for one test."""
    install_here(tmp_path_factory.mktemp("site-packages"), monkeypatch)


def test_its_task_and_its_proposer_collect(tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text(f"[collection]\n{SMALL}")
    command = ["collect", "--store", str(tmp_path / "store"), "--workers", "0", "--rollouts", "2"]
    command += ["--categories", "Box", "--procedural-per-category", "1", "--config", str(tmp_path / "settings.toml")]
    assert run([*command, "--task", "push-lid", "--proposer", "furthest"]) == 0
    store = Store.open(tmp_path / "store")
    assert store.setting.terms.dynamics["part_mass"].high == 2.0
    assert {job.plan_key for job in store.jobs()} == {"furthest-v0"}
    rollouts = [rollout for job in store.jobs() for rollout in store.read_rollouts(job.shard_id)]
    proposers = {row.proposer for rollout in rollouts for row in rollout.interactions}
    assert proposers == {"furthest", "random"}
    assert store.setting.extensions == (f"task push-lid: {PACKAGE}",)
    assert {store.manifest(job).provenance["proposer"] for job in store.jobs()} == {PACKAGE}


def test_a_proposer_without_networks_takes_no_policy(tmp_path: Path) -> None:
    command = ["collect", "--store", str(tmp_path / "store"), "--proposer", "furthest", "--policy", "1"]
    assert run(command) == 2
    assert not (tmp_path / "store").exists()


def test_the_file_in_the_examples_defines_a_task() -> None:
    assert read_task(EXAMPLES / "push-lid.toml").name == "push-light-lid"


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """Folders of all stages, each starting from the one before."""
    before: Path | None = None
    make_store(tmp_path / "store")
    for stage in ("prior", "aap", "aip", "surprise"):
        run_stage(StageJob(stage, tmp_path / "store", tmp_path / stage, before), LEARNER)
        before = tmp_path / stage
    return tmp_path


def test_its_baseline_is_trained_judged_and_listed(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = read_policy_folder(trained / "surprise")
    assert policy.trained == {"prior", "aap", "aip", "surprise"}
    assert float(policy.modules()["surprise"].get_parameter("weight")) != 0.0
    plan = fabricated_plan()
    rollouts = [as_evaluation(rollout, ("ours-final", "surprise")) for rollout in fabricated_rollouts(plan, 3)]
    store = make_store(trained / "judged", rollouts, plan)
    store.publish_policy(1, policy.to_files())
    table = {(row.method, row.budget): row for row in evaluate_store(store, 1, (2, 4))}
    assert {("surprise", 2), ("surprise", 4)} <= table.keys()
    assert table["surprise", 4].bce != table["where2act", 0].bce
    # What a row is worth is what the same action is worth before a camera.
    record, dataset = fabricated_rollouts(plan)[0], load_dataset(Store.open(trained / "store"), TINY)
    rows = record.interactions
    history = [Interaction(record.observations[row.observation], row.action, row.outcome) for row in rows[:4]]
    seen = critic_named("surprise", Adapter(policy)).predict(
        record.observations[rows[5].observation], [rows[5].action], history
    )
    index = dataset.rollouts[0]
    stored = row_critic("surprise", policy, FrozenFeatures(dataset))(index[5:6], index[:4])
    assert seen[0] == pytest.approx(float(stored[0]), abs=1e-4)
    # Without the package the policy is refused in a line, and the settings of a misspelt one are, too.
    with pytest.raises(UsageError, match=r"baselines\.surprise: unknown setting 'stpes'; did you mean 'steps'"):
        settings_of(LearnerConfig(baselines={"surprise": {"stpes": 3}}), "surprise")
    for table, said in (
        ("where2act-adaptation", "belong into the table 'adaptation'"),
        ("surprize", "unknown baseline"),
    ):
        with pytest.raises(UsageError, match=said):
            check_baselines(LearnerConfig(baselines={table: {"steps": 3}}))
    monkeypatch.setattr(BASELINES, "group", "nothing")
    with pytest.raises(StoreError, match="has the network 'surprise'; install the package"):
        Policy.from_files(policy.to_files())


def test_a_setting_says_whose_methods_it_uses() -> None:
    setting = fabricated_plan().setting
    config = {"methods": ("surprise", "ours-final"), "budgets": (1,), "queries": 1}
    told = type(setting).model_validate(setting.as_document() | {"kind": "evaluation", "evaluation": config})
    assert [
        name for registry, name in found_by_name(told.task_record, told.evaluation) if registry.package_of(name)
    ] == [
        "surprise",
        "furthest",
        "surprise",
    ]
    assert Plan(setting=told, proposer="evaluation", policy_version=1).most_tries == 1
