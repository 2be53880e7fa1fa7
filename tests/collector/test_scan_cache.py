"""What scans remember: nothing is read twice, and no change of an object's files goes unseen."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from collector.objects import catalogue
from collector.objects.catalogue import scan
from collector.objects.files import ObjectFiles
from collector.objects.procedural import generate
from shared.errors import UsageError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    generate(folder, {"Faucet": 2}, seed=1)
    return folder


@pytest.fixture
def objects(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two faucets, with a cache of their own that takes files as settled however new they are."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(catalogue, "SETTLED_NS", -(10**18))
    return Path(shutil.copytree(made, tmp_path / "objects"))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Fills with the folders that files are read from."""
    folders: list[str] = []
    original = ObjectFiles.read

    def reading(self: ObjectFiles, name: str, most_bytes: int) -> bytes:
        folders.append(self.folder.name)
        return original(self, name, most_bytes)

    monkeypatch.setattr(ObjectFiles, "read", reading)
    return folders


def test_objects_that_did_not_change_are_read_once(objects: Path, read: list[str]) -> None:
    first = scan(objects)
    assert set(read) == {"faucet-0000", "faucet-0001"}
    read.clear()
    assert scan(objects) == first
    assert read == []
    assert scan(objects, anew=True) == first
    assert set(read) == {"faucet-0000", "faucet-0001"}


def test_files_that_have_just_changed_are_not_remembered(
    objects: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue, "SETTLED_NS", 3_600_000_000_000)
    scan(objects)
    read.clear()
    scan(objects)
    assert set(read) == {"faucet-0000", "faucet-0001"}


def mesh_of(folder: Path) -> Path:
    return next(iter(sorted(folder.rglob("*.obj"))))


def rewrite_with_old_times(folder: Path) -> None:
    """Other contents of the same length, and the times of the last change put back."""
    file, before = mesh_of(folder), mesh_of(folder).stat()
    data = file.read_bytes()
    place = next(i for i, letter in enumerate(data) if letter in b"12345678" and data[i - 1 : i] == b".")
    file.write_bytes(data[:place] + bytes([data[place] + 1]) + data[place + 1 :])
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


def put_a_link(folder: Path) -> None:
    """A mesh becomes a link to another object's."""
    other, file = mesh_of(folder.parent / "faucet-0001"), mesh_of(folder)
    file.unlink()
    file.symlink_to(other)


CHANGES: dict[str, Callable[[Path], object]] = {
    "a mesh's contents": rewrite_with_old_times,
    "a mesh is gone": lambda folder: mesh_of(folder).unlink(),
    "a mesh is a link": put_a_link,
    "the URDF": lambda folder: (folder / "mobility.urdf").write_bytes((folder / "mobility.urdf").read_bytes() + b"\n"),
    "a new file": lambda folder: (folder / "more.txt").write_text("more"),
    "semantics are gone": lambda folder: (folder / "semantics.txt").unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_of_an_object_is_seen(change: str, objects: Path, read: list[str]) -> None:
    scan(objects)
    CHANGES[change](objects / "faucet-0000")
    read.clear()
    after = scan(objects)
    assert "faucet-0000" in read
    assert "faucet-0001" not in read
    assert after == scan(objects, anew=True)


@pytest.mark.parametrize("software", [{"adaafford": "0"}, {}])
def test_what_other_software_found_does_not_count(
    software: dict[str, str], objects: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scan(objects)
    read.clear()
    monkeypatch.setattr(catalogue, "software_versions", lambda: software)
    scan(objects)
    assert set(read) == {"faucet-0000", "faucet-0001"}


@pytest.mark.parametrize("contents", [b"", b"{", b'{"folder": 1}', b"[" * 100_000, b"\xff" * 2_000_000])
def test_a_damaged_cache_is_of_no_account(contents: bytes, objects: Path, tmp_path: Path) -> None:
    first = scan(objects)
    for place in (tmp_path / "cache/adaafford/objects").iterdir():
        place.write_bytes(contents)
    assert scan(objects) == first


def test_a_cache_that_cannot_be_written_is_of_no_account(objects: Path, tmp_path: Path) -> None:
    first = scan(objects)
    for place in (tmp_path / "cache/adaafford/objects").iterdir():
        place.unlink()
        place.mkdir()
    assert scan(objects) == first


def test_without_a_place_for_a_cache_objects_are_read_anew(
    objects: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = scan(objects)

    def refuse(name: str) -> Path:
        raise UsageError(f"there is no place for {name}")

    monkeypatch.setattr(catalogue, "cache_folder", refuse)
    read.clear()
    assert scan(objects) == first
    assert set(read) == {"faucet-0000", "faucet-0001"}


def test_another_tree_is_asked_anew(objects: Path, read: list[str]) -> None:
    scan(objects)
    read.clear()
    scan(objects / "faucet-0000")
    assert set(read) == {"faucet-0000"}
