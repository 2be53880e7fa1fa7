"""A hidden parameter of another package: drawn, applied, stored, digested, told to the oracle and reported."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cluster.cli.commands.collect import CollectCommand
from cluster.cli.main import run
from cluster.config.flags import parse_flags
from cluster.reporting.counterfactuals import variations
from cluster.reporting.style import hidden
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from learner.data.dataset import FACTS_WIDTH, load_dataset
from learner.data.features import FrozenFeatures
from learner.stages.jobs import StageJob, run_stage
from learner.stages.oracle import Teacher, read_oracle
from learner.stages.trainers import ORACLE_FILE
from shared.config import FIDELITIES, CollectionConfig, DynamicsRanges, Range, parse
from shared.errors import StoreError, UsageError
from shared.geometry import gripper_rotation
from shared.hidden import ALWAYS_DRAWN, HiddenParameter
from shared.plan import Job, Plan
from shared.primitives import PRIMITIVES
from shared.store import Store, compact, export, merge, repair, verify
from shared.store.codecs.columns import ROLLOUT_COLUMNS, added_column
from shared.store.codecs.tables import read_table
from shared.store.maintenance.export import splits_by_share
from shared.types import Action, HiddenDynamics
from tests.store.test_compatibility import add_column, shards_of
from tests.support.example_package import PACKAGE, install_here
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.single_door import door, drawer
from tests.support.small_networks import TINY
from tests.support.small_trainings import FAST as TRAINING

FAST, PUSH = FIDELITIES["fast"], PRIMITIVES.get("push")
NAME, COLUMN = "joint_damping", "hidden_joint_damping"
OURS = {"part_mass": 0.5, "joint_friction": 0.0, "surface_friction": 1.0}
COLLECT = (
    *("collect", "--task", "push-faucet", "--procedural-per-category", "4", "--workers", "0", "--per-shard", "2"),
    *("--collection.camera.points", "128", "--collection.camera.candidates", "1000", "--rollouts", "4"),
    *("--collection.rollout.interactions", "4", "--seed", "3"),
)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_here(tmp_path / "site", monkeypatch)


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store of our parameters alone, and one with joint damping besides."""
    folder = tmp_path_factory.mktemp("hidden")
    assert run([*COLLECT, "--store", str(folder / "plain")]) == 0
    with pytest.MonkeyPatch.context() as monkeypatch:
        install_here(folder / "site", monkeypatch)
        assert run([*COLLECT, "--store", str(folder / "damped"), "--collection.dynamics", NAME]) == 0
    added_column.cache_clear()
    return folder / "plain", folder / "damped"


def fabricated(path: Path, added: dict[str, float]) -> Store:
    """A store of two small shards with values for further parameters, of packages that nobody has."""
    base = fabricate_setting()
    ranges = DynamicsRanges.model_validate({name: {"low": 0.0, "high": 10.0} for name in added})
    setting = base.model_copy(update={"collection": base.collection.model_copy(update={"dynamics": ranges})})
    plan, store = Plan(setting=setting), Store.create(path, setting)
    for start in range(2):
        job = Job(plan.key, start, start + 1)
        store.commit(plan, job, [with_values(each, added) for each in fabricate_rollouts(plan, job, 2)], {})
    return store


def with_values(rollout: Any, added: dict[str, float]) -> Any:
    dynamics = HiddenDynamics(rollout.dynamics.values, rollout.dynamics.direction, **added)
    return replace(rollout, dynamics=dynamics)


# Physics


@pytest.mark.parametrize("make", [drawer, door])
def test_a_damped_joint_coasts_as_far_as_its_speed_over_the_rate(make: Any, installed: None) -> None:
    for rate in (2.0, 10.0):
        scene = Scene(make(), HiddenDynamics(OURS, joint_damping=rate), FAST, PUSH)
        scene.put(np.zeros(1))
        scene._articulation.set_qvel(np.array([0.4], dtype=np.float32))
        for _ in range(3 * FAST.approach.steps_per_second):
            scene.system.step()
        assert scene.joint_positions()[0] == pytest.approx(0.4 / rate, rel=0.06)


def test_the_more_a_joint_is_damped_the_less_the_same_push_moves_it(installed: None) -> None:
    motions = []
    for rate in (0.0, 1.0, 5.0, 20.0):
        scene = Scene(drawer(), HiddenDynamics({**OURS, NAME: rate, "joint_friction": 0.05}), FAST, PUSH)
        scene.put(np.zeros(1))
        action = Action(0, np.zeros(3), gripper_rotation(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])))
        motions.append(Trial(scene, action, 1, PUSH, FAST).run().motion)
    assert all(less < more for more, less in pairwise(motions)), motions


