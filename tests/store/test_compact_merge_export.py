"""Compaction, merging and export: other files, the same data."""

import contextlib
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr

from benchmarks.storing import StoringBenchmark
from cluster.cli.main import run
from shared.errors import StoreError, UsageError
from shared.plan import Job, Plan
from shared.store import Store, compact, export, merge, verify
from shared.store.codecs.observations import ARRAYS
from shared.store.layout import SHARDS_FOLDER
from shared.store.maintenance.export import splits_by_share
from shared.store.maintenance.formats import plain
from shared.types import pack_normals
from tests.support.fabricate import fabricate_rollouts, fabricate_setting, identical
from tests.support.faults import Fault, disk_faults
from tests.support.killed_writers import kill_while_writing

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)


def make(where: str | Path, *ranges: tuple[int, int], plan: Plan = PLAN) -> Store:
    store = Store.create(where, plan.setting)
    for start, stop in ranges:
        job = Job(plan.key, start, stop)
        store.commit(plan, job, fabricate_rollouts(plan, job, 2), {})
    return store


def shard_names(store: Store) -> list[str]:
    return [name for name in store.backend.names("shards") if not name.startswith(".")]


def rows_of(store: Store) -> list[tuple[int, int]]:
    return [(row["rollout"], row["step"]) for row in store.interactions(["rollout", "step"]).to_pylist()]


