"""Importing objects: every kind of source becomes the same object, in its place, or is refused with one line."""

import json
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import shared.extras as extras_module
from cluster.cli.main import run
from collector.objects import meshes
from collector.objects.articulation import ArticulatedObject, Mesh
from collector.objects.child_process import ChildProcess
from collector.objects.importing.importer import Imported, ImportSettings, import_object
from collector.objects.importing.layouts import (
    ARTICULATE_PROGRAMS,
    GAPARTNET_PARTS,
    GAPARTNET_URDF,
    Placement,
    source_of,
)
from collector.objects.importing.mesh_files import TOO_LARGE, MeshParser, capsule
from collector.objects.readers import read_object
from collector.objects.writing import obj_text
from shared.errors import ObjectError, UsageError
from shared.extras import MODULES
from tests.support.synced import Synced

EXACT = ("package://package", "model://package", "../meshes")
"""Names that say where the mesh is; the others only say how its path ends."""
BOX = np.array([0.2, 0.4, 0.6])
COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="a" count="24">VERTICES</float_array>
      <technique_common><accessor source="#a" count="8" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>FACES</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
  </library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""


def collada(mesh: Mesh) -> str:
    """A COLLADA document in centimetres."""
    vertices = " ".join(map(str, (mesh.vertices * 100).ravel()))
    return COLLADA.replace("VERTICES", vertices).replace("FACES", " ".join(map(str, mesh.faces.ravel())))


def glb(mesh: Mesh, uri: str | None = None) -> bytes:
    """A binary glTF file; `uri` names the buffer in another file."""
    indices, corners = mesh.faces.astype("<u4").tobytes(), mesh.vertices.astype("<f4").tobytes()
    low, high = mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "buffers": [{"byteLength": len(indices) + len(corners), **({} if uri is None else {"uri": uri})}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": len(corners)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5125, "count": mesh.faces.size, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3", "min": low, "max": high},
        ],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = indices + corners
    total = 12 + 8 + len(text) + 8 + len(body)
    head = struct.pack("<4sII", b"glTF", 2, total)
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body


def urdf(mesh: str = "meshes/door.obj", limits: str = 'lower="-1.5" upper="0"', more: str = "") -> str:
    """A cabinet in metres that faces +y: a box with a door, hinged at its left, which opens towards -1.5."""
    return f"""<?xml version="1.0"?>
<robot name="cabinet">
  <link name="body"><visual><geometry><box size="0.4 0.2 0.6"/></geometry></visual></link>
  <link name="front_door">
    <visual><origin xyz="0.2 0.01 0"/><geometry><mesh filename="{mesh}"/></geometry></visual>
    <collision><origin xyz="0.2 0.01 0"/><geometry><box size="0.4 0.02 0.6"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute"><origin xyz="-0.2 0.1 0"/><axis xyz="0 0 -1"/>
    <parent link="body"/><child link="front_door"/><limit {limits} effort="1" velocity="1"/>{more}</joint>
</robot>
"""


@pytest.fixture
def cabinet(tmp_path: Path) -> Path:
    """The URDF, below `package/urdf`, whose meshes are beside it."""
    folder = tmp_path / "package" / "urdf"
    (folder / "meshes").mkdir(parents=True)
    (folder / "cabinet.urdf").write_text(urdf())
    (folder / "meshes/door.obj").write_text(obj_text(meshes.box(np.array([0.4, 0.02, 0.6]))))
    return folder / "cabinet.urdf"


def imported(file: Path, out: Path, settings: ImportSettings | None = None) -> Imported:
    source = source_of(file)
    return import_object(source, out / source.name, settings or ImportSettings(placement=Placement(front="+y")))


def corners(target: ArticulatedObject) -> tuple[np.ndarray, np.ndarray]:
    """The bounding box of what can be seen, all joints at their lower limits."""
    poses = target.body_poses(target.limits()[:, 0])
    seen = [
        mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        for body, pose in zip(target.bodies, poses, strict=True)
        for mesh in body.visuals
    ]
    return np.concatenate(seen).min(axis=0), np.concatenate(seen).max(axis=0)