def test_a_draw_of_a_package_that_is_not_installed_is_not_simulated() -> None:
    with pytest.raises(UsageError, match="unknown hidden parameter 'joint_damping'; allowed: part_mass,"):
        Scene(drawer(), HiddenDynamics(OURS, joint_damping=1.0), FAST, PUSH)


# Collection and learning, the package being installed in the collection alone


def test_it_is_drawn_stored_and_digested_and_changes_no_draw_of_ours(stores: tuple[Path, Path]) -> None:
    plain, damped = map(Store.open, stores)
    assert plain.document.schema_version == 1
    assert {manifest.schema_version for manifest in plain.committed()} == {1}
    assert damped.document.schema_version == 2
    assert {manifest.schema_version for manifest in damped.committed()} == {2}
    assert damped.setting.as_document()["collection"]["dynamics"][NAME] == {"low": 0.0, "high": 20.0, "log": False}
    known, table = plain.rollouts(), damped.rollouts()
    assert COLUMN not in known.column_names
    rates = table.column(COLUMN).to_numpy()
    assert len(set(rates)) == 4
    assert ((rates > 0) & (rates < 20)).all()
    for name in (*ALWAYS_DRAWN, "direction", "azimuth_deg", "object_id"):
        assert known.column(name).to_pylist() == table.column(name).to_pylist(), name
    assert plain.digest() != damped.digest()
    assert (plain.setting.extensions, damped.setting.extensions) == ((), (f"hidden parameter {NAME}: {PACKAGE}",))
    assert verify(plain) == verify(damped) == []
    rows = {row["rollout"]: row[COLUMN] for row in damped.interactions(["rollout", COLUMN]).to_pylist()}
    assert rows == {k: rate for k, rate in enumerate(rates) if k in rows}


