"""Collection, killed at random moments until it is done: in one process, on Ray, on a disk and in a bucket."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared.store import Store
from tests.chaos.campaigns import (
    CLUSTER_BUCKET,
    CLUSTER_DISK,
    COLLECT,
    SERIAL_BUCKET,
    SERIAL_DISK,
    SESSION_BUCKET,
    SESSION_DISK,
    Siege,
    Trial,
)
from tests.chaos.counts import Counts
from tests.chaos.processes import Marked, Role
from tests.chaos.ray_cluster import RayCluster
from tests.chaos.witness import Witness

pytestmark = pytest.mark.chaos

IN_SESSION = {Role.DRIVER: 4.0, Role.ACTOR: 4.0, Role.HEAD: 2.0, Role.GCS: 1.0, Role.ALL: 2.0}
IN_CLUSTER = {Role.DRIVER: 3.0, Role.ACTOR: 14.0, Role.RAYLET: 3.0, Role.HEAD: 0.4, Role.ALL: 0.4}


def collecting(base: str, *flags: str) -> Callable[[str], Trial]:
    """Trials of collection below a folder or a prefix, each into a store of its own."""

    def trial(name: str) -> Trial:
        store = f"{base}/{name}"
        command = [*COLLECT, *flags, "--store", store]
        return Trial([command], Witness(store).look, lambda: Store.open(store).digest())

    return trial


def test_a_driver_without_ray_on_a_disk(tmp_path: Path, seed: int, counts: Counts, everybody: list[Marked]) -> None:
    """Objects are built anew by each, so that it is killed while it builds them, too."""
    siege = Siege(SERIAL_DISK, {Role.DRIVER: 1.0}, tmp_path, seed, counts, everybody)
    siege.lay(
        collecting(str(tmp_path), "--workers", "0", "--rollouts", "24", "--procedural-per-category", "2"), at_once=2
    )


def test_a_driver_without_ray_in_a_bucket(
    tmp_path: Path, s3_url: str, objects: Path, seed: int, counts: Counts, everybody: list[Marked]
) -> None:
    siege = Siege(SERIAL_BUCKET, {Role.DRIVER: 1.0}, tmp_path, seed, counts, everybody)
    siege.lay(collecting(s3_url, "--workers", "0", "--rollouts", "24", "--objects", str(objects)), at_once=2)


@pytest.mark.parametrize(("name", "place"), [(SESSION_DISK, "disk"), (SESSION_BUCKET, "bucket")])
def test_any_process_of_a_session_of_its_own(
    name: str,
    place: str,
    base: str,
    ray_folder: Path,
    tmp_path: Path,
    objects: Path,
    seed: int,
    counts: Counts,
    everybody: list[Marked],
) -> None:
    environment = {"TMPDIR": str(ray_folder)}
    siege = Siege(name, IN_SESSION, tmp_path, seed, counts, everybody, lambda: Marked(environment), most=7)
    siege.lay(collecting(base, "--workers", "2", "--rollouts", "40", "--objects", str(objects)))


@pytest.fixture(scope="module")
def cluster(s3_environment: dict[str, str]) -> Iterator[RayCluster]:
    cluster = RayCluster(s3_environment)
    cluster.mend()
    yield cluster
    cluster.close()


@pytest.mark.parametrize(("name", "place"), [(CLUSTER_DISK, "disk"), (CLUSTER_BUCKET, "bucket")])
def test_any_process_of_a_cluster(
    name: str,
    place: str,
    base: str,
    cluster: RayCluster,
    tmp_path: Path,
    objects: Path,
    seed: int,
    counts: Counts,
    everybody: list[Marked],
) -> None:
    siege = Siege(
        name, IN_CLUSTER, tmp_path, seed, counts, everybody, lambda: cluster.marked, cluster.mend, most=16, within_s=6.0
    )
    flags = ["--workers", "2", "--rollouts", "80", "--objects", str(objects), "--ray-address", cluster.address]
    siege.lay(collecting(base, *flags))