@pytest.mark.parametrize("kind", ["disk", "bucket"])
def test_compaction_changes_shards_and_nothing_else(kind: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    where = str(tmp_path / "store") if kind == "disk" else request.getfixturevalue("s3_url")
    store = make(where, (0, 1), (1, 2), (2, 4), (5, 6), (6, 7))
    digest, rows = store.digest(), rows_of(store)
    done = compact(store, 3)
    assert done.made == ("random-v0-00000000-00000002", "random-v0-00000005-00000007")
    assert (done.before, done.after) == (5, 3)
    assert store.digest() == digest
    assert rows_of(store) == rows
    assert verify(store) == []
    again = compact(store, 3)
    assert again.made == again.set_aside == ()
    assert identical(store.read_rollouts(done.made[0]), tuple(fabricate_rollouts(PLAN, Job(PLAN.key, 0, 2), 2)))
    assert len(store.backend.names("aside/shards")) == 4, "nothing is deleted"


def test_a_compaction_that_fails_at_a_step_loses_and_doubles_nothing(tmp_path: Path) -> None:
    whole = make(tmp_path / "whole", (0, 1), (1, 2))
    rows = rows_of(whole)
    shutil.copytree(whole.path, tmp_path / "0")
    with disk_faults(Fault("EIO", 0)) as steps:
        compact(Store.open(tmp_path / "0"), 9)
    for step in range(1, len(steps) + 1, 19):
        store = Store.open(shutil.copytree(whole.path, tmp_path / str(step)))
        with disk_faults(Fault("EIO", step)), contextlib.suppress(OSError, StoreError):
            compact(store, 9)
        assert verify(store) == []
        assert (store.digest(), rows_of(store)) == (whole.digest(), rows)
        compact(store, 9)
        assert (store.digest(), rows_of(store)) == (whole.digest(), rows)
        assert shard_names(store) == ["random-v0-00000000-00000002"]


def test_readers_of_overlapping_shards_count_each_rollout_once(tmp_path: Path) -> None:
    parts = [make(tmp_path / f"{a}-{b}", (a, b)) for a, b in ((0, 2), (1, 4), (0, 4), (3, 6))]
    sound = make(tmp_path / "sound", (0, 6))
    for chosen in itertools.chain(itertools.combinations(parts, 2), itertools.combinations(parts, 3)):
        store = make(tmp_path / "-".join(part.path.name for part in chosen))
        store.add_plan(PLAN)
        (store.path / "shards").mkdir()
        for part in chosen:
            name = shard_names(part)[0]
            (part.path / "shards" / name).rename(store.path / "shards" / name)
        rows = rows_of(store)
        assert len(set(rows)) == len(rows)
        assert set(rows) == {row for part in chosen for row in rows_within(sound, part.path.name)}
        assert len(store.rollouts()) * 2 == len(rows)
        for part in chosen:
            name = next(n for n in shard_names(store) if n.endswith(part_suffix(part.path.name)))
            (store.path / "shards" / name).rename(part.path / "shards" / name)


def rows_within(store: Store, name: str) -> list[tuple[int, int]]:
    start, stop = map(int, name.split("-"))
    return [row for row in rows_of(store) if start <= row[0] < stop]


def part_suffix(name: str) -> str:
    start, stop = map(int, name.split("-"))
    return f"{start:08d}-{stop:08d}"


def test_merging_is_a_union(tmp_path: Path, s3_url: str) -> None:
    one, other = make(tmp_path / "one", (0, 2), (2, 4)), make(s3_url, (1, 3), (5, 6))
    make(s3_url, (0, 1), plan=Plan(setting=SETTING, proposer="aip", policy_version=1))
    other.publish_policy(1, {"policy.json": b"{}"})
    merged, done = merge([one, other], tmp_path / "merged")
    whole = make(tmp_path / "whole", (0, 4), (5, 6))
    make(tmp_path / "whole", (0, 1), plan=Plan(setting=SETTING, proposer="aip", policy_version=1))
    assert merged.digest() == whole.digest()
    assert (done.rollouts, done.in_several, done.policies) == (6, 2, (1,))
    assert verify(merged) == []
    assert merge([other, one], tmp_path / "reversed")[0].digest() == whole.digest()
    assert merge([one, other], tmp_path / "merged")[1] == done, "it can be repeated"


def test_what_a_killed_merge_or_compaction_left_is_removed_by_the_next(tmp_path: Path) -> None:
    one, merged = make(tmp_path / "one", (0, 2)), make(tmp_path / "merged", (0, 2))
    left = [kill_while_writing(store.path / SHARDS_FOLDER / "half") for store in (one, merged)]
    merge([one], merged.where)
    compact(one, 2)
    assert not any(path.exists() for path in left)


def test_stores_that_disagree_are_not_merged(tmp_path: Path) -> None:
    one = make(tmp_path / "one", (0, 2))
    other = make(tmp_path / "other", plan=Plan(setting=fabricate_setting(seed=8)))
    with pytest.raises(StoreError, match="seed: the store has 7, given 8"):
        merge([one, other], tmp_path / "merged")
    lying = Store.create(tmp_path / "lying", SETTING)
    lying.commit(PLAN, Job(PLAN.key, 1, 2), fabricate_rollouts(PLAN, Job(PLAN.key, 1, 2), 3), {})
    with pytest.raises(StoreError, match="rollout 1 of random-v0 is another in"):
        merge([one, lying], tmp_path / "merged")
    with pytest.raises(UsageError, match="is one of the stores"):
        merge([one], one.where)
    assert not (tmp_path / "merged").exists()


def test_an_export_holds_the_rows_and_their_clouds(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2), (2, 6))
    splits = {"train": frozenset({"object-0", "object-2"}), "test": frozenset({"object-1"})}
    done = export(store, tmp_path / "out", splits)
    assert sum(figures.interactions for figures in done.splits.values()) == 12
    rollouts = {r.index: r for r in fabricate_rollouts(PLAN, Job(PLAN.key, 0, 6), 2)}
    for name, objects in splits.items():
        table = pq.read_table(tmp_path / "out" / name / "interactions.parquet").to_pylist()
        clouds = zarr.open_group(tmp_path / "out" / name / "observations.zarr", mode="r")
        assert {row["object_id"] for row in table} == set(objects)
        assert clouds["points"].shape[0] == len({row["observation"] for row in table})
        for row in table:
            seen = rollouts[row["rollout"]].observations[row["rollout_observation"]]
            assert np.array_equal(clouds["points"][row["observation"]], seen.points)
            assert np.array_equal(clouds["normals"][row["observation"]], pack_normals(seen.normals))
            assert np.array_equal(clouds["world_from_camera"][row["observation"]], seen.world_from_camera)
    card = (tmp_path / "out" / "README.md").read_text()
    assert store.digest() in card
    assert "| train | 2 | 4 | 4 | 8 |" in card
    assert "Licence" in card


