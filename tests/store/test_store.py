"""Laws of the store: what goes in comes out, once, whoever put it there and however it was grouped."""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.config import CollectionConfig, Fidelity
from shared.errors import StoreError, UsageError
from shared.io.documents import with_checksum
from shared.plan import Job, ObjectRef, Plan, RolloutRecord
from shared.store import Store, info, verify
from shared.store.codecs.columns import COPIED_COLUMNS
from shared.store.layout import parse_shard_id
from shared.store.writer import rollout_digest
from shared.types import Action, HiddenDynamics, Observation, Outcome, OutcomeKind
from tests.support.documents import without_checksum
from tests.support.fabricate import fabricate_rollout, fabricate_rollouts, fabricate_setting, identical

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)


def make(path: Path, *ranges: tuple[int, int], plan: Plan = PLAN) -> Store:
    """A store with these ranges of the plan's rollouts as shards."""
    store = Store.create(path, plan.setting)
    for start, stop in ranges:
        job = Job(plan.key, start, stop)
        store.commit(plan, job, fabricate_rollouts(plan, job), {})
    return store


def test_what_is_read_is_what_was_committed_bit_for_bit(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", SETTING)
    rollouts = [fabricate_rollout(PLAN, index, interactions, per) for index, interactions, per in (
        (0, 8, 8), (1, 0, 8), (2, 5, 1), (3, 1, 8))]  # fmt: skip
    manifest = store.commit(PLAN, Job(PLAN.key, 0, 4), rollouts, {"physics_s": "1.5"})
    assert identical(Store.open(store.path).read_rollouts(manifest.shard_id), tuple(rollouts))
    assert (manifest.rollouts, manifest.interactions, manifest.observations) == (4, 14, 7)
    assert manifest.provenance["physics_s"] == "1.5"
    assert verify(store) == []


def test_rollouts_without_any_interaction_are_kept(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", SETTING)
    rollouts = [fabricate_rollout(PLAN, index, interactions=0) for index in range(2)]
    manifest = store.commit(PLAN, Job(PLAN.key, 0, 2), rollouts, {})
    assert identical(store.read_rollouts(manifest.shard_id), tuple(rollouts))
    assert len(store.read_observations(manifest.shard_id)) == 0
    assert store.rollouts().column("status").to_pylist() == ["nothing-to-act-on"] * 2
    assert len(store.interactions()) == 0
    assert verify(store) == []


FINITE = st.floats(allow_nan=False, allow_infinity=False)
TEXT = st.text(st.characters(blacklist_categories=["C", "Z"]), max_size=20)


@pytest.mark.slow
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_numbers_and_texts_survive(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    base = fabricate_rollout(PLAN, 0, interactions=2)
    tries = []
    for one in base.interactions:
        outcome = dataclasses.replace(
            one.outcome,
            kind=data.draw(st.sampled_from(OutcomeKind)),
            motion=data.draw(st.floats(0.0, allow_infinity=False)),
            grasp_opening=data.draw(st.floats()),
            end_joint_position=data.draw(st.floats()),
            displacement=np.array(data.draw(st.lists(st.floats(), min_size=3, max_size=3))),
        )
        tries.append(
            dataclasses.replace(
                one,
                outcome=outcome,
                hand_start=np.array(data.draw(st.lists(FINITE, min_size=7, max_size=7))),
                target_link=data.draw(TEXT),
                method=data.draw(TEXT),
                budget=data.draw(st.integers(-(2**31), 2**31 - 1)),
                seconds=data.draw(FINITE),
            )
        )
    dynamics = HiddenDynamics(base.dynamics.values, base.dynamics.direction, part_mass=data.draw(FINITE))
    rollout = dataclasses.replace(base, dynamics=dynamics, interactions=tuple(tries))
    store = Store.create(tmp_path_factory.mktemp("store"), SETTING)
    manifest = store.commit(PLAN, Job(PLAN.key, 0, 1), [rollout], {})
    back = store.read_rollouts(manifest.shard_id)[0]
    assert identical(back, rollout)
    assert rollout_digest(back) == manifest.digests[0]


@pytest.fixture(scope="module")
def digest_of_twelve(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of twelve rollouts in one shard."""
    return make(tmp_path_factory.mktemp("whole"), (0, 12)).digest()


@pytest.mark.slow
@settings(max_examples=8)
@given(cuts=st.sets(st.integers(1, 11)), order=st.randoms())
def test_the_digest_does_not_depend_on_grouping_or_order(
    tmp_path_factory: pytest.TempPathFactory, digest_of_twelve: str, cuts: set[int], order: Any
) -> None:
    ranges = list(pairwise([0, *sorted(cuts), 12]))
    order.shuffle(ranges)
    store = make(tmp_path_factory.mktemp("store"), *ranges)
    assert store.digest() == digest_of_twelve


def test_the_digest_of_fewer_rollouts_is_another(tmp_path: Path, digest_of_twelve: str) -> None:
    assert make(tmp_path, (0, 11)).digest() != digest_of_twelve


def mutations(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """`value` with each of the numbers, texts and enums in it changed, one at a time."""
    if isinstance(value, ObjectRef):
        for field, other in (("id", "z"), ("category", "z"), ("content_hash", "f" * 64)):
            yield f"{name}.{field}", value.model_copy(update={field: other})
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            for path, other in mutations(getattr(value, field.name), f"{name}.{field.name}"):
                yield path, dataclasses.replace(value, **{field.name: other})  # type: ignore[type-var]
    elif isinstance(value, tuple):
        for path, other in mutations(value[-1], f"{name}[-1]"):
            yield path, (*value[:-1], other)
        yield f"{name} (shorter)", value[:-1]
    elif isinstance(value, dict):
        for key, number in value.items():
            yield f"{name}[{key}]", {**value, key: number + 1}
    elif isinstance(value, np.ndarray):
        other = value.copy()
        other.flat[-1] = other.flat[-1] == 0 if value.dtype == np.bool_ else np.nan_to_num(other.flat[-1]) + 1
        yield name, other
    elif isinstance(value, Enum):
        yield name, next(other for other in type(value) if other is not value)
    elif isinstance(value, str):
        yield name, value + "x"
    elif isinstance(value, bool):
        yield name, not value
    elif isinstance(value, float) and np.isnan(value):
        yield name, 0.0
    elif value is not None:
        yield name, value + 1


def test_the_digest_changes_with_every_value_but_the_time() -> None:
    rollout = fabricate_rollout(PLAN, 0, interactions=3, per_observation=1)
    rollout = dataclasses.replace(rollout, arm_base=(1.0, 2.0, 3.0, 4.0))
    digest = rollout_digest(rollout)
    changed = {name: rollout_digest(other) != digest for name, other in mutations(rollout)}
    assert len(changed) > 45
    assert [name for name, differs in changed.items() if not differs] == [".interactions[-1].seconds"]


def test_the_digest_of_a_known_rollout_stays_the_same() -> None:
    # Numbers that every machine computes alike.
    cloud = Observation(
        points=np.zeros((2, 3), np.float32),
        normals=np.eye(3, dtype=np.float32)[:2],
        part_ids=np.array([0, 1], np.uint8),
        movable=np.array([False, True]),
        pixels=np.array([3, 5], np.uint32),
        world_from_camera=np.eye(4),
    )
    rollout = fabricate_rollout(PLAN, 0, interactions=1)
    one = dataclasses.replace(
        rollout.interactions[0],
        action=Action(1, np.zeros(3), np.eye(3)),
        outcome=Outcome(OutcomeKind.OK, 0.5, True, steps=3),
        normal=np.array([0.0, 1.0, 0.0]),
        target_part=1,
        target_link="link",
        target_joint="joint",
        joint_names=("joint",),
        joint_positions=np.zeros(1),
        joint_limits=np.array([[0.0, 1.0]]),
        joint_twist=np.zeros(6),
        hand_start=np.zeros(7),
    )
    dynamics = HiddenDynamics(part_mass=0.5, joint_friction=0.25, surface_friction=1.0)
    known = dataclasses.replace(
        rollout, dynamics=dynamics, azimuth_deg=180.0, elevation_deg=45.0, observations=(cloud,), interactions=(one,)
    )
    # Another number means that every store there is gets another digest: raise the schema version then.
    assert rollout_digest(known) == "f33b6c1826eed585b43f6910b678c6decb911c1f8e695dbfad29207180e10877"


def test_committing_again_changes_nothing(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2))
    before = {path: path.read_bytes() for path in store.path.rglob("*") if path.is_file()}
    job = Job(PLAN.key, 0, 2)
    again = store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {"other": "provenance"})
    assert again == store.committed()[0]
    assert "other" not in again.provenance
    assert before == {path: path.read_bytes() for path in store.path.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("start", "stop"), [(0, 3), (1, 3), (2, 6), (3, 5), (5, 7), (2, 7)])
def test_overlapping_ranges_of_a_plan_are_refused(tmp_path: Path, start: int, stop: int) -> None:
    store = make(tmp_path / "store", (2, 6) if (start, stop) != (2, 6) else (2, 5))
    with pytest.raises(StoreError, match="overlaps"):
        store.commit(PLAN, Job(PLAN.key, start, stop), fabricate_rollouts(PLAN, Job(PLAN.key, start, stop)), {})
    assert len(store.committed()) == 1
    assert not list(store.path.rglob(".tmp-*"))


def test_what_a_driver_has_vetted_is_not_looked_for_and_counts_once_all_the_same(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 4))
    job = Job(PLAN.key, 2, 6)
    store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {}, vetted=True)
    assert store.digest() == make(tmp_path / "whole", (0, 6)).digest()


def test_jobs_are_known_by_name_alone(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2), (4, 7))
    (store.path / "shards" / Job(PLAN.key, 2, 4).shard_id).mkdir()
    (store.path / "shards" / Job(PLAN.key, 0, 2).shard_id / "manifest.json").write_text("damaged")
    assert store.jobs() == store.jobs(PLAN.key) == [Job(PLAN.key, 0, 2), Job(PLAN.key, 4, 7)]
    assert store.jobs("aip-v1") == []


def test_plans_do_not_get_in_each_others_way(tmp_path: Path) -> None:
    other = Plan(setting=SETTING, proposer="aip", policy_version=1)
    store = make(tmp_path / "store", (0, 2))
    make(tmp_path / "store", (1, 3), plan=other)
    assert [plan.key for plan in store.plans()] == ["aip-v1", "random-v0"]
    assert [manifest.plan_key for manifest in store.committed("aip-v1")] == ["aip-v1"]
    assert set(
        store.interactions(["proposer"], where=[("plan_key", "=", "aip-v1")]).column("proposer").to_pylist()
    ) == {"aip"}
    assert [problem.where for problem in verify(store)] == ["policies/000001"], "it was never published"
    store.publish_policy(1, {"policy.json": b"{}"})
    assert verify(store) == []


def test_a_plan_of_another_setting_is_refused(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    other = Plan(setting=fabricate_setting(seed=8))
    with pytest.raises(StoreError, match="seed: the store has 7, given 8"):
        store.add_plan(other)


BROKEN = {
    "index": (lambda r: dataclasses.replace(r, index=1), "needs rollouts 0 to 0"),
    "plan": (lambda r: dataclasses.replace(r, plan_key="aip-v1"), "belongs to plan 'aip-v1'"),
    "seed": (lambda r: dataclasses.replace(r, seed=8), "another object or seed"),
    "nan": (lambda r: with_first(r, normal=np.full(3, np.nan)), "step 0: normal holds a number that is not finite"),
    "shape": (lambda r: with_first(r, hand_start=np.zeros(6)), "step 0: hand start is"),
    "observation": (lambda r: with_first(r, observation=1), "refers to observation 1 of 1"),
    "steps": (lambda r: with_first(r, step=1), "steps must grow"),
    "part": (lambda r: with_first(r, target_part=9), "target part 9"),
    "cloud": (lambda r: with_cloud(r, points=r.observations[0].points + np.float32(1e-5)), "not rounded to float16"),
    "normals": (lambda r: with_cloud(r, normals=r.observations[0].normals * np.float32(0.9)), "not rounded"),
    "fewer points": (lambda r: with_cloud(r, points=r.observations[0].points[:-1]), "observation's points is"),
}


def with_first(rollout: RolloutRecord, **changes: Any) -> RolloutRecord:
    first = dataclasses.replace(rollout.interactions[0], **changes)
    return dataclasses.replace(rollout, interactions=(first, *rollout.interactions[1:]))


def with_cloud(rollout: RolloutRecord, **changes: Any) -> RolloutRecord:
    return dataclasses.replace(rollout, observations=(dataclasses.replace(rollout.observations[0], **changes),))


@pytest.mark.parametrize("name", BROKEN)
def test_records_that_break_the_rules_are_refused(tmp_path: Path, name: str) -> None:
    store = Store.create(tmp_path / "store", SETTING)
    change, message = BROKEN[name]
    with pytest.raises(StoreError, match=message) as caught:
        store.commit(PLAN, Job(PLAN.key, 0, 1), [change(fabricate_rollout(PLAN, 0, interactions=2))], {})
    assert "\n" not in str(caught.value)
    assert store.committed() == []


def test_the_store_opens_again_and_knows_its_setting(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "a" / "b", SETTING)
    assert Store.create(store.path, SETTING).document == store.document == Store.open(store.path).document


def test_another_setting_is_refused_with_the_difference(tmp_path: Path) -> None:
    Store.create(tmp_path, SETTING)
    fine = CollectionConfig(camera=SETTING.collection.camera, fidelity=Fidelity(push_solver_iterations=12))
    changes = {
        "task: the store has push, given pull": {"task": "pull"},
        "objects: the store has 3 entries, given 2": {"objects": SETTING.objects[:2]},
        r"objects\[0\].id: the store has object-0, given object-2 \(and 3 more\)": {"objects": SETTING.objects[::-1]},
        "collection.fidelity.push_solver_iterations: the store has 10, given 12": {"collection": fine},
    }
    for message, change in changes.items():
        with pytest.raises(StoreError, match=message) as caught:
            Store.create(tmp_path, SETTING.model_copy(update=change))
        assert "\n" not in str(caught.value)


def test_a_place_is_checked_as_a_store_is_made(tmp_path: Path) -> None:
    Store.check_free(tmp_path / "new", None)
    assert not (tmp_path / "new").exists()
    Store.create(tmp_path / "made", SETTING)
    Store.check_free(tmp_path / "made", SETTING)
    with pytest.raises(StoreError, match="holds another setting: seed"):
        Store.check_free(tmp_path / "made", SETTING.model_copy(update={"seed": SETTING.seed + 1}))
    with pytest.raises(StoreError, match="is not empty and no store"):
        Store.check_free(tmp_path, None)
    with pytest.raises(StoreError, match="is a file, so no store can be made here; name a new folder"):
        Store.check_free(tmp_path / "made" / "store.json", None)


def test_folders_that_are_no_store_are_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_bytes(b"x")
    with pytest.raises(StoreError, match=r"not empty and no store \(it holds 'thesis.tex'\)"):
        Store.create(tmp_path / "full", SETTING)
    with pytest.raises(StoreError, match="no store can be made here"):
        Store.create(tmp_path / "full" / "thesis.tex", SETTING)
    with pytest.raises(StoreError, match="there is no such folder"):
        Store.open(tmp_path / "missing")
    with pytest.raises(StoreError, match=r"has no store.json"):
        Store.open(tmp_path / "full")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["thesis.tex"]


def test_what_a_killed_creator_left_is_no_foreign_file(tmp_path: Path) -> None:
    (tmp_path / ".tmp-store.json~host~1~1~aa").write_bytes(b"half")
    (tmp_path / ".lock-driver").touch()
    assert Store.create(tmp_path, SETTING).setting == SETTING


def test_another_schema_version_is_refused(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1))
    for path in (store.path / "store.json", next(store.path.glob("shards/*/manifest.json"))):
        content = without_checksum(path.read_bytes(), "it")
        path.write_bytes(with_checksum(content | {"schema_version": 99}))
        with pytest.raises(StoreError, match="schema version 99, but this software reads 1 to 4"):
            Store.open(store.path).committed()
        path.write_bytes(with_checksum(content))


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"{}", b"\xff\xfe", b'{"schema_version": 1}', b"[" * 100_000])
def test_a_damaged_description_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    Store.create(tmp_path, SETTING)
    (tmp_path / "store.json").write_bytes(content)
    with pytest.raises(StoreError) as caught:
        Store.open(tmp_path)
    assert "\n" not in str(caught.value)


def test_rows_find_their_clouds(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2), (2, 5))
    table = store.interactions(["point", "point_index", "rollout"])
    assert table.column_names == ["point", "point_index", "rollout", "observation", "shard"]
    clouds = {manifest.shard_id: store.read_observations(manifest.shard_id) for manifest in store.committed()}
    assert len(table) == 40
    for row in table.to_pylist():
        cloud = clouds[row["shard"]].observation(row["observation"])
        assert np.array_equal(cloud.points[row["point_index"]], np.float32(row["point"]))


def test_a_shard_opens_in_plain_zarr_and_parquet(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2))
    shard = store.path / "shards" / store.committed()[0].shard_id
    rollouts = fabricate_rollouts(PLAN, Job(PLAN.key, 0, 2))
    clouds = zarr.open_group(shard / "observations.zarr", mode="r")
    points = clouds["points"][...]
    assert points.dtype == np.float16
    assert np.array_equal(points, [one.points for rollout in rollouts for one in rollout.observations])
    motions = pq.read_table(shard / "interactions.parquet").column("motion").to_pylist()
    assert motions == [one.outcome.motion for rollout in rollouts for one in rollout.interactions]


@pytest.mark.slow
def test_reading_leaves_no_thread_that_could_outlive_python(tmp_path: Path) -> None:
    # One of Arrow's that drops the last reference to our bytes while Python ends takes the process down (SIGABRT).
    make(tmp_path / "store", (0, 2))
    code = (
        "import os, sys\n"
        "from shared.store import Store, verify\n"
        "store, before = Store.open(sys.argv[1]), len(os.listdir('/proc/self/task'))\n"
        "assert not verify(store) and store.interactions() and store.rollouts()\n"
        "assert len(os.listdir('/proc/self/task')) == before"
    )
    root = str(Path(__file__).parents[2])
    subprocess.run([sys.executable, "-c", code, tmp_path / "store"], env={**os.environ, "PYTHONPATH": root}, check=True)


def test_both_frames_say_the_same(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2))
    clouds = store.read_observations(store.committed()[0].shard_id)
    for row in store.interactions().to_pylist():
        pose = clouds.world_from_camera[row["observation"]]
        assert np.allclose(pose[:3, :3] @ row["point_camera"] + pose[:3, 3], row["point"])
        in_camera, in_world = (np.reshape(row[name], (3, 3)) for name in ("rotation_camera", "rotation"))
        assert np.allclose(pose[:3, :3] @ in_camera, in_world)


def test_every_row_repeats_its_rollout(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 3))
    rollouts = {row["rollout"]: row for row in store.rollouts().to_pylist()}
    assert len(COPIED_COLUMNS) > 10
    for row in store.interactions().to_pylist():
        assert all(row[name] == rollouts[row["rollout"]][name] for name in COPIED_COLUMNS)


def test_every_column_is_described(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1))
    for table in (store.interactions(), store.rollouts()):
        assert all(field.metadata[b"description"] for field in table.schema if field.name != "shard")


def test_an_unknown_column_is_refused_with_the_likely_spelling(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no column 'sucess' in the interactions; did you mean 'success'"):
        make(tmp_path / "store").interactions(["sucess"])


@pytest.mark.parametrize("name", ["", "..", "../../etc", "random-v0-00000000-00000099", "random-v0-1-2", "/"])
def test_shards_that_are_not_there_are_refused(tmp_path: Path, name: str) -> None:
    store = make(tmp_path / "store", (0, 1))
    with pytest.raises(StoreError, match="holds no committed shard"):
        store.read_observations(name)


@given(
    st.from_regex(r"[a-z][a-z0-9-]{0,8}", fullmatch=True),
    st.integers(0, 10**6),
    st.integers(0, 10**9),
    st.integers(1, 9),
)
def test_shard_names_say_their_job(proposer: str, version: int, start: int, length: int) -> None:
    job = Job(f"{proposer}-v{version}", start, start + length)
    assert parse_shard_id(job.shard_id) == job


def test_info_counts_what_is_there(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", SETTING)
    rollout = fabricate_rollout(PLAN, 0, interactions=8)
    crashed = dataclasses.replace(
        rollout.interactions[0].outcome, kind=OutcomeKind.ABANDONED, success=False, motion=0.0
    )
    store.commit(PLAN, Job(PLAN.key, 0, 1), [with_first(rollout, outcome=crashed)], {})
    store.commit(PLAN, Job(PLAN.key, 1, 2), [fabricate_rollout(PLAN, 1, interactions=0)], {})
    figures = info(store)
    successes = sum(one.outcome.success for one in rollout.interactions[1:])
    assert (figures.shards, figures.rollouts, figures.interactions, figures.observations) == (2, 2, 8, 1)
    assert {name: (t.interactions, t.successes) for name, t in figures.by_category.items()} == {
        "StorageFurniture": (7, successes)
    }, "an infrastructure failure is no label"
    assert list(figures.by_proposer) == ["random v0"]
    assert list(figures.by_role) == ["collect"]
    assert figures.by_outcome["abandoned"] == 1
    assert sum(figures.by_outcome.values()) == 8
    assert figures.by_status == {"nothing-to-act-on": 1, "ok": 1}
    on_disk = sum(path.stat().st_size for path in store.path.glob("shards/*/**/*") if path.is_file())
    assert figures.bytes == on_disk


def test_info_of_an_empty_store(tmp_path: Path) -> None:
    figures = info(make(tmp_path / "store"))
    assert figures.interactions == 0
    assert np.isnan(figures.bytes_per_interaction)


def test_policies_are_immutable_and_checked(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    files = {"weights.safetensors": bytes(range(256)), "policy.json": b"{}"}
    store.publish_policy(3, files)
    store.publish_policy(3, files)
    store.publish_policy(1, {"policy.json": b"{}"})
    assert store.policy_versions() == (1, 3)
    assert store.read_policy(3) == files
    with pytest.raises(StoreError, match="exists with other content"):
        store.publish_policy(3, {"policy.json": b"{}"})
    with pytest.raises(StoreError, match=r"there is no policy 2; published: 1, 3"):
        store.read_policy(2)
    assert store.read_policy(3) == files
    assert not list(store.path.rglob(".tmp-*"))
    assert verify(store) == []


@pytest.mark.parametrize("name", ["../x", "/x", "", ".x", "index.json", "A", "a/b", "a\n"])
def test_policy_files_have_plain_names(tmp_path: Path, name: str) -> None:
    with pytest.raises(StoreError, match="is not allowed"):
        make(tmp_path / "store").publish_policy(1, {name: b"x"})


def test_documents_are_read_by_people(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1))
    document = json.loads((store.path / "store.json").read_text())
    assert document["setting"]["task"] == "push"
    assert document["software"]["zarr"]


def test_a_plan_written_before_a_setting_existed_is_still_the_same_plan(tmp_path: Path) -> None:
    setting = fabricate_setting()
    store, plan = Store.create(tmp_path / "store", setting), Plan(setting=setting)
    older = plan.model_dump(mode="json")
    del older["setting"]["collection"]["fidelity"]["end_holds_at_rest"]
    (tmp_path / "store" / "plans").mkdir()
    (tmp_path / "store" / "plans" / f"{plan.key}.json").write_bytes(with_checksum(older))
    store.add_plan(plan)
    assert store.plans() == (plan,)