def test_a_store_that_lacks_it_has_its_default(
    stores: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Store.open(stores[0])
    with pytest.raises(UsageError, match=f"no column '{COLUMN}' in the interactions"):
        plain.interactions([COLUMN])
    install_here(tmp_path / "site", monkeypatch)
    assert set(plain.interactions(["success", COLUMN]).column(COLUMN).to_pylist()) == {0.0}
    assert COLUMN not in plain.interactions().column_names


def test_the_oracle_is_told_where_it_lies_in_its_range(stores: tuple[Path, Path], tmp_path: Path) -> None:
    ours, known = (load_dataset(Store.open(path), TINY) for path in stores)
    assert ours.rows.facts.shape[1] == FACTS_WIDTH
    assert known.rows.facts.shape[1] == FACTS_WIDTH + 1
    told = known.rows.facts[:, len(ALWAYS_DRAWN)].numpy()
    rows = Store.open(stores[1]).interactions(["outcome", COLUMN]).to_pylist()
    np.testing.assert_allclose(told, [row[COLUMN] / 10.0 - 1.0 for row in rows], rtol=1e-5)
    prior = run_stage(StageJob("prior", stores[1], tmp_path / "prior"), TRAINING)
    assert prior.trained
    run_stage(StageJob("aap", stores[1], tmp_path / "aap", init=tmp_path / "prior"), TRAINING)
    oracle = read_oracle(tmp_path / "aap" / ORACLE_FILE, TINY)
    assert len(Teacher.of(oracle, FrozenFeatures(known)).scores) == len(known.rows)
    with pytest.raises(UsageError, match="18 hidden facts of a row, the store tells 17"):
        Teacher.of(oracle, FrozenFeatures(ours))


def test_the_report_varies_it_and_names_it(stores: tuple[Path, Path], installed: None) -> None:
    setting = Store.open(stores[1]).setting
    found = {variation.name: variation for variation in variations(setting, drawer(), [])}
    cases = found["joint damping"].cases
    assert [case.label for case in cases] == ["joint damping 0 1/s", "joint damping 10 1/s", "joint damping 20 1/s"]
    assert [case.dynamics[NAME] for case in cases] == [0.0, 10.0, 20.0]
    assert hidden(HiddenDynamics(OURS, joint_damping=3.0)) == (
        "part mass 0.50 kg, joint friction 0.00, surface friction 1.00, joint damping 3.00 1/s"
    )


# Stores, without any package


def test_a_store_with_columns_of_a_package_that_nobody_has_is_kept_whole(tmp_path: Path) -> None:
    store = fabricated(tmp_path / "store", {"wind": 3.0, "age": 0.5})
    digest = store.digest()
    assert verify(store) == []
    assert not repair(store.where)[1].problems
    assert merge([store], tmp_path / "merged")[0].digest() == digest
    export(store, tmp_path / "data", splits_by_share(store, 0.0, 1))
    exported = pq.read_table(tmp_path / "data/train/interactions.parquet")
    assert set(exported.column("hidden_wind").to_pylist()) == {3.0}
    compact(store, 9)
    assert store.digest() == digest
    assert verify(store) == []
    assert store.rollouts().column("hidden_age").to_pylist() == [0.5, 0.5]
    assert load_dataset(store, TINY).rows.facts.shape[1] == FACTS_WIDTH + 2
    (store.path / "store.json").unlink()
    assert repair(store.where)[1].made_anew == ("store.json",)
    assert Store.open(store.path).digest() == digest


def test_every_value_is_in_the_digest(tmp_path: Path) -> None:
    digests = [fabricated(tmp_path / str(wind), {"wind": wind}).digest() for wind in (1.0, 2.0)]
    assert len({*digests, fabricated(tmp_path / "none", {}).digest()}) == 3


def test_a_rollout_with_other_parameters_than_the_setting_is_refused(tmp_path: Path) -> None:
    store = fabricated(tmp_path / "store", {"wind": 1.0})
    plan = Plan(setting=store.setting)
    job = Job(plan.key, 2, 3)
    with pytest.raises(StoreError, match="rollout 2 has other hidden parameters than the store's"):
        store.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    for values in ({"wind": float("nan")}, {"wind": float("inf")}):
        with pytest.raises(StoreError, match="not finite"):
            store.commit(plan, job, [with_values(each, values) for each in fabricate_rollouts(plan, job, 2)], {})


def test_shards_of_another_setting_are_a_problem(tmp_path: Path) -> None:
    store, other = fabricated(tmp_path / "store", {}), fabricated(tmp_path / "other", {"wind": 1.0})
    shard = other.jobs()[0].shard_id
    shutil.rmtree(store.path / "shards" / shard)
    shutil.copytree(other.path / "shards" / shard, store.path / "shards" / shard)
    assert [problem.what for problem in verify(store)] == ["rollout 0 has other hidden parameters than the store's"]


def test_the_copies_in_the_interactions_must_be_those_of_the_rollouts(tmp_path: Path) -> None:
    store = fabricated(tmp_path / "store", {"wind": 1.0})
    first, second = shards_of(store)
    add_column(first, "interactions.parquet", pa.field("hidden_age", pa.float64(), nullable=False), [1.0, 1.0])
    table = pq.read_table(second / "interactions.parquet").drop_columns(["hidden_wind"])
    pq.write_table(table, second / "interactions.parquet", use_dictionary=False)
    add_column(second, "interactions.parquet", pa.field("hidden_wind", pa.float64(), nullable=False), [1.0, 1.5])
    assert [problem.what for problem in verify(store)] == [
        "the interactions have columns of other hidden parameters than the rollouts",
        "column hidden_wind does not agree with the columns that it restates",
    ]


@pytest.mark.parametrize("cells", [[1], ["a"], [float("nan")], [None]])
def test_a_hostile_column_is_refused(cells: list[Any], tmp_path: Path) -> None:
    file = next((fabricated(tmp_path / "store", {}).path / "shards").rglob("rollouts.parquet"))
    table = pq.read_table(file).append_column("hidden_wind", pa.array(cells))
    pq.write_table(table, file, use_dictionary=False)
    with pytest.raises(StoreError, match="foreign"):
        read_table(file.read_bytes(), ROLLOUT_COLUMNS, 1, "table")


# Settings


@pytest.mark.parametrize(
    ("word", "found"),
    [
        ("joint_damping", Range(low=0.0, high=20.0)),
        ("part_mass=0.1:0.2,joint_damping=1:4:log", Range(low=1.0, high=4.0, log=True)),
    ],
)
def test_a_flag_names_it_with_or_without_a_range(word: str, found: Range, installed: None) -> None:
    parsed = parse_flags(CollectCommand, ["--store", "a", "--collection.dynamics", word], "collect")
    ranges = parsed.settings.collection.dynamics
    assert ranges is not None
    assert ranges[NAME] == found
    assert ranges["joint_friction"] == DynamicsRanges()["joint_friction"]
    assert list(ranges.root) == [*ALWAYS_DRAWN, NAME]


@pytest.mark.parametrize(
    "word", ["joint_dampign", "joint_dampign=1:2", "Wind=1:2", "part_mass=1", "part_mass=2:1", "part_mass=a:b", ""]
)
def test_a_flag_that_names_none_is_refused(word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    assert run([*COLLECT, "--store", str(store), "--collection.dynamics", word]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not store.exists()


@pytest.mark.parametrize("name", ["part_mass", "joint_friction", "catch_force"])
def test_a_range_that_physics_cannot_have_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match=f"{name} needs a range from 0 on; given -1 to 1"):
        parse(CollectionConfig, {"dynamics": {name: {"low": -1.0, "high": 1.0}}}, "a file")


@pytest.mark.parametrize("name", ["Wind", "wind speed", "direction", "values", ""])
def test_a_record_without_a_proper_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="a hidden parameter cannot be called"):
        HiddenParameter(name, "", "", 0.0, 1.0, False, lambda *_: None)
