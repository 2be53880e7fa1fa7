"""Objects of other layouts: a reader that a package adds is asked, and what it makes is checked as ours is."""

import json
import sys
from pathlib import Path

import pytest

from collector.objects.catalogue import load_ref, scan
from collector.objects.readers import READERS, read_object
from shared.errors import ObjectError

READER = """
import json
import numpy as np
from collector.objects.articulation import Body, Joint
from collector.objects.meshes import box
from collector.objects.readers import Description

class Lids:
    def matches(self, folder):
        return (folder / "lid.json").exists()

    def read(self, files):
        told = json.loads(files.read("lid.json", 10_000))
        mesh = box(np.array(told["size"]))
        joint = Joint("hinge", "revolute", told.get("parent", 0), np.eye(4), np.array([0, 1.0, 0]), 0.0, told["upper"])
        bodies = (Body("case", "", None, (mesh,), (mesh,)), Body("lid", "lid", joint, (mesh,), (mesh,)))
        return Description(told.get("category", "Box"), bodies)

LIDS = Lids()
"""


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "package"
    distribution = package / "lids-1.0.dist-info"
    distribution.mkdir(parents=True)
    (package / "lids_of_others.py").write_text(READER)
    (distribution / "METADATA").write_text("Metadata-Version: 2.1\nName: lids\nVersion: 1.0\n")
    (distribution / "entry_points.txt").write_text("[adaafford.object_readers]\nlids = lids_of_others:LIDS\n")
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "lids_of_others", raising=False)
    monkeypatch.setattr(READERS, "_loaded", {})


def write_lid(folder: Path, **changes: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lid.json").write_text(json.dumps({"size": [0.3, 0.2, 0.1], "upper": 1.5} | changes))
    return folder


def test_the_catalogue_asks_the_reader_of_another_package(tmp_path: Path) -> None:
    write_lid(tmp_path / "objects" / "small")
    write_lid(tmp_path / "objects" / "large", size=[0.6, 0.4, 0.2])
    (tmp_path / "objects" / "nothing").mkdir()
    catalogue = scan(tmp_path / "objects")
    assert [entry.ref.id for entry in catalogue.usable] == ["large", "small"]
    assert [(name, "mobility.urdf" in why) for name, why in catalogue.refused] == [("nothing", True)]
    ref = catalogue.usable[1].ref
    assert load_ref(tmp_path / "objects", ref).ref == scan(tmp_path / "objects" / "small").usable[0].ref == ref


def test_the_content_hash_covers_the_files_that_were_read(tmp_path: Path) -> None:
    first = read_object(write_lid(tmp_path / "a")).ref.content_hash
    (tmp_path / "a" / "notes.txt").write_text("not read")
    assert read_object(tmp_path / "a").ref.content_hash == first
    assert read_object(write_lid(tmp_path / "a", upper=1.6)).ref.content_hash != first


def test_the_content_hash_covers_the_version_of_the_package_that_reads(tmp_path: Path) -> None:
    first = read_object(write_lid(tmp_path / "a")).ref.content_hash
    metadata = tmp_path / "package" / "lids-1.0.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("Version: 1.0", "Version: 1.1"))
    assert read_object(tmp_path / "a").ref.content_hash != first


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size": [90.0, 1.0, 1.0]}, "can be .* from the root's origin"),
        ({"size": [float("nan"), 1.0, 1.0]}, "not finite"),
        ({"upper": float("inf")}, "numbers must be finite"),
        ({"upper": 0.0}, "no joint can move"),
        ({"parent": 1}, "needs a joint to a body that comes before it"),
        ({"category": ""}, "the category '' needs 1 to 64"),
        ({"size": "?" * 20_000}, "at most 10000"),
    ],
)
def test_what_a_reader_makes_is_checked(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    folder = write_lid(tmp_path / "odd", **changes)
    with pytest.raises(ObjectError, match=said):
        read_object(folder)


def test_a_reader_follows_no_link_out_of_the_objects(tmp_path: Path) -> None:
    write_lid(tmp_path / "elsewhere")
    folder = tmp_path / "objects" / "link"
    folder.mkdir(parents=True)
    (folder / "lid.json").symlink_to(tmp_path / "elsewhere" / "lid.json")
    with pytest.raises(ObjectError, match="leads out of the folder of objects"):
        read_object(folder, tmp_path / "objects")
