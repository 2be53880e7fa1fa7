"""Depth images in a store: kept to the last bit, part of the digest, and absent unless the setting keeps them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import zarr

from shared.config import CameraConfig, CollectionConfig
from shared.depth import DepthMap, pack_steps, unpack_steps
from shared.errors import StoreError
from shared.io.documents import with_checksum
from shared.plan import Job, Plan, RolloutRecord, Setting
from shared.store import Store, compact, export, merge, repair, verify
from shared.store.codecs import observations
from shared.store.layout import DEPTH_VERSION, SCHEMA_VERSION, StoreDocument
from shared.store.writer import rollout_digest
from tests.support.documents import without_checksum
from tests.support.fabricate import fabricate_depth, fabricate_rollout, fabricate_rollouts, fabricate_setting

SETTING = fabricate_setting(keep_depth=True)
PLAN = Plan(setting=SETTING)


def make(path: Path, *jobs: tuple[int, int]) -> Store:
    store = Store.create(path, SETTING)
    for start, stop in jobs:
        job = Job(PLAN.key, start, stop)
        store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
    return store


def depth_of(rollout: RolloutRecord) -> DepthMap:
    dense = rollout.observations[0].dense
    assert isinstance(dense, DepthMap)
    return dense


@pytest.mark.parametrize("shape", [(1, 1), (5, 7, 7), (2, 32, 32)])
def test_packed_steps_are_unpacked_to_the_last_bit(shape: tuple[int, ...]) -> None:
    steps = np.random.default_rng(0).integers(0, 1 << 16, shape).astype(np.uint16)
    assert np.array_equal(unpack_steps(pack_steps(steps)), steps)


def test_a_flat_surface_packs_to_small_numbers() -> None:
    rows, columns = np.mgrid[:40, :40]
    steps = (30_000 + 17.3 * rows - 9.1 * columns).astype(np.uint16)
    assert pack_steps(steps)[1:, 1:].max() <= 3


def test_a_depth_map_gives_the_places_that_the_pixels_saw() -> None:
    # Looks along -x of the world from 5 m away; the middle of the image is at the origin.
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 3] = [-1, 0, 0], [0, -1, 0], [5, 0, 0]
    size, focal = 32, 100.0
    pixels = np.array([0, 5 * size + 20], np.uint32)
    seen = DepthMap.of(pixels, np.array([5.0, 4.5]), size, focal, pose).points()
    expected = [[0.0, -5.0 * 15.5 / focal, 5.0 * 15.5 / focal], [0.5, 4.5 * 4.5 / focal, 4.5 * 10.5 / focal]]
    assert np.allclose(seen, expected, atol=5e-4)
    assert not len(DepthMap.of(pixels, np.array([20.0, 0.2 - 5.0]), size, focal, pose).points())


def test_depth_images_are_kept_to_the_last_bit(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2), (2, 3))
    assert verify(store) == []
    for manifest in store.committed():
        assert (manifest.depth_size, manifest.schema_version) == (32, DEPTH_VERSION)
        for read, made in zip(
            store.read_rollouts(manifest.shard_id), fabricate_rollouts(PLAN, manifest.job), strict=True
        ):
            assert np.array_equal(depth_of(read).steps, depth_of(made).steps)
            assert np.array_equal(depth_of(read).points(), depth_of(made).points())
            assert rollout_digest(read) == rollout_digest(made)
    rows = store.interactions()
    stacked = store.clouds(rows).depth
    assert stacked is not None
    for row, seen in zip(stacked, store.observations(rows), strict=True):
        assert isinstance(seen.dense, DepthMap)
        assert np.array_equal(row, seen.dense.steps)


def test_the_digest_covers_the_depth_image() -> None:
    rollout = fabricate_rollout(PLAN, 0, interactions=1)
    rng = np.random.default_rng(1)
    other = dataclasses.replace(
        rollout.observations[0], dense=fabricate_depth(rng, 32, rollout.observations[0].world_from_camera)
    )
    assert rollout_digest(dataclasses.replace(rollout, observations=(other,))) != rollout_digest(rollout)


def test_stores_with_depth_images_are_repaired_compacted_merged_and_exported(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 2), (2, 3))
    job = Job(PLAN.key, 3, 4)
    store.commit(PLAN, job, [fabricate_rollout(PLAN, 3, 0)], {})
    digest = store.digest()
    assert not repair(store.where)[1].problems
    assert merge([store], tmp_path / "merged")[0].digest() == digest
    export(store, tmp_path / "export", {"all": frozenset(each.id for each in SETTING.objects)})
    exported = zarr.open_group(tmp_path / "export" / "all" / "observations.zarr", mode="r")
    packed = np.asarray(exported["depth"][:1]).astype(np.int64)
    steps = np.where(packed % 2, -(packed + 1) // 2, packed // 2).cumsum(axis=-1).cumsum(axis=-2) % (1 << 16)
    assert np.array_equal(steps[0], depth_of(fabricate_rollout(PLAN, 0)).steps)
    assert "32,768 is the depth" in (tmp_path / "export" / "README.md").read_text()
    compact(store, 64)
    assert (len(store.committed()), store.digest()) == (1, digest)
    assert verify(store) == []


def test_without_the_setting_documents_are_written_as_before(tmp_path: Path) -> None:
    setting = fabricate_setting()
    plan = Plan(setting=setting)
    store = Store.create(tmp_path / "store", setting)
    store.commit(plan, Job(plan.key, 0, 1), fabricate_rollouts(plan, Job(plan.key, 0, 1)), {})
    assert "keep_depth" not in str(setting.as_document())
    described = without_checksum(
        (store.path / "shards" / f"{plan.key}-00000000-00000001" / "manifest.json").read_bytes(), "it"
    )
    assert "depth_size" not in described
    assert described["schema_version"] == SCHEMA_VERSION
    assert StoreDocument(setting=SETTING, software={}, created="").schema_version == DEPTH_VERSION


def test_observations_must_keep_depth_images_as_the_setting_says(tmp_path: Path) -> None:
    without = Plan(setting=fabricate_setting())
    job = Job(PLAN.key, 0, 1)
    with pytest.raises(StoreError, match="keep_depth is set; here it is true"):
        Store.create(tmp_path / "one", SETTING).commit(PLAN, job, fabricate_rollouts(without, job), {})
    with pytest.raises(StoreError, match="keep_depth is set; here it is false"):
        Store.create(tmp_path / "two", without.setting).commit(without, job, fabricate_rollouts(PLAN, job), {})


def test_depth_images_of_several_sizes_are_refused(tmp_path: Path) -> None:
    job = Job(PLAN.key, 0, 2)
    one, other = fabricate_rollouts(PLAN, job)
    pose = other.observations[0].world_from_camera
    larger = dataclasses.replace(other.observations[0], dense=fabricate_depth(np.random.default_rng(0), 40, pose))
    with pytest.raises(StoreError, match="several sizes"):
        Store.create(tmp_path / "store", SETTING).commit(
            PLAN, job, [one, dataclasses.replace(other, observations=(larger,))], {}
        )


@pytest.mark.parametrize("focal", [0.0, -3.0, float("nan"), float("inf")])
def test_what_is_no_focal_length_is_refused(focal: float) -> None:
    seen = fabricate_rollout(PLAN, 0, interactions=1).observations[0]
    assert isinstance(seen.dense, DepthMap)
    odd = dataclasses.replace(seen, dense=dataclasses.replace(seen.dense, focal=np.array([focal])))
    with pytest.raises(ValueError, match="focal"):
        observations.check_observation(odd, 64)
    files = observations.encode([observations.pack(odd)], 64, 32)
    with pytest.raises(StoreError, match="no focal lengths"):
        observations.decode(files, 1, 64, 32, "it")


def test_depth_maps_of_another_camera_are_refused() -> None:
    seen = fabricate_rollout(PLAN, 0, interactions=1).observations[0]
    assert isinstance(seen.dense, DepthMap)
    odd = dataclasses.replace(seen, dense=dataclasses.replace(seen.dense, world_from_camera=np.eye(4)))
    with pytest.raises(ValueError, match="another camera"):
        observations.check_observation(odd, 64)


def test_a_manifest_cannot_ask_for_too_many_pixels(tmp_path: Path) -> None:
    store = make(tmp_path / "store", (0, 1))
    manifest = store.path / "shards" / store.jobs()[0].shard_id / "manifest.json"
    described = without_checksum(manifest.read_bytes(), "it")
    manifest.write_bytes(with_checksum(described | {"depth_size": 1024, "observations": 1 << 10}))
    with pytest.raises(StoreError, match="allowed: 536870912 pixels"):
        store.committed()


def test_a_large_image_cannot_be_kept() -> None:
    with pytest.raises(ValueError, match="image_size of at most 1024; given 2048"):
        Setting(
            task="push",
            seed=0,
            objects=SETTING.objects,
            collection=CollectionConfig(camera=CameraConfig(image_size=2048, keep_depth=True)),
        )
