"""A plan's digest is the same for any number of workers, any order of jobs, a fresh process and an old one."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from collector.objects.catalogue import for_task, scan
from collector.objects.procedural import generate
from collector.worker import Worker
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.plan import Job, Plan, Setting
from shared.store import Store
from shared.tasks import task_named

ROLLOUTS = 4
FLAGS = {
    "task": "pull",
    "seed": 11,
    "rollouts": ROLLOUTS,
    "collection.camera.image-size": 128,
    "collection.camera.points": 256,
    "collection.camera.candidates": 1000,
    "collection.rollout.interactions": 6,
    "collection.rollout.actions-per-state": 3,
}


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 2, "Faucet": 1, "Switch": 1}, seed=8)
    return folder


@pytest.fixture(scope="module")
def other_objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("others")
    generate(folder, {"Box": 2, "Bucket": 2, "TrashCan": 2, "Door": 2}, seed=9)
    return folder


@pytest.fixture(scope="module")
def fresh(objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """What a process of its own makes of the plan, one job after the other."""
    return collected(tmp_path_factory.mktemp("fresh") / "store", objects, workers=0, per_shard=ROLLOUTS)


def collected(path: Path, objects: Path, workers: int, per_shard: int, **more: object) -> Store:
    """The store of `adaafford collect` in a process of its own."""
    flags = FLAGS | {"objects": objects, "store": path, "workers": workers, "per-shard": per_shard} | more
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    program = "import sys; from cluster.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", program, "collect", *words], check=True, capture_output=True)
    return Store.open(path)


def grow_old(path: Path, setting: Setting, others: Path, rollouts: int) -> None:
    """Make rollouts of other objects, under another task, in this process."""
    refs = tuple(entry.ref for entry in for_task(scan(others), task_named("push")).usable)
    digest_of(path, setting.model_copy(update={"task": "push", "objects": refs}), others, [(0, rollouts)])


def digest_of(path: Path, setting: Setting, objects: Path, jobs: list[tuple[int, int]]) -> str:
    """The digest of a new store after some jobs, executed in this order in this process."""
    plan = Plan(setting=setting)
    store = Store.create(path, setting)
    worker = Worker(path, objects)
    for start, stop in jobs:
        worker.run(plan, Job(plan.key, start, stop))
    return store.digest()


@pytest.mark.parametrize("seed", range(2))
def test_the_order_and_the_size_of_jobs_do_not_matter(fresh: Store, objects: Path, tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cuts = [0, *sorted(rng.choice(np.arange(1, ROLLOUTS), 2 + seed, replace=False).tolist()), ROLLOUTS]
    jobs = [(cuts[k], cuts[k + 1]) for k in rng.permutation(len(cuts) - 1)]
    assert digest_of(tmp_path / "store", fresh.setting, objects, jobs) == fresh.digest()


def test_what_a_process_did_before_does_not_matter(
    fresh: Store, objects: Path, other_objects: Path, tmp_path: Path
) -> None:
    grow_old(tmp_path / "others", fresh.setting, other_objects, 4)
    assert digest_of(tmp_path / "store", fresh.setting, objects, [(0, ROLLOUTS)]) == fresh.digest()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_hundreds_of_rollouts_before_do_not_matter(
    fresh: Store, objects: Path, other_objects: Path, tmp_path: Path
) -> None:
    grow_old(tmp_path / "others", fresh.setting, other_objects, 300)
    assert digest_of(tmp_path / "store", fresh.setting, objects, [(3, ROLLOUTS), (0, 3)]) == fresh.digest()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("workers", "per_shard"), [(1, 2), (2, 1)])
def test_the_number_of_workers_does_not_matter(
    fresh: Store, objects: Path, tmp_path: Path, workers: int, per_shard: int
) -> None:
    assert collected(tmp_path / "store", objects, workers, per_shard).digest() == fresh.digest()


def test_the_order_of_jobs_does_not_matter_to_a_suction_cup_or_to_the_errors_of_a_camera(
    objects: Path, tmp_path: Path
) -> None:
    refs = tuple(entry.ref for entry in for_task(scan(objects), task_named("pull")).usable)
    collection = CollectionConfig(
        gripper="suction",
        camera=CameraConfig(image_size=128, points=256, candidates=1000, noise=1.0),
        rollout=RolloutConfig(interactions=4, actions_per_state=2),
    )
    setting = Setting(task="pull", seed=11, objects=refs, collection=collection)
    jobs = {"one": [(0, 3)], "more": [(2, 3), (0, 1), (1, 2)]}
    digests = {digest_of(tmp_path / name, setting, objects, of) for name, of in jobs.items()}
    assert len(digests) == 1


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_suction_cup_and_the_errors_of_a_camera_are_the_same_for_any_worker(objects: Path, tmp_path: Path) -> None:
    more = {"collection.gripper": "suction", "collection.camera.noise": 1.0}
    one, two = (collected(tmp_path / str(n), objects, n, 2, **more).digest() for n in (0, 2))
    assert one == two


def test_another_seed_gives_another_digest(fresh: Store, objects: Path, tmp_path: Path) -> None:
    other = fresh.setting.model_copy(update={"seed": 12})
    assert digest_of(tmp_path / "store", other, objects, [(0, ROLLOUTS)]) != fresh.digest()
