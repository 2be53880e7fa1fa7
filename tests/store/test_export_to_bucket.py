"""An export into a bucket: byte for byte the one into a folder, and it goes on after whatever stopped it."""

from pathlib import Path

import pytest

from cluster.cli.main import run
from shared.errors import UnreadableError, UsageError
from shared.store import Store, export
from shared.store.backends.base import StorageBackend, backend_of
from shared.store.maintenance.formats import EXPORT_FORMATS
from tests.store.test_export_formats import SPLITS, contents, make, refused
from tests.support.faults import Fault, bucket_faults, disk_faults


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return make(tmp_path_factory.mktemp("stores") / "store")


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder of this machine, in which nothing may be left."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def objects_of(url: str) -> dict[str, bytes]:
    backend: StorageBackend = backend_of(url)
    return {key: backend.read(key, 1 << 26) for key in backend.leaves("")}


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
def test_an_export_into_a_bucket_is_that_into_a_folder(
    name: str, store: Store, s3_url: str, temporary: Path, tmp_path: Path
) -> None:
    assert export(store, s3_url, SPLITS, format=name).out == s3_url
    export(store, tmp_path / "out", SPLITS, format=name)
    assert objects_of(s3_url) == contents(tmp_path / "out")
    assert not list(temporary.iterdir())


def test_an_export_into_a_bucket_goes_on_with_what_is_not_finished(
    store: Store, s3_url: str, temporary: Path, tmp_path: Path
) -> None:
    said = list[tuple[int, int]]()

    def stop(done: int, total: int) -> None:
        said.append((done, total))
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(store, s3_url, SPLITS, stop, format="minari")
    assert not list(temporary.iterdir())
    assert ".export/begun.json" in objects_of(s3_url)
    before = len(said)
    export(store, s3_url, SPLITS, lambda *counts: said.append(counts), format="minari")
    assert len(said) - before < before, "pieces that were finished are not written again"
    export(store, tmp_path / "out", SPLITS, format="minari")
    assert objects_of(s3_url) == contents(tmp_path / "out")
    before = len(said)
    export(store, s3_url, SPLITS, lambda *counts: said.append(counts), format="minari")
    assert len(said) - before == len(store.parts()), "each shard was looked through, and none was written"
    for splits, name in ((SPLITS, "hf"), ({"train": SPLITS["train"]}, "minari")):
        with pytest.raises(UsageError, match="is there already; name a new prefix"):
            export(store, s3_url, splits, format=name)
    assert objects_of(s3_url) == contents(tmp_path / "out")


def test_an_export_into_a_bucket_begins_anew_where_the_command_is_another(
    store: Store, s3_url: str, temporary: Path, tmp_path: Path
) -> None:
    def stop(done: int, total: int) -> None:
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(store, s3_url, SPLITS, stop, format="plain")
    export(store, s3_url, SPLITS, format="hf")
    export(store, tmp_path / "out", SPLITS, format="hf")
    assert objects_of(s3_url) == contents(tmp_path / "out")


def test_a_bucket_that_refuses_ends_an_export_in_one_line_and_it_goes_on(
    store: Store, s3_url: str, temporary: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(store, tmp_path / "out", SPLITS, format="hf")
    with bucket_faults(Fault("ENOSPC", 0)) as steps:
        export(store, f"{s3_url}/counted", SPLITS, format="hf")
    # The last step removes the marker of this process; that it does not go changes nothing.
    for step in (1, 3, len(steps) // 2, len(steps) - 1):
        url = f"{s3_url}/{step}"
        with bucket_faults(Fault("ENOSPC", step)), pytest.raises(UnreadableError, match="check the network") as error:
            export(store, url, SPLITS, format="hf")
        assert "\n" not in str(error.value)
        export(store, url, SPLITS, format="hf")
        assert objects_of(url) == contents(tmp_path / "out")
    capsys.readouterr()
    args = [str(store.path), "--format", "hf", "--out"]
    for url, line in {
        "s3://missing/data": "there is no such bucket; create it, or name another",
        "gs://bucket/data": "no place for a store; allowed: a folder, or s3://BUCKET/PREFIX",
    }.items():
        assert line in refused([*args, url], capsys)
    with pytest.raises(UsageError, match="a path cannot hold the two slashes of a URL"):
        export(store, Path("s3://bucket/data"), SPLITS)
    assert "--push puts the files of a folder on the Hub" in refused([*args, s3_url, "--push", "me/data"], capsys)


def test_a_full_temporary_folder_ends_an_export_in_one_line_and_it_goes_on(
    store: Store, s3_url: str, temporary: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = [str(store.path), "--format", "plain", "--out", s3_url]
    with disk_faults(Fault("ENOSPC", 2)):
        said = refused(args, capsys)
    assert "cannot be written through the temporary folder (No space left on device), which TMPDIR names" in said
    assert not list(temporary.iterdir())
    assert run(["store", "export", *args]) == 0


def test_a_large_file_goes_to_a_bucket_in_parts(s3_url: str, tmp_path: Path) -> None:
    from shared.store.backends.s3 import S3Backend

    file = tmp_path / "large"
    file.write_bytes(bytes(range(256)) * 50_000)
    bucket = S3Backend.of(s3_url)
    bucket.upload("a/large", file)
    bucket.upload("a/large", file)
    assert bucket.read("a/large", 1 << 24) == file.read_bytes()
