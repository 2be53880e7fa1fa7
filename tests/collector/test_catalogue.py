"""Catalogue, splits and previews."""

import logging
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.main import run as adaafford
from cluster.config.campaign_config import ObjectSelection
from cluster.config.objects import objects_for
from collector.objects import procedural
from collector.objects.catalogue import Catalogue, for_task, load, load_ref, qualifying_parts, read_list, scan, split
from collector.viz.rendering import contact_sheet, part_colours, picture
from shared.errors import ObjectError, UsageError
from shared.plan import ObjectRef
from shared.store import Store, verify
from shared.tasks import task_named

CLOSED_DOOR, FAUCET = task_named("pull-closed-door"), task_named("push-faucet")


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


def test_a_list_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_bytes(b"\xef\xbb\xbfbox-0000 Box \r\nbox-0001 Box\r\n")
    assert read_list(tmp_path / "list.txt") == ("box-0000", "box-0001")


@pytest.mark.parametrize("text", ["", " \n\n"])
def test_a_list_that_names_no_object_is_refused(shelf: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(UsageError, match="names no object"):
        scan(shelf, tmp_path / "list.txt")


def test_a_list_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="not text"):
        read_list(tmp_path / "list.txt")
    with pytest.raises(UsageError, match="cannot be read"):
        read_list(tmp_path / "none.txt")


def linked(shelf: Path, cache: Path, links: Path, name: str = "box-0000") -> Path:
    """An object whose files are links into a cache, as clients of model hubs keep what they download."""
    for number, path in enumerate(path for path in (shelf / name).rglob("*") if path.is_file()):
        cache.mkdir(parents=True, exist_ok=True)
        blob = Path(shutil.copy(path, cache / f"{number:040x}"))
        link = links / name / path.relative_to(shelf / name)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blob, link.parent))
    return links


@pytest.mark.parametrize(
    ("cache", "links"),
    [
        ("hub/blobs", "hub/snapshots/abc"),
        ("hub/blobs", "hub/snapshots/abc/data/objects"),
        ("repository/.dvc/cache/files", "repository/objects"),
        ("repository/.git/annex/objects/a", "repository/data/objects"),
        ("objects/.contents", "objects"),
    ],
)
def test_links_into_the_cache_of_a_download_are_followed(shelf: Path, tmp_path: Path, cache: str, links: str) -> None:
    objects = linked(shelf, tmp_path / cache, tmp_path / links)
    (tmp_path / "shortcut").symlink_to(objects)
    for path in (objects, tmp_path / "shortcut"):
        (entry,) = scan(path).usable
        assert entry.ref == scan(shelf / "box-0000").usable[0].ref
        assert load(entry).ref == load_ref(path, entry.ref).ref == entry.ref


@pytest.mark.parametrize(
    ("link", "cache", "links"),
    [
        ("all/sub/.git", "all/.git/modules/sub/annex/objects/a", "all/sub/objects"),
        ("all/sub/.git", "all/.git/modules/sub/annex/objects/a", "all/sub"),
    ],
)
@pytest.mark.parametrize("gitfile", [False, True])
def test_the_cache_of_a_submodule_is_followed(
    shelf: Path, tmp_path: Path, link: str, cache: str, links: str, gitfile: bool
) -> None:
    objects = linked(shelf, tmp_path / cache, tmp_path / links)
    ((_, reason),) = scan(objects).refused
    assert "leads out" in reason
    linking = tmp_path / link
    linking.parent.mkdir(parents=True, exist_ok=True)
    kept = tmp_path / cache.removesuffix("/files/md5").removesuffix("/a").removesuffix("/annex/objects")
    target = os.path.relpath(kept, linking.parent)
    if gitfile and linking.name == ".git":
        linking.write_text(f"gitdir: {target}\n")
    else:
        linking.symlink_to(target)
    (entry,) = scan(objects).usable
    assert entry.ref == scan(shelf / "box-0000").usable[0].ref
    (tmp_path / "disk-secret").write_text("the key is 1234\n")
    meta = objects / "box-0000/meta.json"
    meta.unlink()
    meta.symlink_to(tmp_path / "disk-secret")
    ((_, reason),) = scan(objects).refused
    assert "leads out" in reason


