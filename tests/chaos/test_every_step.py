"""An error or a kill at every single write step of a commit, on a disk and in a bucket."""

from pathlib import Path

import pytest

from tests.chaos.counts import Counts
from tests.store.test_crashes import run
from tests.store.test_write_faults import digest_without_faults, disturb_all, kill_at_all
from tests.support.faults import BUCKET_FAULTS, DISK_FAULTS, KILLS, bucket_faults, disk_faults

pytestmark = pytest.mark.chaos


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    return digest_without_faults(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("kind", DISK_FAULTS)
def test_an_error_on_a_disk(kind: str, tmp_path: Path, undisturbed: str, counts: Counts) -> None:
    counts.disturbed("disk", kind, disturb_all(lambda name: str(tmp_path / name), disk_faults, kind, undisturbed))


@pytest.mark.parametrize("kind", BUCKET_FAULTS)
def test_an_error_in_a_bucket(kind: str, s3_url: str, undisturbed: str, counts: Counts) -> None:
    counts.disturbed("bucket", kind, disturb_all(lambda name: f"{s3_url}/{name}", bucket_faults, kind, undisturbed))


@pytest.mark.parametrize("kind", KILLS)
@pytest.mark.parametrize("place", ["disk", "bucket"])
def test_a_kill(kind: str, place: str, base: str, counts: Counts) -> None:
    counts.disturbed(place, kind, kill_at_all(f"{base}/store", kind))


def test_a_kill_while_a_store_is_made(tmp_path: Path, counts: Counts) -> None:
    counts.disturbed("disk, making the store", "kill before", run("kill-creations", tmp_path))