def test_an_export_writes_what_many_shards_hold_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make(tmp_path / "store", *((k, k + 1) for k in range(10)))
    splits = {"train": frozenset(ref.id for ref in SETTING.objects)}
    export(store, tmp_path / "whole", splits)
    monkeypatch.setattr(plain, "SHARDS_A_GROUP", 4)
    monkeypatch.setattr(plain, "CLOUDS_A_CHUNK", 3)
    export(store, tmp_path / "parts", splits)
    files = [pq.ParquetFile(tmp_path / name / "train/interactions.parquet") for name in ("whole", "parts")]
    # What is known of each group is in memory until the file is closed.
    assert [file.num_row_groups for file in files] == [1, 3]
    keys = ["rollout", "step", "observation", "point_index", "object_id"]
    assert files[0].read(keys).equals(files[1].read(keys))
    clouds = [tmp_path / name / "train/observations.zarr" for name in ("whole", "parts")]
    whole, parts = (zarr.open_group(folder, mode="r") for folder in clouds)
    for kind in ARRAYS:
        assert whole[kind.name].shape[0] == 10
        assert np.array_equal(whole[kind.name][...], parts[kind.name][...])


def test_test_objects_are_drawn_within_each_category(tmp_path: Path) -> None:
    setting = fabricate_setting(objects=20)
    store = Store.create(tmp_path, setting)
    splits = splits_by_share(store, 0.2, seed=1)
    assert splits["train"] | splits["test"] == {ref.id for ref in setting.objects}
    assert not splits["train"] & splits["test"]
    tested = [ref.category for ref in setting.objects if ref.id in splits["test"]]
    assert sorted(tested) == ["Faucet"] * 2 + ["StorageFurniture"] * 2
    assert splits_by_share(store, 0.2, seed=1) == splits != splits_by_share(store, 0.2, seed=2)
    assert splits_by_share(store, 0.0, seed=1).keys() == {"train"}


def test_an_export_is_all_or_nothing(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1))
    for splits, message in (
        ({"train": frozenset({"nobody"})}, "'nobody' is not in the store"),
        ({"train": frozenset({"object-0"}), "test": frozenset({"object-0"})}, "'object-0' is in another split too"),
        ({"train": frozenset({"object-0"}), "test": frozenset({"object-1"})}, "'test' has no interaction"),
    ):
        with pytest.raises((UsageError, StoreError), match=message):
            export(store, tmp_path / "out", splits)
        assert [path.name for path in tmp_path.iterdir()] == ["store"]
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="is there already"):
        export(store, tmp_path / "out", {"train": frozenset({"object-0"})})


def test_the_commands_say_what_they_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = make(tmp_path / "store", (0, 1), (1, 4))
    digest = store.digest()
    said = []
    for args in (
        ["compact", str(store.path)],
        ["merge", str(store.path), "--out", str(tmp_path / "copy")],
        ["export", str(tmp_path / "copy"), "--out", str(tmp_path / "out")],
    ):
        assert run(["store", *args, "--json"]) == 0
        said.append(json.loads(capsys.readouterr().out))
    assert [said[0]["digest"], said[1]["digest"]] == [digest] * 2
    assert said[0]["after"] == 1
    assert said[2]["splits"]["train"]["interactions"] == 8
    again = ["store", "export", str(tmp_path / "copy"), "--out", str(tmp_path / "out"), "--json"]
    assert run(again) == 0
    assert json.loads(capsys.readouterr().out) == said[2]
    assert run([*again, "--format", "hf"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
def test_the_benchmark_reads_what_was_committed(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1), (1, 4))
    benchmark, turns = StoringBenchmark(store, repeats=2, bucket=True), []
    benchmark.run(lambda: turns.append(1))
    assert len(turns) == benchmark.turns == 4
    found = benchmark.as_json()
    assert (found["shards"], found["interactions"]) == (2, 8)
    assert list(found["read"]) == ["disk, cold", "disk, warm", "bucket"]
    assert all(value > 0 for figures in found["read"].values() for value in figures.values())
    assert {name: len(each) for name, each in benchmark.commit_s.items()} == {"disk": 4, "bucket": 4}
