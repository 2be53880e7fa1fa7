"""Importing MJCF: frames, defaults and joints as MuJoCo has them; no file but those of the object is ever read."""

from pathlib import Path

import numpy as np
import pytest

from collector.objects import meshes
from collector.objects.articulation import Body
from collector.objects.importing.importer import ImportSettings, import_object
from collector.objects.importing.layouts import Placement, SourceFiles, source_of
from collector.objects.readers import Description
from collector.objects.writing import obj_text
from shared.errors import ObjectError

pytest.importorskip("mujoco")

from collector.objects.importing.mjcf import read_mjcf

DOOR = """
    <body name="frame" pos="0 0 1" euler="0 0 90">
      <geom type="box" size="0.02 0.3 0.4" pos="0 0.3 0" group="3"/>
      <geom type="mesh" mesh="panel" contype="0" conaffinity="0" pos="0.1 0 0" group="1"/>
      <body name="door" pos="0 0.1 0">
        <joint name="hinge" class="door" axis="0 0 2" pos="0 -0.3 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.5"/>
        <geom type="mesh" mesh="panel" contype="0" conaffinity="0" euler="0 90 0" group="1"/>
      </body>
    </body>
"""


def mjcf(body: str = DOOR, more: str = "", compiler: str = 'meshdir="meshes"') -> str:
    return f"""<mujoco model="room">
  <compiler {compiler}/>
  <asset><mesh name="panel" file="panel.obj" scale="2 1 1"/><texture type="2d" file="/etc/passwd"/>
    <texture type="skybox" builtin="gradient" width="8" height="8"/></asset>
  <default><default class="door"><joint type="hinge" range="-90 0" ref="10"/></default></default>
  <worldbody><light pos="0 0 3"/><geom type="plane" size="5 5 1"/>{body}</worldbody>
  <actuator><motor joint="hinge"/></actuator>{more}
</mujoco>
"""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    folder = tmp_path / "model"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes/panel.obj").write_text(obj_text(meshes.box(np.array([0.1, 0.2, 0.3]))))
    (folder / "room.xml").write_text(mjcf())
    return folder / "room.xml"


def read(file: Path, *search: Path, root: str | None = None, radians: bool = False) -> Description:
    return read_mjcf(file, SourceFiles(file.parent, search), root, radians)


def size(body: Body) -> np.ndarray:
    """The edges of what can be seen, in the body's frame."""
    return np.ptp(np.concatenate([mesh.vertices for mesh in body.visuals]), axis=0)


def test_frames_defaults_and_limits_are_resolved(room: Path) -> None:
    world, door = read(room).bodies
    assert door.joint is not None
    assert (door.link, door.joint.name, door.joint.kind) == ("door", "hinge", "revolute")
    # The limits count from where the file draws the door, which it calls 10 degrees.
    assert np.allclose(np.degrees([door.joint.lower, door.joint.upper]), [-100, -10])
    assert np.allclose(door.joint.axis, [0, 0, 1])
    # Turned by 90 degrees about z, the y of the frame is the world's -x.
    assert np.allclose(door.joint.parent_from_body[:3, 3], [0.2, 0, 1])
    assert np.allclose(size(world), [0.2, 0.2, 0.3])
    assert np.allclose(size(door), [0.3, 0.2, 0.2])
    # The door's mesh stands at its body, 0.3 from the hinge.
    assert np.allclose(door.visuals[0].vertices.mean(axis=0), [0, 0.3, 0])


def test_what_collides_and_what_is_seen_are_kept_apart(room: Path) -> None:
    world, door = read(room).bodies
    assert [len(world.visuals), len(world.collisions)] == [1, 1]
    assert [len(door.visuals), len(door.collisions)] == [1, 1]
    assert np.isclose(np.ptp(door.collisions[0].vertices[:, 2]), 0.54)
    # In one group, both are seen; groups from 3 on are hidden all the same.
    room.write_text(mjcf(DOOR.replace('group="1"', "")))
    assert [len(body.visuals) for body in read(room).bodies] == [1, 2]


def test_a_mesh_stands_where_mujoco_puts_it(room: Path) -> None:
    """Its principal axes are not those of the file, and its centre is not the origin."""
    import mujoco

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0.3, 0.2, 0.5]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    (room.parent / "meshes/panel.obj").write_text(obj_text(meshes.Mesh(corners, faces)))
    room.write_text(mjcf().replace('<texture type="2d" file="/etc/passwd"/>', ""))
    model = mujoco.MjModel.from_xml_path(str(room))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    (geom,) = (g for g in range(model.ngeom) if model.geom_bodyid[g] == 1 and model.geom_dataid[g] >= 0)
    expected = model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    found = read(room).bodies[0].visuals[0].vertices
    assert np.allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=1e-6)


def test_angles_without_a_unit_may_be_radians(room: Path) -> None:
    room.write_text(mjcf().replace('range="-90 0" ref="10"', 'range="-1.5 0"'))
    joint = read(room, radians=True).bodies[1].joint
    assert joint is not None
    assert np.isclose(joint.lower, -1.5)