@pytest.mark.parametrize(
    ("link", "links"),
    [
        ("repository/.dvc/cache", "repository/objects"),
        ("objects/.dvc/cache", "objects"),
        ("repository/.git/annex/objects", "repository/objects"),
        ("hub/blobs", "hub/snapshots/abc"),
    ],
)
def test_a_cache_that_is_a_link_to_elsewhere_is_not_followed(
    shelf: Path, tmp_path: Path, link: str, links: str
) -> None:
    objects = linked(shelf, tmp_path / "disk", tmp_path / links)
    (tmp_path / link).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / link).symlink_to(tmp_path / "disk")
    ((_, reason),) = scan(objects).refused
    assert "leads out" in reason


@pytest.mark.parametrize("target", ["", "secrets"])
def test_what_an_object_calls_a_cache_is_none(shelf: Path, tmp_path: Path, target: str) -> None:
    folder = Path(shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000"))
    (tmp_path / "secrets").mkdir()
    shutil.copy(folder / "meta.json", tmp_path / "secrets/meta.json")
    (folder / "meta.json").unlink()
    (folder / "meta.json").symlink_to(tmp_path / "secrets/meta.json")
    (folder / ".dvc").mkdir()
    (folder / ".dvc/cache").symlink_to(tmp_path / target)
    for path in (folder, folder.parent):
        ((_, reason),) = scan(path).refused
        assert "leads out" in reason


def test_a_link_to_an_object_is_followed(shelf: Path, tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    for name in ("box-0000", "other-name"):
        (tmp_path / "objects" / name).symlink_to(shelf / "box-0000")
    entries = scan(tmp_path / "objects").usable
    assert [entry.ref.id for entry in entries] == ["box-0000", "other-name"]
    assert [load_ref(tmp_path / "objects", entry.ref).ref for entry in entries] == [entry.ref for entry in entries]
    (alone,) = scan(tmp_path / "objects/other-name").usable
    assert load_ref(tmp_path / "objects/other-name", alone.ref).ref == alone.ref


@pytest.mark.parametrize("cache", ["elsewhere", "blobs", "snapshots/blobs"])
def test_a_link_out_of_the_tree_is_not_followed_and_the_way_is_said(shelf: Path, tmp_path: Path, cache: str) -> None:
    objects = linked(shelf, tmp_path / cache, tmp_path / "objects")
    ((_, reason),) = scan(objects).refused
    assert "is a link that leads out of the folder of objects" in reason
    assert "cp -rL" in reason


def test_what_a_link_steals_is_in_no_message(shelf: Path, tmp_path: Path) -> None:
    objects = Path(shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000")).parent
    (tmp_path / "secret").write_text("the key is 1234\n")
    mesh = next((objects / "box-0000").rglob("*.obj"))
    mesh.unlink()
    mesh.symlink_to(tmp_path / "secret")
    ((_, reason),) = scan(objects).refused
    assert "leads out" in reason
    assert "1234" not in reason


@pytest.mark.parametrize("name", ["mobility.urdf", "meta.json", "semantics.txt"])
@pytest.mark.parametrize("target", ["nowhere", "itself", "folder"])
def test_links_that_lead_to_no_file_are_refused_in_a_line(shelf: Path, tmp_path: Path, name: str, target: str) -> None:
    folder = Path(shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000"))
    (tmp_path / "objects/folder").mkdir()
    (folder / name).unlink()
    (folder / name).symlink_to(folder / name if target == "itself" else folder.parent / target)
    reason = dict(scan(tmp_path / "objects").refused)["box-0000"]
    assert f"'{name}'" in reason
    assert "\n" not in reason


def overlapping_doors(folder: Path) -> Path:
    """Two doors in one place push each other for ever."""
    shape = "<geometry><box size='0.1 0.9 1.1'/></geometry>"
    door = f"<origin xyz='0 -0.45 0'/>{shape}"
    links = "".join(f"<link name='d{k}'><visual>{door}</visual><collision>{door}</collision></link>" for k in (1, 2))
    joints = "".join(
        f"<joint name='j{k}' type='revolute'><origin xyz='-0.3 0.45 0'/><parent link='body'/><child link='d{k}'/>"
        "<axis xyz='0 0 1'/><limit lower='0' upper='1.57'/></joint>"
        for k in (1, 2)
    )
    body = "<geometry><box size='0.4 1 1.2'/></geometry>"
    (folder / "doors").mkdir(parents=True)
    (folder / "doors/mobility.urdf").write_text(
        f"<robot name='x'><link name='body'><visual>{body}</visual><collision>{body}</collision></link>"
        f"{links}{joints}</robot>"
    )
    (folder / "doors/meta.json").write_text('{"model_cat": "StorageFurniture"}')
    return folder


def test_a_collection_of_what_never_rests_says_so_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    objects, store = overlapping_doors(tmp_path / "objects"), tmp_path / "store"
    command = ["collect", "--objects", str(objects), "--store", str(store), "--rollouts", "2", "--workers", "0"]
    for _ in range(2):
        assert adaafford(command) == 1
        said = capsys.readouterr().err.splitlines()[-1]
        assert "holds no interaction of random-v0: 2 rollouts gave no interaction: 2 never at rest (doors 2)" in said
    assert Store.open(store).rollouts().column("status").to_pylist() == ["never-at-rest"] * 2
    assert verify(Store.open(store)) == []
    assert adaafford(["store", "info", str(store)]) == 0
    printed = capsys.readouterr().out
    assert "2: never-at-rest 2" in printed
    assert "nan" not in printed
    assert adaafford(["objects", "check", str(objects), "--settle"]) == 2
    assert "comes to rest in none of 8 draws" in capsys.readouterr().out


def test_a_store_goes_on_with_the_objects_that_it_was_begun_with(
    shelf: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000")
    command = ["collect", "--objects", str(tmp_path / "objects"), "--store", str(tmp_path / "store"), "--workers", "0"]
    small = ["--collection.rollout.interactions", "1", "--rollouts"]
    assert adaafford([*command, *small, "1"]) == 0
    shutil.copytree(shelf / "box-0001", tmp_path / "objects/box-0001")
    with caplog.at_level(logging.WARNING):
        assert adaafford([*command, *small, "2"]) == 0
    assert "was begun with 1 of the 2 objects that can be used" in caplog.text
    assert [ref.id for ref in Store.open(tmp_path / "store").setting.objects] == ["box-0000"]
    shutil.rmtree(tmp_path / "objects/box-0000")
    assert adaafford([*command, *small, "3"]) == 2


def test_what_is_left_out_is_said_before_collection(
    shelf: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000"))
    urdf = folder / "mobility.urdf"
    shape = '<visual><geometry><mesh filename="textured_objs/new-1.obj"/></geometry></visual></link>'
    urdf.write_text(urdf.read_text().replace("</link>", shape, 1))
    selection = ObjectSelection(objects=tmp_path / "objects")
    with caplog.at_level(logging.WARNING):
        objects_for(task_named("push"), selection, tmp_path / "none", 1, 1)
    assert "object box-0000: 1 of " in caplog.messages[0]
    assert "left out: 'textured_objs/new-1.obj' is absent" in caplog.messages[0]
    assert adaafford(["objects", "check", str(tmp_path / "objects")]) == 0
    assert "left out: 'textured_objs/new-1.obj' is absent" in capsys.readouterr().out


def test_objects_that_cannot_be_used_are_said_before_collection(
    shelf: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(shelf / "box-0000", tmp_path / "objects/box-0000")
    (tmp_path / "objects/half").mkdir()
    (tmp_path / "objects/half/mobility.urdf").write_text("<robot>")
    selection = ObjectSelection(objects=tmp_path / "objects")
    with caplog.at_level(logging.WARNING):
        catalogue, _ = objects_for(task_named("push"), selection, tmp_path / "none", 1, 1)
    assert [entry.ref.id for entry in catalogue.usable] == ["box-0000"]
    (line,) = caplog.messages
    assert line.startswith("object half cannot be used: ")
    assert "'meta.json' is missing" in line


def test_hostile_names_of_folders_are_shown_as_escapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ok\n\x1b[2Jbox-0000  usable\u202e").mkdir()
    (tmp_path / "ok\n\x1b[2Jbox-0000  usable\u202e/mobility.urdf").write_text("<robot/>")
    assert adaafford(["objects", "check", str(tmp_path)]) == 2
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) == 2
    assert not {"\x1b", "\u202e"} & set(printed)


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
    assert len(for_task(catalogue, task_named("push")).usable) == 13


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
    pixels = picture(objects[0], 96).reshape(-1, 3)
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