def test_an_imported_object_faces_our_front_at_the_usual_size(cabinet: Path, tmp_path: Path) -> None:
    made = imported(cabinet, tmp_path / "objects")
    assert np.allclose(made.extent, [0.4, 0.22, 0.6])
    low, high = corners(made.after)
    assert np.allclose(low + high, 0, atol=1e-9)
    assert np.isclose(np.linalg.norm(high - low), 2.0)
    # Our x is the depth, and the door is in front.
    assert np.allclose((high - low) / (high - low)[2], np.array([0.22, 0.4, 0.6]) / 0.6)
    (door,) = made.after.parts
    assert door.joint is not None
    assert door.part_name == "front_door"
    assert made.after.body_poses(np.zeros(1))[1][0, 3] < 0
    assert read_object(made.folder).ref == made.after.ref


def test_a_door_that_closes_at_its_upper_limit_is_turned_round(cabinet: Path, tmp_path: Path) -> None:
    made = imported(cabinet, tmp_path / "objects")
    joint = made.after.parts[0].joint
    assert joint is not None
    assert (joint.lower, joint.upper) == (0.0, 1.5)
    assert any("turned round" in note for note in made.notes)
    # Opened, the free edge is further ahead (-x) than the closed door.
    poses = [made.after.body_poses(np.array([position]))[1] for position in (0.0, 1.5)]
    ahead = [(made.after.parts[0].visuals[0].vertices @ pose[:3, :3].T + pose[:3, 3])[:, 0].min() for pose in poses]
    assert ahead[1] < ahead[0] - 0.5


@pytest.mark.parametrize(
    ("front", "up", "expected"),
    [
        ("-x", "+z", np.eye(3)),
        ("+x", "+z", np.diag([-1.0, -1.0, 1.0])),
        ("+z", "+y", np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])),
    ],
)
def test_front_and_up_decide_the_rotation(front: str, up: str, expected: np.ndarray) -> None:
    placement = Placement(front=front, up=up)  # type: ignore[arg-type]
    assert np.array_equal(placement.rotation(), expected)
    assert np.isclose(np.linalg.det(placement.rotation()), 1)


def test_front_and_up_along_one_axis_are_refused() -> None:
    with pytest.raises(UsageError, match="along one axis"):
        Placement(front="-z", up="+z").rotation()


def test_a_scale_is_taken_instead_of_a_size(cabinet: Path, tmp_path: Path) -> None:
    made = imported(cabinet, tmp_path / "objects", ImportSettings(placement=Placement(front="+y", scale=3.0)))
    low, high = corners(made.after)
    assert np.allclose(high - low, 3 * np.array([0.22, 0.4, 0.6]))


@pytest.fixture(scope="module")
def parser() -> Iterator[MeshParser]:
    with MeshParser() as parser:
        yield parser


