"""Catalogue, splits and previews."""

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from collector import procedural
from collector.catalogue import Catalogue, for_task, load, load_ref, qualifying_parts, read_list, scan, split
from collector.preview import contact_sheet, part_colours, picture
from shared.errors import ObjectError, UsageError
from shared.plan import ObjectRef
from shared.tasks import TASKS

CLOSED_DOOR, FAUCET = TASKS["pull-closed-door"], TASKS["push-faucet"]


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few generated objects; tests that change files copy it."""
    out = tmp_path_factory.mktemp("shelf")
    procedural.generate(out, {"StorageFurniture": 8, "Faucet": 3, "Box": 2}, seed=3)
    (out / "objects.txt").write_text("faucet-0001 Faucet\nbox-0000 Box closed\n\nbox-0009 Box\n")
    (out / ".hidden").mkdir()
    return out


def reference(object_id: str, category: str) -> ObjectRef:
    return ObjectRef(id=object_id, category=category, content_hash="0" * 64)


def test_a_scan_lists_every_object_once_in_order(shelf: Path) -> None:
    catalogue = scan(shelf)
    ids = [entry.ref.id for entry in catalogue.usable]
    assert ids == sorted(ids)
    assert len(set(ids)) == 13
    assert catalogue.refused == ()
    assert catalogue == scan(shelf)


def test_a_broken_object_is_listed_with_its_reason(shelf: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(shelf, tmp_path / "copy"))
    (copy / "box-0001/mobility.urdf").write_text("<robot>")
    (copy / "not-an-object").mkdir()
    catalogue = scan(copy)
    reasons = dict(catalogue.refused)
    assert set(reasons) == {"box-0001", "not-an-object"}
    assert "malformed XML" in reasons["box-0001"]
    assert "mobility.urdf' is missing" in reasons["not-an-object"]
    assert len(catalogue.usable) == 12


def test_a_list_selects_objects(shelf: Path) -> None:
    catalogue = scan(shelf, shelf / "objects.txt")
    assert [entry.ref.id for entry in catalogue.usable] == ["box-0000", "faucet-0001"]
    assert [object_id for object_id, _ in catalogue.refused] == ["box-0009"]


def test_one_object_is_a_catalogue_of_its_own(shelf: Path) -> None:
    (entry,) = scan(shelf / "box-0000").usable
    assert entry.ref.id == "box-0000"
    assert load_ref(shelf / "box-0000", entry.ref).ref == load_ref(shelf, entry.ref).ref == entry.ref


@pytest.mark.parametrize("name", ["missing", "empty", "file"])
def test_a_path_without_objects_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UsageError, match="name a folder"):
        scan(tmp_path / name)


@pytest.mark.parametrize("text", ["../escape Box\n", "a/b Box\n", "\0 Box\n"])
def test_a_list_cannot_name_paths(tmp_path: Path, text: str) -> None:
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(UsageError, match="not an object's id"):
        read_list(tmp_path / "list.txt")


def test_a_list_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="not text"):
        read_list(tmp_path / "list.txt")
    with pytest.raises(UsageError, match="cannot be read"):
        read_list(tmp_path / "none.txt")


def test_loading_gives_the_object_that_was_catalogued(shelf: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(shelf / "box-0000", tmp_path / "box-0000"))
    (entry,) = scan(copy).usable
    assert load(entry).ref == entry.ref
    semantics = copy / "semantics.txt"
    semantics.write_text(semantics.read_text().replace("rotation_lid", "cover"))
    with pytest.raises(ObjectError, match="not the object that was planned"):
        load(entry)


def test_a_task_takes_only_parts_of_its_kind(shelf: Path) -> None:
    catalogue = scan(shelf)
    for task in (CLOSED_DOOR, FAUCET):
        fit = for_task(catalogue, task)
        assert {entry.ref.category for entry in fit.usable} <= set(task.categories)
        assert len(fit.usable) + len(fit.refused) == len(catalogue.usable)
        for entry in fit.usable:
            numbers = qualifying_parts(entry, task)
            assert numbers == qualifying_parts(load(entry), task)
            assert all(entry.parts[k - 1].kind == "revolute" for k in numbers)
            assert all(any(n in entry.parts[k - 1].name for n in task.part_names) for k in numbers)
    reasons = dict(for_task(catalogue, CLOSED_DOOR).refused)
    assert "this is a Box" in reasons["box-0000"]
    drawers = [e.ref.id for e in catalogue.usable if {p.name for p in e.parts} == {"drawer"}]
    assert all(reasons[object_id] == "no part that the task 'pull-closed-door' may act on" for object_id in drawers)
    assert len(for_task(catalogue, TASKS["push"]).usable) == 13


@given(
    sizes=st.dictionaries(st.sampled_from(["Box", "Door", "Faucet", "Safe"]), st.integers(1, 20), min_size=1),
    seed=st.integers(0, 99),
)
def test_splits_are_disjoint_complete_stratified_and_pure(sizes: dict[str, int], seed: int) -> None:
    fractions = (0.6, 0.15, 0.25)
    refs = [reference(f"{name}-{i}", name) for name, size in sizes.items() for i in range(size)]
    parts = split(refs, fractions, seed)
    chosen = [*parts.train, *parts.validation, *parts.test]
    assert sorted(chosen, key=lambda ref: ref.id) == sorted(refs, key=lambda ref: ref.id)
    assert split(refs[::-1], fractions, seed) == parts
    if len(refs) >= 3:
        assert all((parts.train, parts.validation, parts.test))
    for fraction, part in zip(fractions, (parts.train, parts.validation, parts.test), strict=True):
        counts = Counter(ref.category for ref in part)
        assert all(abs(counts[name] - fraction * size) <= 2 for name, size in sizes.items())


def test_the_seed_decides_the_split() -> None:
    refs = [reference(f"box-{i}", "Box") for i in range(30)]
    assert len({split(refs, (0.5, 0.2, 0.3), seed) for seed in range(5)}) == 5


@pytest.mark.parametrize("fractions", [(0.5, 0.5, 0.5), (1.5, -0.5, 0.0), (0.0, 0.0, 0.0)])
def test_fractions_must_sum_to_one(fractions: tuple[float, float, float]) -> None:
    with pytest.raises(UsageError, match="must sum to 1"):
        split([], fractions, 0)


def test_a_preview_shows_every_visible_part(shelf: Path, tmp_path: Path) -> None:
    objects = [load(entry) for entry in scan(shelf).usable[:3]]
    contact_sheet(objects, tmp_path / "made/sheet.png", image_size=64)
    assert (tmp_path / "made/sheet.png").read_bytes().startswith(b"\x89PNG")
    colours = part_colours(len(objects[0].parts))
    pixels = picture(objects[0], 0.5, 205.0, 96).reshape(-1, 3)
    shades = pixels / np.maximum(pixels.max(axis=1, keepdims=True), 1e-9)
    for colour in colours:
        assert (np.abs(shades - colour / colour.max()).max(axis=1) < 1e-6).any()


def test_a_preview_of_nothing_or_to_nowhere_is_refused(shelf: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no usable object"):
        contact_sheet([], tmp_path / "sheet.png")
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UsageError, match="cannot be written"):
        contact_sheet([load(scan(shelf).usable[0])], tmp_path / "file/sheet.png", image_size=32)


@pytest.fixture(scope="module")
def real_catalogue(real_objects: Path) -> Catalogue:
    return scan(real_objects, real_objects / "objects.txt")


@pytest.mark.real_objects
def test_every_real_object_is_usable_or_refused_with_a_reason(real_objects: Path, real_catalogue: Catalogue) -> None:
    catalogue = real_catalogue
    assert len(catalogue.usable) + len(catalogue.refused) == len(read_list(real_objects / "objects.txt"))
    assert len(catalogue.usable) >= 0.85 * (len(catalogue.usable) + len(catalogue.refused))
    assert all(reason and "\n" not in reason for _, reason in catalogue.refused)
    assert len(for_task(catalogue, CLOSED_DOOR).usable) >= 4
    assert len(for_task(catalogue, FAUCET).usable) >= 4


@pytest.mark.real_objects
def test_real_objects_stand_upright_about_the_origin(real_catalogue: Catalogue) -> None:
    entries = [entry for entry in real_catalogue.usable if entry.ref.category == "StorageFurniture"][:6]
    for described in map(load, entries):
        poses = described.body_poses(described.limits()[:, 0])
        vertices = np.concatenate(
            [
                mesh.vertices @ p[:3, :3].T + p[:3, 3]
                for b, p in zip(described.bodies, poses, strict=True)
                for mesh in b.visuals
            ]
        )
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        assert np.abs(low + high).max() < 0.6
        assert 1.5 < np.linalg.norm(high - low) < 2.5
