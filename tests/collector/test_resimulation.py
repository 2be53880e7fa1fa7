"""Rows that are executed again come out as they were stored, and one that lies is found."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run
from cluster.evaluation.resimulation import chosen_interactions, resimulate
from collector.objects.catalogue import load_ref, scan
from collector.objects.procedural import generate
from collector.sim.restoration import first_positions
from collector.sim.scene import restricted_limits
from collector.viz.playback import record
from collector.worker import Worker
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.errors import UsageError
from shared.plan import Job, Plan, Setting
from shared.store import Store
from shared.types import Direction
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

CONFIG = CollectionConfig(
    camera=CameraConfig(image_size=128, points=256, candidates=1000),
    rollout=RolloutConfig(interactions=6, actions_per_state=3),
)


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"Faucet": 2}, seed=8)
    return folder


@pytest.fixture(scope="module")
def collected(objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Faucets, whose hidden direction restricts the joints."""
    refs = tuple(entry.ref for entry in scan(objects).usable)
    setting = Setting(task="push-faucet", seed=3, objects=refs, collection=CONFIG)
    store, plan = Store.create(tmp_path_factory.mktemp("collected") / "store", setting), Plan(setting=setting)
    Worker(store.where, objects).run(plan, Job(plan.key, 0, 2))
    return store


def test_rows_come_out_as_they_were_stored(collected: Store, objects: Path) -> None:
    found = resimulate(collected, objects, 8, seed=1)
    assert len(found.rows) == 8
    assert found.other_labels == ()
    assert found.other_kinds == 0
    assert found.joint_errors.max() < 5e-3
    chosen = [(row.shard, row.rollout, row.step) for row in found.rows]
    assert len(set(chosen)) == 8
    assert chosen != [(row.shard, row.rollout, row.step) for row in resimulate(collected, objects, 8, seed=2).rows]


def test_a_playback_of_a_row_has_the_stored_outcome(collected: Store, objects: Path) -> None:
    collection = collected.setting.collection
    for rollout in collected.read_rollouts(collected.committed()[0].shard_id):
        target = load_ref(objects, rollout.object, collection.collision)
        row = rollout.interactions[0]
        again = record(target, collection, rollout, row)
        assert (again.outcome.kind, again.outcome.success) == (row.outcome.kind, row.outcome.success)
        assert again.outcome.motion == pytest.approx(row.outcome.motion, abs=5e-3)
        assert again.joint_positions[0] == pytest.approx(row.joint_positions, abs=1e-6)
    other = collection.model_copy(update={"simulator": "other"})
    with pytest.raises(UsageError, match="made with the simulator 'other'; only SAPIEN executes rows again"):
        record(target, other, rollout, row)


def test_interactions_are_chosen_by_rollout_step_and_label_and_plans_are_not_mixed_up(tmp_path: Path) -> None:
    setting = fabricate_setting()
    store, job = Store.create(tmp_path / "store", setting), Job("random-v0", 0, 6)
    plans = Plan(setting=setting), Plan(setting=setting, proposer="aip", policy_version=1)
    for plan in plans:
        store.commit(plan, Job(plan.key, 0, 6), fabricate_rollouts(plan, Job(plan.key, 0, 6)), {})
    rollout, rows = chosen_interactions(store, job.shard_id, rollout=4)
    assert (rollout.plan_key, rollout.index) == ("random-v0", 4)
    assert [row.step for row in rows] == list(range(8))
    rollout, (row,) = chosen_interactions(store, "aip-v1-00000000-00000006", rollout=2, step=5)
    assert (rollout.plan_key, rollout.index, row.step) == ("aip-v1", 2, 5)
    _, (row,) = chosen_interactions(store, success=True)
    assert row.outcome.success
    with pytest.raises(UsageError, match=r"several plans have a rollout 4; name one of: aip-v1-.*, random-v0-"):
        chosen_interactions(store, rollout=4)
    with pytest.raises(UsageError, match="has no interaction of rollout 9, success True, shard random-v0"):
        chosen_interactions(store, job.shard_id, rollout=9, success=True)


def test_a_label_that_lies_is_found(
    collected: Store, objects: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = collected.committed()[0]
    rollouts = [
        dataclasses.replace(
            rollout,
            interactions=tuple(
                dataclasses.replace(row, outcome=dataclasses.replace(row.outcome, success=not row.outcome.success))
                for row in rollout.interactions
            ),
        )
        for rollout in collected.read_rollouts(manifest.shard_id)
    ]
    store = Store.create(tmp_path / "store", collected.setting)
    store.commit(collected.plans()[0], Job(manifest.plan_key, manifest.start, manifest.stop), rollouts, {})
    assert run(["store", "verify", str(store.path), "--resimulate", "3", "--objects", str(objects)]) == 0
    assert "other labels   3" in capsys.readouterr().out


@pytest.mark.parametrize("direction", [Direction.CLOCKWISE, Direction.COUNTER_CLOCKWISE, Direction.BOTH])
def test_limits_tell_where_the_joints_stood(direction: Direction) -> None:
    limits, positions = np.array([[0.0, 1.5], [-1.0, 2.0]]), np.array([0.3, 0.7])
    assert np.allclose(first_positions(restricted_limits(limits, positions, direction), direction), positions)