@pytest.mark.parametrize("ending", ["obj", "stl", "ply", "glb", "dae"])
def test_every_mesh_format_gives_the_same_mesh(ending: str, parser: MeshParser) -> None:
    wanted = meshes.box(BOX)
    if ending == "dae":
        pytest.importorskip("collada")
        data = collada(wanted).encode()
    elif ending == "glb":
        data = glb(wanted)
    else:
        trimesh = pytest.importorskip("trimesh")
        data = trimesh.Trimesh(wanted.vertices, wanted.faces, process=False).export(file_type=ending)
    found = parser.parse(data.encode() if isinstance(data, str) else data, f"box.{ending}")
    both = [np.sort((mesh.vertices[mesh.faces]).reshape(-1, 9), axis=0) for mesh in (found, wanted)]
    assert np.allclose(both[0], both[1], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("box.glb", glb(meshes.box(BOX), uri="../secret.bin"), "names other files"),
        ("box.glb", glb(meshes.box(BOX))[:40], "cannot be read"),
        ("box.glb", b"", "cannot be read"),
        ("box.glb", glb(meshes.placed(meshes.box(BOX), np.eye(4), np.full(3, np.nan))), "not finite"),
        ("box.dae", b'<!DOCTYPE x [<!ENTITY a "b">]><COLLADA>&a;</COLLADA>', "cannot be read"),
        ("box.dae", b"PK\x03\x04", "cannot be read"),
        ("box.fbx", b"", "allowed: .obj"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_refused_with_one_line(
    name: str, data: bytes, reason: str, parser: MeshParser
) -> None:
    if name.endswith(".dae"):
        pytest.importorskip("collada")
    with pytest.raises(ObjectError, match=reason) as raised:
        parser.parse(data, name)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("answer", "reason"), [(b"", "within 60 s"), (TOO_LARGE, "too much memory")])
def test_a_mesh_that_takes_too_long_or_too_much_memory_is_not_left_out(
    answer: bytes, reason: str, cabinet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An object may name thousands of them."""
    monkeypatch.setattr(ChildProcess, "ask", lambda *_: answer)
    monkeypatch.setattr(ChildProcess, "end", lambda _: True)
    (cabinet.parent / "meshes/door.glb").write_bytes(glb(meshes.box(BOX)))
    cabinet.write_text(urdf("meshes/door.glb"))
    with pytest.raises(ObjectError, match=reason):
        imported(cabinet, tmp_path / "objects")


def test_a_mesh_of_more_than_the_memory_of_its_process_is_refused() -> None:
    pytest.importorskip("trimesh")
    program = "from collector.objects.importing import mesh_process, mesh_files\n"
    program += "mesh_process.trimesh.load_scene = lambda *_, **__: bytes(1 << 60)\n"
    program += "print(mesh_process._answer(b'.ply    ') == mesh_files.TOO_LARGE)"
    assert subprocess.run([sys.executable, "-c", program], check=True, capture_output=True).stdout == b"True\n"


@pytest.mark.parametrize(
    "name",
    [
        "package://package/meshes/door.obj",
        "package://another_name/meshes/door.obj",
        "../meshes/door.obj",
        "file:///elsewhere/package/meshes/door.obj",
        "C:\\work\\package\\meshes\\door.obj",
        "model://package/meshes/%64oor.obj",
    ],
)
def test_meshes_are_found_below_a_search_path_and_nowhere_else(name: str, cabinet: Path, tmp_path: Path) -> None:
    package = cabinet.parent.parent
    (cabinet.parent / "meshes").rename(package / "meshes")
    cabinet.write_text(urdf(name))
    with pytest.raises(ObjectError, match="--search-path"):
        imported(cabinet, tmp_path / "objects")
    made = imported(cabinet, tmp_path / "objects", ImportSettings(search=[cabinet.parent / ".."]))
    assert len([note for note in made.notes if "ends of their paths" in note]) == (not name.startswith(EXACT))
    assert len(made.after.parts[0].visuals) == 1


@pytest.mark.parametrize("name", ["../../outside.obj", "{folder}/outside.obj", "meshes/link.obj"])
def test_a_mesh_outside_of_the_folders_is_never_read(name: str, cabinet: Path, tmp_path: Path) -> None:
    (tmp_path / "outside.obj").write_text((cabinet.parent / "meshes/door.obj").read_text())
    (cabinet.parent / "meshes/link.obj").symlink_to(tmp_path / "outside.obj")
    cabinet.write_text(urdf(name.format(folder=tmp_path)))
    with pytest.raises(ObjectError, match=r"--search-path|leads out of the folder"):
        imported(cabinet, tmp_path / "objects")
    assert not (tmp_path / "objects/cabinet").exists()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<robot", "malformed XML"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>', "entities are refused"),
        (urdf("http://example.org/door.obj"), "scheme"),
        (urdf(limits='lower="0" upper="0"'), "no joint can move"),
        (urdf("meshes/door.fbx"), "must be a file of"),
    ],
)
def test_a_broken_urdf_is_refused_and_nothing_is_left(
    text: str, reason: str, cabinet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cabinet.write_text(text)
    out = tmp_path / "objects"
    assert run(["objects", "import", str(cabinet), "--out", str(out)]) == 2
    printed = capsys.readouterr()
    assert printed.err == ""
    assert reason in printed.out
    assert printed.out.startswith("cabinet  refused: ")
    assert printed.out.count("\n") == 1
    assert not out.exists() or not list(out.iterdir())


def test_an_import_that_was_killed_leaves_nothing_to_the_next(cabinet: Path, tmp_path: Path) -> None:
    objects = tmp_path / "objects"
    code = "import os, signal; from pathlib import Path; from collector.objects.importing import importer, layouts\n"
    code += "importer.read_object = lambda folder: os.kill(os.getpid(), signal.SIGKILL)\n"
    code += f"source = layouts.source_of(Path({str(cabinet)!r}))\n"
    code += f"importer.import_object(source, Path({str(objects / 'mine')!r}), importer.ImportSettings())"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert [path.name.startswith(".tmp-") for path in objects.iterdir()] == [True]
    assert [path.name for path in imported(cabinet, objects).folder.parent.iterdir()] == [cabinet.stem]


def test_a_mimic_is_said(cabinet: Path, tmp_path: Path) -> None:
    cabinet.write_text(urdf(more='<mimic joint="other"/>'))
    assert any("<mimic>" in note for note in imported(cabinet, tmp_path / "objects").notes)


def test_only_what_is_below_the_root_is_imported(cabinet: Path, tmp_path: Path) -> None:
    arm = '<link name="arm"/><joint name="weld" type="fixed"><parent link="arm"/><child link="body"/></joint></robot>'
    cabinet.write_text(urdf().replace("</robot>", arm))
    made = imported(cabinet, tmp_path / "objects", ImportSettings(root="body"))
    assert [body.part_name for body in made.after.bodies] == ["body", "front_door"]
    with pytest.raises(ObjectError, match="no link 'nothing'"):
        imported(cabinet, tmp_path / "others", ImportSettings(root="nothing"))


def test_gapartnet_names_its_parts(cabinet: Path, tmp_path: Path) -> None:
    folder = cabinet.parent
    cabinet.rename(folder / GAPARTNET_URDF)
    links = [
        {"link_name": "body", "is_gapart": False, "category": "", "bbox": []},
        {"link_name": "front_door", "is_gapart": True, "category": "hinge_door", "bbox": []},
    ]
    (folder / GAPARTNET_PARTS).write_text(json.dumps(links))
    (folder / "meta.json").write_text('{"model_cat": "StorageFurniture"}')
    made = imported(folder, tmp_path / "objects")
    assert made.after.ref.category == "StorageFurniture"
    assert made.after.parts[0].part_name == "hinge_door"
    (folder / GAPARTNET_PARTS).write_text("{")
    with pytest.raises(ObjectError, match="malformed JSON"):
        imported(folder, tmp_path / "others")


def test_articulate_anything_faces_forward(cabinet: Path) -> None:
    cabinet.rename(cabinet.parent / "mobility.urdf")
    assert source_of(cabinet.parent).front == "-x"
    (cabinet.parent / ARTICULATE_PROGRAMS[0]).write_text("")
    found = source_of(cabinet.parent)
    assert (found.layout, found.front) == ("articulate-anything", "+x")


def test_the_command_shows_the_object_before_and_after(
    cabinet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "objects"
    line = ["objects", "import", str(cabinet), "--out", str(out), "--front", "+y"]
    assert run([*line, "--category", "StorageFurniture", "--part-names", "front_door=rotation_door"]) == 0
    assert "cabinet  usable: StorageFurniture, 1 movable part" in capsys.readouterr().out
    assert (out / "cabinet.png").read_bytes().startswith(b"\x89PNG")
    assert run(["objects", "check", str(out), "--task", "pull-closed-door"]) == 0
    capsys.readouterr()
    assert run(line) == 2
    assert "is there already" in capsys.readouterr().err
    assert run([*line, "--replace"]) == 0
    # What was not imported is never replaced.
    (out / "cabinet/meta.json").write_text('{"model_cat": "Box"}')
    assert run([*line, "--replace"]) == 2


def test_an_object_that_was_imported_survives_a_power_cut(
    cabinet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = Synced(monkeypatch)
    assert run(["objects", "import", str(cabinet), "--out", str(tmp_path / "objects"), "--front", "+y"]) == 0
    assert synced.lacks(tmp_path / "objects/cabinet") == []


def test_an_import_that_was_stopped_before_its_picture_goes_on(
    cabinet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "objects"
    line = ["objects", "import", str(cabinet), "--out", str(out), "--front", "+y"]

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("collector.viz.rendering.contact_sheet", stop)
        assert run(line) == 130
    made = {path: path.stat().st_mtime_ns for path in (out / "cabinet").rglob("*")}
    assert made and not (out / "cabinet.png").exists()
    assert run(line) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "cabinet").rglob("*")} == made
    assert (out / "cabinet.png").exists()


def test_a_replacement_that_was_stopped_goes_on(cabinet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "objects"
    line = ["objects", "import", str(cabinet), "--out", str(out)]
    assert run([*line, "--front", "+y"]) == 0
    line += ["--front", "+x", "--replace"]

    def stop_within(path: Path) -> None:
        next(path.rglob("meta.json")).unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("collector.objects.importing.importer.remove_tree", stop_within)
        assert run(line) == 130
    assert run(line) == 0
    assert [path.name for path in out.iterdir() if path.is_dir() and not path.name.startswith(".")] == ["cabinet"]
    assert read_object(out / "cabinet")


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--scale", "1", "--size", "2"], "exclude each other"),
        (["--part-names", "door"], "LINK=NAME"),
        (["--part-names", "lid=door"], "no such part"),
        (["--search-path", "nowhere"], "no such folder"),
        (["--front", "+z"], "along one axis"),
        (["--id", "../x"], "may hold letters"),
    ],
)
def test_settings_that_cannot_be_honoured_are_refused(
    flags: list[str], reason: str, cabinet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["objects", "import", str(cabinet), "--out", str(tmp_path / "objects"), *flags]) == 2
    printed = capsys.readouterr()
    assert reason in printed.err + printed.out
    assert "Traceback" not in printed.err


def test_what_is_no_object_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    for path in (tmp_path, tmp_path / "notes.txt", tmp_path / "nothing"):
        with pytest.raises(UsageError, match=r"name a \.urdf"):
            source_of(path)


def test_a_capsule_is_closed_and_of_its_length() -> None:
    mesh = capsule(0.1, 0.3)
    assert np.allclose(mesh.vertices[:, 2].max(), 0.4)
    edges = np.sort(np.concatenate([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_placements_are_pure(cabinet: Path, tmp_path: Path) -> None:
    settings = ImportSettings(placement=Placement(front="+y"))
    first, second = (imported(cabinet, tmp_path / name, settings) for name in ("a", "b"))
    assert first.after.ref == second.after.ref
    turned = imported(cabinet, tmp_path / "c", replace(settings, placement=Placement(front="-y")))
    assert turned.after.ref != first.after.ref


@pytest.mark.parametrize(
    ("file", "package"), [("door.dae", "pycollada"), ("door.glb", "trimesh"), ("room.xml", "mujoco")]
)
def test_a_package_that_is_missing_is_named_with_its_extra(
    file: str,
    package: str,
    cabinet: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found, hidden = extras_module.find_spec, MODULES.get(package, package)
    monkeypatch.setattr(extras_module, "find_spec", lambda name: None if name == hidden else found(name))
    (cabinet.parent / "meshes" / file).write_bytes(b"")
    cabinet.write_text(urdf(f"meshes/{file}"))
    source = cabinet.parent / "meshes" / file if file.endswith(".xml") else cabinet
    assert run(["objects", "import", str(source), "--out", str(tmp_path / "objects")]) == 2
    assert f"needs {package}, not installed here: pip install 'adaafford[import]'" in capsys.readouterr().err