def test_several_joints_of_a_body_become_a_chain(room: Path) -> None:
    room.write_text(mjcf(DOOR.replace("<geom", '<joint type="slide" axis="1 0 0" range="0 0.5"/><geom', 1)))
    described = read(room)
    slid = next(body.joint for body in described.bodies if body.link == "frame")
    assert slid is not None
    assert (slid.kind, slid.parent) == ("prismatic", 0)
    door = described.bodies[-1].joint
    assert door is not None
    assert described.bodies[door.parent].link == "frame"


def test_nothing_but_what_is_said_is_printed(room: Path) -> None:
    """MuJoCo warns of two joints about one axis, and a warning is an error in tests."""
    hinge = '<joint axis="0 0 1" range="0 90"/>'
    room.write_text(mjcf(DOOR.replace("<geom", f"{hinge}{hinge}<geom", 1)))
    assert len(read(room).bodies) == 4


def test_the_body_that_is_named_is_imported_alone(room: Path, tmp_path: Path) -> None:
    room.write_text(mjcf(DOOR + '<body name="robot"><freejoint/><geom size="0.4"/></body>'))
    assert any("'robot'" in note for note in read(room).notes)
    settings = ImportSettings(root="frame", placement=Placement(front="+x"), part_names={"door": "rotation_door"})
    made = import_object(source_of(room), tmp_path / "objects/room", settings)
    assert [body.part_name for body in made.after.bodies] == ["frame", "rotation_door"]
    assert np.allclose(made.extent[2], 0.3)
    with pytest.raises(ObjectError, match="no body 'nothing'"):
        read(room, root="nothing")


def test_includes_are_read_inside_the_folders_alone(room: Path) -> None:
    parts = room.parent / "parts"
    parts.mkdir()
    (parts / "door.xml").write_text(f"<mujocoinclude>{DOOR}</mujocoinclude>")
    room.write_text(mjcf('<include file="parts/door.xml"/>'))
    assert [body.link for body in read(room).bodies] == ["world", "door"]
    outside = room.parent.parent / "outside.xml"
    outside.write_text(f"<mujocoinclude>{DOOR}</mujocoinclude>")
    for name in ("../outside.xml", str(outside)):
        room.write_text(mjcf(f'<include file="{name}"/>'))
        with pytest.raises(ObjectError, match="--search-path"):
            read(room)
    assert len(read(room, outside.parent).bodies) == 2


def test_included_files_are_bounded_together(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (room.parent / "door.xml").write_text(f"<mujocoinclude>{DOOR}</mujocoinclude>")
    room.write_text(mjcf('<include file="door.xml"/>'))
    monkeypatch.setattr("collector.objects.importing.mjcf.MAX_BYTES", room.stat().st_size + 10)
    with pytest.raises(ObjectError, match="at most 10"):
        read(room)


def test_each_geom_of_a_mesh_counts(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("collector.objects.urdf_bodies.MAX_OBJECT_VERTICES", 8 * 40)
    room.write_text(mjcf('<geom type="mesh" mesh="panel"/>' * 39))
    read(room)
    room.write_text(mjcf('<geom type="mesh" mesh="panel"/>' * 41))
    with pytest.raises(ObjectError, match="more than 320 vertices"):
        read(room)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (mjcf('<include file="room.xml"/>'), "includes itself"),
        (mjcf('<include file="absent.xml"/>'), "absent"),
        (mjcf(more='<extension><plugin plugin="mujoco.pid"/></extension>'), "plugins are code"),
        (mjcf('<body><geom size="1"/><plugin instance="x"/></body>'), "plugins are code"),
        (mjcf('<replicate count="1000000"><geom size="1"/></replicate>'), "<replicate> is refused"),
        (mjcf().replace('file="panel.obj"', 'builtin="cone" params="5 1"'), "<builtin> is refused"),
        (mjcf('<body pos="0 0 1"/>' * 600), "more than 500 elements <body>"),
        (mjcf(more="<default>" + '<default class="many"/>' * 600 + "</default>"), "more than 500 elements <default>"),
        (mjcf('<body><joint type="ball"/><geom size="1"/></body>'), "ball joint"),
        (mjcf("<body>" * 200 + "</body>" * 200), "nested"),
        (mjcf('<body><geom type="box" size="nonsense"/></body>'), "MuJoCo refuses it"),
        (mjcf().replace("panel.obj", "../../panel.obj"), "--search-path"),
        (mjcf().replace("panel.obj", "/etc/passwd"), "--search-path"),
        (mjcf().replace("panel.obj", "absent.obj"), "absent"),
        (mjcf(compiler='meshdir="/etc"').replace("panel.obj", "passwd"), "--search-path"),
        (mjcf().replace('scale="2 1 1"', 'scale="0 1 1"'), "scale"),
        (mjcf('<body pos="1e9 0 0"><geom size="1"/></body>'), "not finite, or beyond"),
        (mjcf('<body><geom size="nan"/></body>'), "not finite|MuJoCo refuses it"),
        ("<sdf/>", "instead of <mujoco>"),
        ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco>&a;</mujoco>', "entities are refused"),
        ("<mujoco", "malformed XML"),
    ],
)
def test_what_cannot_be_imported_is_refused_with_one_line(text: str, reason: str, room: Path, tmp_path: Path) -> None:
    room.write_text(text)
    with pytest.raises(ObjectError, match=reason) as raised:
        import_object(source_of(room), tmp_path / "objects/room", ImportSettings())
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "objects/room").exists()
    assert not Path("MUJOCO_LOG.TXT").exists()
