"""Reading a store from Python: tables, clouds, and samples for PyTorch that go on exactly where they stopped."""

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
import torch
from torch.utils.data import DataLoader

import adaafford
from adaafford import InteractionDataset, Store
from shared.errors import UsageError
from shared.plan import Job, Plan
from shared.store import compact, streaming
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

SHARDS, ROLLOUTS, INTERACTIONS = 7, 2, 6
ROWS = SHARDS * ROLLOUTS * INTERACTIONS


def make_store(path: Path) -> Store:
    setting = fabricate_setting(points=64)
    plan, store = Plan(setting=setting), Store.create(path, setting)
    for number in range(SHARDS):
        job = Job(plan.key, number * ROLLOUTS, (number + 1) * ROLLOUTS)
        store.commit(plan, job, fabricate_rollouts(plan, job, INTERACTIONS, per_observation=4), {})
    return store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    where = tmp_path_factory.mktemp("reading") / "store"
    make_store(where)
    return adaafford.open_store(where)


def name_of(sample: dict[str, Any]) -> tuple[int, int]:
    return int(sample["rollout"]), int(sample["step"])


def dataset_of(store: Store, **arguments: Any) -> InteractionDataset:
    return InteractionDataset(store, **{"columns": ["rollout", "step"], "clouds": [], "seed": 3} | arguments)


def as_worker(monkeypatch: pytest.MonkeyPatch, number: int, workers: int) -> None:
    monkeypatch.setattr(streaming, "get_worker_info", lambda: SimpleNamespace(id=number, num_workers=workers))


# Tables and clouds.


def test_rows_and_columns_are_chosen_before_they_are_joined(store: Store) -> None:
    every = store.interactions()
    some = store.interactions(["step", "motion"], where=[("outcome", "=", "ok"), ("step", "in", [0, 2, 3])])
    wanted = every.filter((pc.field("outcome") == "ok") & pc.field("step").isin([0, 2, 3]))
    assert some.column_names == ["step", "motion", "observation", "shard"]
    assert 0 < len(some) < len(every)
    assert some.equals(wanted.select(some.column_names))
    rollouts = store.rollouts(["rollout", "shard"], where=[("rollout", ">=", 10)])
    assert rollouts.column("rollout").to_pylist() == list(range(10, SHARDS * ROLLOUTS))
    assert rollouts.column_names == ["rollout", "shard"]
    assert len(store.interactions(where=[("rollout", "<", 0)])) == 0


@pytest.mark.parametrize(
    ("columns", "where", "said"),
    [
        (["motoin"], [], "no column 'motoin' in the interactions; did you mean 'motion'?"),
        (None, [("sucess", "=", True)], "no column 'sucess' in the interactions; did you mean 'success'?"),
        (None, [("motion", "~", 1)], "where: ('motion', '~', 1) is no condition; give tuples"),
        (None, ["motion > 1"], "where: motion > 1 is no condition; give tuples"),
        (None, [("motion", "<", "much")], "cannot be compared"),
        (None, [("step", "in", 3)], "cannot be compared"),
    ],
)
def test_what_cannot_be_selected_is_refused_in_one_line(
    store: Store, columns: list[str] | None, where: list[Any], said: str
) -> None:
    with pytest.raises(UsageError) as raised:
        store.interactions(columns, where=where)
    assert said in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(UsageError):
        InteractionDataset(store, columns or ["step"], where)


