"""Tasks with catches and latches: one target of a door and its handles, its rows, and what is told of them."""

from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run
from cluster.config.objects import built_in_categories
from cluster.evaluation.resimulation import resimulate
from cluster.reporting.counterfactuals import variations
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from collector.objects.procedural import generate
from collector.objects.readers import read_object
from collector.sim.environment import SapienEnvironment
from collector.sim.simulator import StageClock
from learner.data.dataset import FACTS_WIDTH, load_dataset
from shared.config import CameraConfig, CollectionConfig
from shared.errors import UsageError
from shared.geometry import camera_pose
from shared.store import Store, verify
from shared.tasks import read_task, task_named
from shared.types import HiddenDynamics
from tests.support.single_door import door
from tests.support.small_networks import TINY

EXAMPLES = Path(__file__).parents[2] / "examples"
LATCH = read_task(EXAMPLES / "push-latch.toml")
CAMERA = CameraConfig(image_size=128, points=256, candidates=2000)
COLLECT = (
    *("collect", "--task", str(EXAMPLES / "push-latch.toml"), "--procedural-per-category", "2", "--rollouts", "2"),
    *("--seed", "3", "--per-shard", "1", "--collection.camera.points", "128", "--collection.camera.candidates", "1000"),
    *("--collection.rollout.interactions", "8", "--collection.rollout.continued", "4"),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    path = tmp_path_factory.mktemp("latched") / "store"
    assert run([*COLLECT, "--workers", "0", "--store", str(path)]) == 0
    return Store.open(path)


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedObject:
    return read_object(generate(tmp_path_factory.mktemp("objects"), {"ButtonCabinet": 1}, seed=0)[0])


def environment(target: ArticulatedObject, **hidden: float) -> SapienEnvironment:
    dynamics = HiddenDynamics(hidden, part_mass=0.1, joint_friction=0.1, surface_friction=1.0)
    pose, rng = camera_pose(180.0, 40.0, 5.0), np.random.default_rng(0)
    collection = CollectionConfig(camera=CAMERA)
    made = SapienEnvironment(target, LATCH, collection, dynamics, pose, rng, StageClock())
    assert made.reset(np.random.default_rng(1))
    return made


def test_a_latched_door_and_its_handles_are_one_target_and_without_a_latch_one_of_them_is(
    cabinet: ArticulatedObject,
) -> None:
    latched, free = environment(cabinet, latch_travel=0.3), environment(cabinet)
    seen = latched.observe()
    assert set(seen.part_ids[seen.movable]) == set(seen.part_ids) - {0}
    assert latched.parts == tuple(range(1, len(cabinet.bodies)))
    seen = free.observe()
    assert len(set(seen.part_ids[seen.movable])) == len(free.parts) == 1


def test_a_latch_is_not_in_the_cloud(cabinet: ArticulatedObject) -> None:
    clouds = [environment(cabinet, **hidden).observe().points for hidden in ({}, {"latch_travel": 1.05})]
    np.testing.assert_array_equal(*clouds)


def test_rows_of_handles_tell_of_the_door_and_come_out_the_same_again(store: Store) -> None:
    assert verify(store) == []
    objects = store.path.with_name(f"{store.path.name}-objects")
    found = resimulate(store, objects, 16, seed=1)
    assert len(found.rows) == 16
    assert (found.other_labels, found.other_kinds) == ((), 0)
    rows = store.interactions().to_pylist()
    assert {row["target_part"] for row in rows} > {1}
    for row in rows:
        if row["outcome"] == "ok":
            assert row["start_joint_position"] == pytest.approx(row["joint_positions"][0], abs=1e-6)
            assert row["motion"] == pytest.approx(
                abs(row["end_joint_position"] - row["start_joint_position"]), abs=1e-6
            )


def test_columns_facts_and_the_report_know_a_latch(store: Store) -> None:
    table = store.interactions(["hidden_latch_travel", "hidden_latch_handle"])
    assert ((table.column(0).to_numpy() >= 0.2) & (table.column(0).to_numpy() <= 0.4)).all()
    assert load_dataset(store, TINY).rows.facts.shape[1] == FACTS_WIDTH + 2
    reference = store.setting.objects[0]
    target = load_ref(store.path.with_name("store-objects"), reference, store.setting.collection.collision)
    found = {each.name: [case.dynamics.values for case in each.cases] for each in variations(store.setting, target, [])}
    assert [values["latch_handle"] for values in found["latch handle"]] == [0.0, 0.5, 1.0]


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_workers_give_the_same_digest(store: Store, tmp_path: Path) -> None:
    assert run([*COLLECT, "--workers", "2", "--store", str(tmp_path / "store")]) == 0
    assert Store.open(tmp_path / "store").digest() == store.digest()


@pytest.mark.parametrize("name", ["pull-catch", "push-latch", "pull-latch"])
def test_the_tasks_of_the_examples_have_objects(name: str) -> None:
    task = read_task(EXAMPLES / f"{name}.toml")
    assert built_in_categories(task, ()) == list(task.categories)


def test_cabinets_with_latches_are_made_only_where_they_are_named() -> None:
    push = task_named("push")
    assert len(built_in_categories(push, ())) == 15
    assert built_in_categories(push, ("ButtonCabinet",)) == ["ButtonCabinet"]
    with pytest.raises(
        UsageError, match="no built-in 'Faucet' for the task 'push-latched-door'; allowed: ButtonCabinet"
    ):
        built_in_categories(LATCH, ("Faucet",))


def test_a_part_of_an_object_without_handles_is_its_own_target() -> None:
    assert environment(door()).scene.holds.target_of(1) == (1,)