def test_each_row_has_its_cloud_by_row_and_by_batch(store: Store) -> None:
    rows = store.interactions(["rollout", "rollout_observation"])
    backwards = rows.take(np.arange(len(rows))[::-1])
    for table in (rows, backwards):
        clouds = store.clouds(table)
        assert clouds.points.shape == (ROWS, 64, 3)
        records = {rollout.index: rollout for part in store.parts() for rollout in store.rollouts_of(part)}
        for number, row in enumerate(table.to_pylist()):
            seen = records[row["rollout"]].observations[row["rollout_observation"]]
            assert np.array_equal(clouds.points[number], seen.points)
            assert np.array_equal(clouds.world_from_camera[number], seen.world_from_camera)
    batches = list(store.cloud_batches(rows, 10))
    assert [len(clouds) for _, clouds in batches] == [10] * (ROWS // 10) + [ROWS % 10]
    assert np.array_equal(np.concatenate([clouds.points for _, clouds in batches]), store.clouds(rows).points)
    assert [len(some) for some, _ in batches] == [len(clouds) for _, clouds in batches]
    with pytest.raises(UsageError, match="without the column 'shard'"):
        store.clouds(rows.select(["observation"]))
    with pytest.raises(UsageError, match="batches of 0 rows"):
        next(store.cloud_batches(rows, 0))


# Samples for PyTorch.


def test_an_epoch_has_every_row_once_with_its_cloud(store: Store) -> None:
    rows = store.interactions(["rollout", "step", "point"])
    clouds = store.clouds(rows)
    table = {(row["rollout"], row["step"]): number for number, row in enumerate(rows.to_pylist())}
    dataset = dataset_of(store, columns=["rollout", "step", "point", "object_id"], clouds=["points"], together=3)
    samples = list(dataset)
    assert sorted(map(name_of, samples)) == sorted(table)
    for sample in samples:
        number = table[name_of(sample)]
        assert sample["point"].tolist() == rows["point"][number].as_py()
        assert np.array_equal(sample["points"], clouds.points[number])
        assert sample["object_id"].startswith("object-")


def test_the_order_depends_on_seed_and_epoch_alone(store: Store) -> None:
    dataset = dataset_of(store)
    first = [name_of(sample) for sample in dataset]
    dataset.set_epoch(1)
    second = [name_of(sample) for sample in dataset]
    dataset.set_epoch(0)
    assert [name_of(sample) for sample in dataset] == first != second
    assert sorted(first) == sorted(second)
    in_order = [name_of(sample) for sample in dataset_of(store, seed=None)]
    assert in_order == sorted(first)
    assert [name_of(sample) for sample in dataset_of(store, seed=4)] != first


def test_workers_and_processes_share_the_rows(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []
    for rank in range(2):
        for worker in range(3):
            as_worker(monkeypatch, worker, 3)
            monkeypatch.setattr(InteractionDataset, "_rank_and_world", lambda self, rank=rank: (rank, 2))
            seen += [name_of(sample) for sample in dataset_of(store)]
    assert len(seen) == ROWS == len(set(seen))


@pytest.mark.parametrize("stop", [0, 1, 11, 12, 13, ROWS - 1, ROWS])
def test_the_rest_comes_in_the_same_order_after_a_stop(store: Store, stop: int) -> None:
    where = [("outcome", "!=", "no-contact")]
    whole = [name_of(sample) for sample in dataset_of(store, together=2)]
    dataset = dataset_of(store, together=2)
    assert [name_of(sample) for sample in islice(dataset, stop)] == whole[:stop]
    state = json.loads(json.dumps(dataset.state_dict()))
    again = dataset_of(store, together=2)
    again.load_state_dict(state)
    again.set_epoch(again.epoch)
    assert [name_of(sample) for sample in again] == whole[stop:]
    again.set_epoch(1)
    assert len(list(again)) == ROWS
    with pytest.raises(UsageError, match="other shards or arguments"):
        dataset_of(store, together=2, where=where).load_state_dict(state)


def batches(store: Store, state: dict[str, Any] | None, workers: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    dataset = dataset_of(store, clouds=["points"])
    if state is not None:
        dataset.load_state_dict(state)
    context = "spawn" if workers else None
    for batch in DataLoader(dataset, batch_size=5, num_workers=workers, multiprocessing_context=context):
        dataset.consumed(batch["position"])
        yield list(map(tuple, torch.stack([batch["rollout"], batch["step"]], 1).tolist())), dataset.state_dict()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_loader_goes_on_with_the_batches_that_were_left(store: Store, workers: int) -> None:
    whole = list(batches(store, None, workers))
    assert sorted(name for names, _ in whole for name in names) == sorted(map(name_of, dataset_of(store)))
    for stop in (1, 4, len(whole) - 2) if not workers else (4,):
        state = json.loads(json.dumps(whole[stop - 1][1]))
        assert [names for names, _ in batches(store, state, workers)] == [names for names, _ in whole[stop:]]


def test_batches_of_workers_come_in_the_order_in_which_they_would_have(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = dataset_of(store)
    as_worker(monkeypatch, 0, 2)
    first = list(islice(dataset_of(store), 5))
    dataset.consumed(np.array([sample["position"] for sample in first]))
    taken = set(map(name_of, first))
    shares = []
    for worker in range(2):
        as_worker(monkeypatch, worker, 2)
        again = dataset_of(store)
        again.load_state_dict(dataset.state_dict())
        shares.append([name_of(sample) for sample in again])
    as_worker(monkeypatch, 1, 2)
    assert shares[0] == [name_of(sample) for sample in dataset_of(store)]
    assert len(shares[0]) + len(shares[1]) == ROWS - 5
    assert taken.isdisjoint(shares[0] + shares[1])


@pytest.mark.slow
def test_what_comes_later_is_not_read_and_a_rewritten_store_is_refused(tmp_path: Path) -> None:
    store = make_store(tmp_path / "store")
    dataset = dataset_of(store)
    plan = Plan(setting=store.setting)
    job = Job(plan.key, SHARDS * ROLLOUTS, SHARDS * ROLLOUTS + 1)
    store.commit(plan, job, fabricate_rollouts(plan, job, INTERACTIONS), {})
    assert len(list(islice(dataset, 20))) == 20
    again = dataset_of(store)
    again.load_state_dict(dataset.state_dict())
    assert len(list(again)) == ROWS - 20
    compact(store, 100)
    with pytest.raises(UsageError, match="the store was compacted"):
        dataset_of(store).load_state_dict(dataset.state_dict())


def test_misuse_of_a_data_set_is_said_in_one_line(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, said in (
        ({"clouds": ["colours"]}, "clouds have no field 'colours'; allowed: points"),
        ({"columns": ["joint_limits"]}, "column 'joint_limits' has cells of different lengths"),
        ({"together": 0}, "together=0"),
        ({"seed": -1}, "seed=-1"),
    ):
        with pytest.raises(UsageError, match=said):
            dataset_of(store, **arguments)
    dataset = dataset_of(store)
    next(iter(dataset))
    with pytest.raises(UsageError, match="call `set_epoch` before each epoch"):
        next(iter(dataset))
    with pytest.raises(UsageError, match="epoch -1"):
        dataset.set_epoch(-1)
    for state in ({}, {"snapshot": 3}, dataset.state_dict() | {"done": 3}):
        with pytest.raises(UsageError, match="no state of a data set"):
            dataset_of(store).load_state_dict(state)
    again = dataset_of(store)
    again.load_state_dict(dataset.state_dict())
    as_worker(monkeypatch, 0, 2)
    with pytest.raises(UsageError, match=r"rank 0, processes 1, workers 1; here: .*, workers 2"):
        next(iter(again))


# Ray Data.


def test_without_ray_data_one_line_says_what_to_install(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.extras.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="needs ray and pandas") as raised:
        adaafford.ray_source(store.where)
    assert "ray-data" in str(raised.value)


@pytest.mark.slow
def test_ray_data_reads_every_row_and_its_cloud_by_groups_of_shards(store: Store) -> None:
    pytest.importorskip("pandas")
    source = adaafford.ray_source(store.where, ["rollout", "step"], [("step", "<", 4)], ["points"])
    tasks = source.get_read_tasks(3)
    assert len(tasks) == 3
    rows = store.interactions(["rollout", "step"], where=[("step", "<", 4)])
    tables = [table for task in tasks for table in task()]
    assert [name for table in tables for name in table["rollout"].to_pylist()] == rows["rollout"].to_pylist()
    clouds = np.concatenate([table["points"].combine_chunks().to_numpy_ndarray() for table in tables])
    assert np.array_equal(clouds, store.clouds(rows).points)
    with pytest.raises(UsageError, match="no column"):
        adaafford.ray_source(store.where, ["colour"])
    with pytest.raises(UsageError, match="no field"):
        adaafford.ray_source(store.where, clouds=["colour"])
