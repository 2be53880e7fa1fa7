"""The reader: laws of a merged object, and one line for everything that a folder from outside may hold."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from collector.objects import meshes
from collector.objects.files import ObjectFiles
from collector.objects.readers import read_object
from shared import urdf
from shared.errors import ObjectError

CUBE_OBJ = (
    "# a cube\nmtllib none.mtl\no cube\n"
    + "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    + "vn 0 0 1\nusemtl red\ns off\n"
    + "f 1//1 2//1 4//1 3//1\nf 5//1 7//1 8//1 6//1\nf 1//1 5//1 6//1 2//1\n"
    + "f 3//1 4//1 8//1 7//1\nf 1//1 3//1 7//1 5//1\nf 2//1 6//1 8//1 4//1\n"
)

URDF = """<?xml version="1.0"?>
<robot name="test">
  <link name="base"/>
  <link name="body">
    <visual><geometry><mesh filename="textured_objs/cube.obj" scale="2 2 2"/></geometry></visual>
    <collision><geometry><box size="2 2 2"/></geometry></collision>
  </link>
  <link name="door">
    <visual><origin xyz="-1 0 0"/><geometry><mesh filename="textured_objs/cube.obj"/></geometry></visual>
    <collision><origin xyz="-1 0 0"/><geometry><mesh filename="textured_objs/cube.obj"/></geometry></collision>
  </link>
  <link name="handle">
    <visual><geometry><cylinder radius="0.1" length="1"/></geometry></visual>
    <collision><geometry><sphere radius="0.5"/></geometry></collision>
  </link>
  <link name="lock"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
  <joint name="fixed" type="fixed"><origin rpy="1.5707963267948966 0 -1.5707963267948966" xyz="0 0 1"/>
    <parent link="base"/><child link="body"/></joint>
  <joint name="hinge" type="revolute"><origin xyz="0.5 0.25 0"/><axis xyz="0 0.1 0"/>
    <parent link="body"/><child link="door"/><limit lower="0" upper="1.5"/></joint>
  <joint name="weld" type="fixed"><origin xyz="0 0 0.5"/><parent link="door"/><child link="handle"/></joint>
  <joint name="turn" type="continuous"><origin xyz="0 1 0"/><axis xyz="1 0 0"/>
    <parent link="handle"/><child link="lock"/></joint>
</robot>
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A well-formed object: a body, a door with a welded handle, and a lock on the handle."""
    made = tmp_path / "cabinet-1"
    (made / "textured_objs").mkdir(parents=True)
    (made / "textured_objs/cube.obj").write_text(CUBE_OBJ)
    (made / "mobility.urdf").write_text(URDF)
    (made / "meta.json").write_text(json.dumps({"model_cat": "StorageFurniture"}))
    (made / "semantics.txt").write_text("door hinge rotation_door\nbody heavy furniture_body\nlock hinge knob\n")
    return made


def edit(folder: Path, old: str, new: str, name: str = "mobility.urdf") -> None:
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))


def test_fixed_links_become_one_body(folder: Path) -> None:
    described = read_object(folder)
    assert [body.link for body in described.bodies] == ["base", "door", "lock"]
    assert [body.part_name for body in described.bodies] == ["furniture_body", "rotation_door", "knob"]
    assert [len(body.visuals) for body in described.bodies] == [1, 2, 1]
    assert [body.joint.parent for body in described.parts if body.joint] == [0, 1]
    assert described.ref.id == "cabinet-1"
    assert described.ref.category == "StorageFurniture"


def test_zero_pose_is_the_zero_pose_of_the_urdf(folder: Path) -> None:
    described = read_object(folder)
    world_from_body_link = translation(0, 0, 1)
    world_from_body_link[:3, :3] = urdf_rotation(np.pi / 2, 0, -np.pi / 2)
    poses = described.body_poses(np.zeros(2))
    expected_door = world_from_body_link @ translation(0.5, 0.25, 0)
    assert np.allclose(poses[1], expected_door)
    assert np.allclose(poses[2], expected_door @ translation(0, 0, 0.5) @ translation(0, 1, 0))
    # The handle's own origin is baked into the door's frame.
    assert np.allclose(described.bodies[1].visuals[1].vertices.mean(axis=0), [0, 0, 0.5])


def test_a_joint_moves_its_part_and_what_hangs_on_it_alone(folder: Path) -> None:
    described = read_object(folder)
    closed = described.body_poses(np.zeros(2))
    opened, turned = described.body_poses(np.array([0.7, 0.0])), described.body_poses(np.array([0.0, 0.7]))
    assert np.array_equal(opened[0], closed[0])
    assert not np.allclose(opened[1], closed[1])
    assert not np.allclose(opened[2], closed[2])
    assert np.array_equal(turned[:2], closed[:2])
    # What lies on the axis stays where it is.
    assert np.allclose(opened[1][:3, 3], closed[1][:3, 3])


def test_free_joints_are_cut_to_pi_and_axes_are_unit(folder: Path) -> None:
    limits = read_object(folder).limits()
    assert np.allclose(limits, [[0, 1.5], [-np.pi, np.pi]])
    edit(folder, 'lower="0" upper="1.5"', 'lower="-inf" upper="inf"')
    described = read_object(folder)
    assert np.allclose(described.limits()[0], [-np.pi, np.pi])
    assert all(np.isclose(np.linalg.norm(body.joint.axis), 1) for body in described.parts if body.joint)


def test_a_body_without_collision_meshes_collides_as_it_looks(folder: Path) -> None:
    described = read_object(folder)
    assert described.bodies[2].collisions == described.bodies[2].visuals
    assert np.allclose(np.abs(described.bodies[0].collisions[0].vertices - [0, 0, 1]), 1)


def test_the_hash_changes_if_and_only_if_the_content_does(folder: Path) -> None:
    first = read_object(folder).ref.content_hash
    (folder / "unused.txt").write_text("anything")
    (folder / "textured_objs/unused.obj").write_text("anything")
    edit(folder, "}", ', "user_id": "someone"}', "meta.json")
    assert read_object(folder).ref.content_hash == first
    seen = {first}
    for name, old, new in (
        ("textured_objs/cube.obj", "v 0 0 0", "v 0 0 0.001"),
        ("mobility.urdf", 'upper="1.5"', 'upper="1.6"'),
        ("semantics.txt", "knob", "dial"),
        ("meta.json", "StorageFurniture", "Safe"),
    ):
        edit(folder, old, new, name)
        seen.add(read_object(folder).ref.content_hash)
    assert len(seen) == 5


def _deep_json(folder: Path) -> None:
    (folder / "meta.json").write_text("[" * 200_000)


def _spoiled(data: bytes | None) -> Callable[[Path], None]:
    """The door's only mesh is unusable, or absent, and nothing else of it has a shape."""

    def spoil(folder: Path) -> None:
        edit(folder, '<visual><geometry><cylinder radius="0.1" length="1"/></geometry></visual>', "")
        edit(folder, '<collision><geometry><sphere radius="0.5"/></geometry></collision>', "")
        (folder / CUBE).unlink() if data is None else (folder / CUBE).write_bytes(data)

    return spoil


def _many_links(folder: Path) -> None:
    edit(folder, "</robot>", "".join(f'<link name="l{i}"/>' for i in range(urdf.MAX_LINKS)) + "</robot>")


def _many_shapes(folder: Path) -> None:
    shape = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
    edit(folder, '<link name="lock">', '<link name="lock">' + shape * urdf.MAX_SHAPES)


def _many_copies(apart: int) -> Callable[[Path], None]:
    """One large mesh that a small URDF shows again and again, at the same place or elsewhere."""

    def spoil(folder: Path) -> None:
        rows = "".join(f"v {i} {i % 2} 0\n" for i in range(20_000))
        (folder / "textured_objs/cube.obj").write_text(rows + "f 1 2 3\n")
        mesh = '<geometry><mesh filename="textured_objs/cube.obj"/></geometry>'
        shapes = "".join(f'<visual><origin xyz="{i * apart} 0 0"/>{mesh}</visual>' for i in range(300))
        edit(folder, '<link name="lock">', '<link name="lock">' + shapes)

    return spoil


def _escape_by_link(folder: Path) -> None:
    (folder.parent / "secret.obj").write_text(CUBE_OBJ)
    (folder / "textured_objs/cube.obj").unlink()
    (folder / "textured_objs/cube.obj").symlink_to(folder.parent / "secret.obj")


def _link_to_nothing(folder: Path) -> None:
    (folder / CUBE).unlink()
    (folder / CUBE).symlink_to("../.git/annex/objects/W2/9k/KEY/KEY")


def _pipe(folder: Path) -> None:
    (folder / "mobility.urdf").unlink()
    os.mkfifo(folder / "mobility.urdf")


def _replaced(old: str, new: str, name: str = "mobility.urdf") -> Callable[[Path], None]:
    return lambda folder: edit(folder, old, new, name)


def _written(name: str, data: bytes) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return write


def _removed(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


DOOR_MESH = '<visual><origin xyz="-1 0 0"/><geometry><mesh filename="textured_objs/door.obj"/>'
BOMB = (
    b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY b%d "%s">' % (i, (b"&b%d;" % (i - 1) if i else b"&a;") * 10) for i in range(9))
    + b"]><robot name='&b8;'/>"
)
CUBE = "textured_objs/cube.obj"
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 12345\n"
ANNEX_POINTER = b"/annex/objects/MD5E-s12345--" + b"0" * 32 + b".obj\n"
ANNEX_LINK = b"../../.git/annex/objects/W2/9k/KEY/KEY"
HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "no URDF": (_removed("mobility.urdf"), "is missing"),
    "no meta": (_removed("meta.json"), "is missing"),
    "missing mesh": (_spoiled(None), "the movable part 'door' keeps no shape: 'textured_objs/cube.obj' is absent"),
    "truncated OBJ": (_spoiled(CUBE_OBJ.encode()[: -len("2//1 6//1 8//1 4//1\n") + 3]), "truncated"),
    "empty OBJ": (_spoiled(b""), "no faces"),
    "OBJ cut before its faces": (_spoiled(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "no faces"),
    "OBJ half a vertex": (_spoiled(b"v 0 0 0\nv 1 0\nf 1 1 1\n"), "vertex 2 has 2 numbers"),
    "OBJ half a face": (_spoiled(b"v 0 0 0\nv 1 0 0\nf 1 2\n"), "2 corners"),
    "OBJ half a corner": (_spoiled(b"v 0 0 0\nf 1/1 1/1 1/"), "incomplete"),
    "OBJ index out of range": (_spoiled(b"v 0 0 0\nf 1 1 2\n"), "among the 1"),
    "OBJ index zero": (_spoiled(b"v 0 0 0\nf 0 1 1\n"), "among the 1"),
    "OBJ negative index too low": (_spoiled(b"v 0 0 0\nf -1 -1 -2\n"), "among the 1"),
    "OBJ giant index": (_spoiled(b"v 0 0 0\nf 1 1 99999999999999999999999\n"), "not a vertex number"),
    "OBJ not a number": (_spoiled(b"v 0 0 zero\nf 1 1 1\n"), "not a number"),
    "OBJ NaN": (_spoiled(b"v 0 0 nan\nf 1 1 1\n"), "not finite"),
    "OBJ infinite": (_spoiled(b"v 0 0 -inf\nf 1 1 1\n"), "not finite"),
    "OBJ binary": (_spoiled(bytes(range(256))), "not a Wavefront OBJ statement"),
    "OBJ unknown statement": (_spoiled(b"v 0 0 0\nf 1 1 1\ncall other.obj\n"), "not a Wavefront OBJ statement"),
    "OBJ of points": (_spoiled(b"v 0 0 0\nv 1 0 0\nf 1 1 1\nf 2 2 2\n"), "no triangle has an area"),
    "OBJ of a line": (_spoiled(b"v .1 .1 .1\nv .2 .2 .2\nv .3 .3 .3\nf 1 2 3\n"), "no triangle has an area"),
    "scale of zero": (_replaced('scale="2 2 2"', 'scale="0 0 0"'), "a <mesh> needs a scale other than 0"),
    "scale of almost zero": (_replaced('scale="2 2 2"', 'scale="1 1e-12 1"'), "a <mesh> needs a scale other than 0"),
    "box of almost no size": (_replaced('size="2 2 2"', 'size="2 2 1e-300"'), "positive size"),
    "malformed XML": (_replaced("</robot>", "</robo"), "malformed XML"),
    "XML in an unknown encoding": (_written("mobility.urdf", b'<?xml version="1.0" encoding="nil"?><a/>'), "malformed"),
    "not XML": (_written("mobility.urdf", b"\0\1\2"), "malformed XML"),
    "not a robot": (_written("mobility.urdf", b"<html/>"), "instead of <robot>"),
    "no links": (_written("mobility.urdf", b"<robot/>"), "no links"),
    "entity expansion": (_written("mobility.urdf", BOMB), "document types and entities are refused"),
    "external entity": (
        _written("mobility.urdf", b'<!DOCTYPE x SYSTEM "file:///etc/passwd"><robot/>'),
        "document types and entities are refused",
    ),
    "deep XML": (_written("mobility.urdf", b"<a>" * 300_000), "malformed XML"),
    "large URDF": (_written("mobility.urdf", b" " * (urdf.MAX_URDF_BYTES + 1)), "at most"),
    "pipe": (_pipe, "not a regular file"),
    "path escape": (_replaced('"textured_objs/cube.obj"/>', '"../secret.obj"/>'), "not a plain path"),
    "absolute path": (_replaced('"textured_objs/cube.obj"/>', '"/etc/secret.obj"/>'), "not a plain path"),
    "escape by a link": (_escape_by_link, "leads out"),
    "not an OBJ": (_replaced('"textured_objs/cube.obj"/>', '"cube.dae"/>'), "a mesh must be a file of .obj or .stl"),
    "cycle": (_replaced('<parent link="base"/>', '<parent link="lock"/>'), "cycle"),
    "cycle of everything": (
        _replaced("</robot>", '<joint name="j" type="fixed"><parent link="lock"/><child link="base"/></joint></robot>'),
        "no root link",
    ),
    "foreign URI": (
        _replaced('"textured_objs/cube.obj"/>', '"package://door/meshes/door.obj"/>'),
        "copy the file there and name it relative to the URDF (docs/objects.md)",
    ),
    "large OBJ": (_written(CUBE, b"#" * (meshes.MAX_OBJ_BYTES + 1)), "at most"),
    "OBJ of one long line": (_written(CUBE, b"v " + b"1 " * (3 << 20)), "a line of more than"),
    "several roots": (_replaced("</robot>", '<link name="other"/></robot>'), "2 root links"),
    "two joints move a link": (
        _replaced("</robot>", '<joint name="j" type="fixed"><parent link="base"/><child link="lock"/></joint></robot>'),
        "two joints move the link 'lock'",
    ),
    "links of one name": (_replaced('<link name="lock">', '<link name="door">'), "two links are called 'door'"),
    "unknown link": (_replaced('<child link="lock"/>', '<child link="key"/>'), "which is not there"),
    "NaN limit": (_replaced('upper="1.5"', 'upper="nan"'), "limits must be numbers"),
    "giant limit": (_replaced('upper="1.5"', 'upper="1e300"'), "limits must be numbers"),
    "limit that is no number": (_replaced('upper="1.5"', 'upper="far"'), "not a number"),
    "no joint that can move": (
        lambda folder: (
            edit(folder, 'lower="0" upper="1.5"', 'effort="30" velocity="1"'),
            edit(folder, 'type="continuous"', 'type="fixed"'),
        )[0],
        "no joint can move, since the lower and the upper limit of each are the same (such as 0 and 0 of 'hinge')",
    ),
    "no limit": (_replaced('<limit lower="0" upper="1.5"/>', ""), "needs a <limit>"),
    "limits reversed": (_replaced('lower="0" upper="1.5"', 'lower="1" upper="0"'), "above the upper limit"),
    "limits beyond pi": (_replaced('lower="0" upper="1.5"', 'lower="4" upper="inf"'), "leave nothing"),
    "zero axis": (_replaced('xyz="0 0.1 0"', 'xyz="0 0 0"'), "the axis is zero"),
    "NaN axis": (_replaced('xyz="0 0.1 0"', 'xyz="0 nan 0"'), "finite numbers"),
    "infinite origin": (_replaced('xyz="0.5 0.25 0"', 'xyz="0.5 inf 0"'), "finite numbers"),
    "short axis": (_replaced('xyz="0 0.1 0"', 'xyz="0 1"'), "needs 3"),
    "negative box": (_replaced('size="2 2 2"', 'size="2 2 -2"'), "positive size"),
    "floating joint": (_replaced('type="continuous"', 'type="floating"'), "allowed: fixed, revolute"),
    "no movable joint": (
        lambda folder: (edit(folder, 'type="revolute"', 'type="fixed"'), edit(folder, '"continuous"', '"fixed"'))[0],
        "has no movable part",
    ),
    "movable parts without meshes": (
        _written(
            "mobility.urdf",
            b'<robot><link name="a"/><link name="b"/><joint name="j" type="continuous">'
            b'<parent link="a"/><child link="b"/></joint></robot>',
        ),
        "has no movable part",
    ),
    "many links": (_many_links, "at most 500"),
    "many shapes": (_many_shapes, "more than 5000 shapes"),
    "many copies of a large mesh": (_many_copies(1), "more than 5000000 vertices"),
    "many copies of a large mesh at one place": (_many_copies(0), "more than 5000000 vertices"),
    "many triangles at one place": (_written(CUBE, b"v 0 0 0\nv 1 0 0\nv 0 1 1\n" + b"f 1 2 3\n" * 40_000), "overlap"),
    "malformed JSON": (_written("meta.json", b"{"), "malformed JSON"),
    "JSON with a giant number": (_written("meta.json", b"9" * 10_000), "malformed JSON"),
    "JSON nested deeply": (_deep_json, "recursion limit exceeded at line 1 column"),
    "JSON with a trailing comma": (
        _written("meta.json", b'{"model_cat":\n "Box",}'),
        "trailing comma at line 2 column 8",
    ),
    "JSON in UTF-16": (
        _written("meta.json", '{"model_cat": "Box"}'.encode("utf-16")),
        "not UTF-8 text at line 1 column 1;",
    ),
    "JSON in UTF-16 without a mark": (
        _written("meta.json", '{"model_cat": "Box"}'.encode("utf-16-le")),
        "not UTF-8 text at line 1 column 2;",
    ),
    "JSON in Latin-1": (_written("meta.json", b'{\n"model_cat": "B\xfcro"}'), "not UTF-8 text at line 2 column 16;"),
    "mesh that is a pointer of Git LFS": (_written(CUBE, LFS_POINTER), "(`git lfs pull`)"),
    "URDF that is a pointer of Git LFS": (_written("mobility.urdf", LFS_POINTER), "(`git lfs pull`)"),
    "meta that is a pointer of git-annex": (_written("meta.json", ANNEX_POINTER), "(`git annex get`)"),
    "mesh that is a pointer of git-annex": (_written(CUBE, ANNEX_POINTER), "(`git annex get`)"),
    "mesh that is a link of git-annex as text": (_written(CUBE, ANNEX_LINK), "(`git annex get`)"),
    "mesh that is a link to contents that are absent": (_link_to_nothing, "(`git annex get`, `dvc pull`)"),
    "JSON that is no object": (_written("meta.json", b"[]"), "needs a 'model_cat'"),
    "no category": (_written("meta.json", b'{"model_cat": 3}'), "needs a 'model_cat'"),
    "semantics of two words": (_written("semantics.txt", b"link_0 hinge\n"), "line 1"),
    "binary semantics": (_written("semantics.txt", b"\xff\xfe"), "not UTF-8"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_cannot_be_used_is_refused_with_one_line(folder: Path, name: str) -> None:
    spoil, expected = HOSTILE[name]
    read_object(folder)
    spoil(folder)
    with pytest.raises(ObjectError) as refusal:
        read_object(folder)
    message = str(refusal.value)
    assert expected in message
    assert "\n" not in message
    assert len(message) < 500


@pytest.mark.parametrize("data", [None, b"", b"v 0 0 nan\nf 1 1 1\n", b"v 0 0 0\n", b"v 1 2 3\nf 1 1 1\n"])
def test_a_mesh_that_is_absent_or_unusable_is_left_out_and_noted(folder: Path, data: bytes | None) -> None:
    cube = (folder / CUBE).read_bytes()
    (folder / "textured_objs/door.obj").write_bytes(cube)
    edit(folder, '<visual><origin xyz="-1 0 0"/><geometry><mesh filename="textured_objs/cube.obj"/>', DOOR_MESH)
    whole = read_object(folder)
    assert whole.notes == ()
    (folder / CUBE).unlink() if data is None else (folder / CUBE).write_bytes(data)
    left = read_object(folder)
    assert left.bodies[0].visuals == ()
    assert len(left.bodies[0].collisions) == 1
    assert len(left.bodies[1].visuals) == 2
    assert left.notes[0].startswith("1 of 2 meshes left out: 'textured_objs/cube.obj' ")
    assert left.ref.content_hash != whole.ref.content_hash


@pytest.mark.parametrize(
    "name",
    [
        "package://door/textured_objs/cube.obj",
        "file:///home/me/my%20door/textured_objs/cube.obj",
        "/home/me/door/textured_objs/cube.obj",
        "C:\\door\\textured_objs\\cube.obj",
        "../textured_objs/cube.obj",
    ],
)
def test_a_path_of_elsewhere_is_found_by_its_end(folder: Path, name: str) -> None:
    edit(folder, '"textured_objs/cube.obj"/>', f'"{name}"/>')
    described = read_object(folder)
    assert len(described.bodies[1].visuals) == 2
    assert "found by the ends of their paths" in described.notes[0]


def test_an_urdf_that_is_derived_is_read_where_the_first_is_missing(folder: Path) -> None:
    (folder / "mobility.urdf").rename(folder / "mobility_cvx.urdf")
    assert read_object(folder).notes == ("read from mobility_cvx.urdf",)


def test_joints_that_mimic_or_cannot_move_are_noted(folder: Path) -> None:
    edit(folder, '<limit lower="0" upper="1.5"/>', '<limit lower="0" upper="1.5"/><mimic joint="lost"/>')
    edit(folder, 'type="continuous">', 'type="revolute"><limit lower="1" upper="1"/>')
    still, mimic = read_object(folder).notes
    assert still == "1 of 2 joints cannot move, since both limits are the same ('turn')"
    assert mimic == "<mimic> is not followed: what has it moves on its own ('hinge' of 'lost')"


def test_links_that_are_seen_and_do_not_collide_are_noted(folder: Path) -> None:
    welded = '<joint name="weld2" type="fixed"><parent link="body"/><child link="trim"/></joint>'
    trim = '<link name="trim"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>'
    edit(folder, "</robot>", f"{trim}{welded}</robot>")
    described = read_object(folder)
    assert [len(body.visuals) for body in described.bodies] == [2, 2, 1]
    assert [len(body.collisions) for body in described.bodies] == [1, 2, 1]
    (note,) = described.notes
    assert note.startswith("1 of 6 links are seen and do not collide")
    assert note.endswith("('trim')")


def test_semantics_of_links_that_are_not_there_are_noted(folder: Path) -> None:
    edit(folder, "lock hinge knob", "link_0 hinge knob", "semantics.txt")
    described = read_object(folder)
    assert described.bodies[2].part_name == ""
    assert described.notes == ("semantics.txt names links that are not there ('link_0')",)


def test_a_door_that_may_be_closed_at_its_upper_limit_is_noted(folder: Path) -> None:
    edit(folder, 'lower="0" upper="1.5"', 'lower="-1.5" upper="0"')
    (note,) = read_object(folder).notes
    assert note.startswith("1 of 2 joints have limits that end at 0")
    assert note.endswith("('hinge')")


def test_a_link_that_leads_to_itself_is_called_so(folder: Path) -> None:
    (folder / CUBE).unlink()
    (folder / CUBE).symlink_to("cube.obj")
    with pytest.raises(ObjectError, match="Too many levels of symbolic links"):
        read_object(folder)


def test_limits_that_are_nearly_the_same_are_called_so(folder: Path) -> None:
    edit(folder, 'type="continuous">', 'type="revolute"><limit lower="0" upper="1e-9"/>')
    assert read_object(folder).notes == ("1 of 2 joints cannot move, since both limits are nearly the same ('turn')",)


def test_a_joint_of_two_infinite_limits_is_continuous(folder: Path) -> None:
    continuous = read_object(folder).parts[1].joint
    edit(folder, 'type="continuous">', 'type="revolute"><limit lower="-inf" upper="inf"/>')
    joint = read_object(folder).parts[1].joint
    assert continuous is not None
    assert joint is not None
    assert (joint.lower, joint.upper) == (continuous.lower, continuous.upper)


@pytest.mark.parametrize(
    "declared", ['xmlns:xacro="http://www.ros.org/wiki/xacro"', 'xmlns:xacro="http://ros.org/xacro"', ""]
)
@pytest.mark.parametrize("inner", ["<xacro:door/>", '<link name="x"><xacro:if value="1"/></link>'])
def test_xacro_is_refused_unless_it_is_only_declared(folder: Path, declared: str, inner: str) -> None:
    edit(folder, "<robot ", f"<robot {declared} ")
    assert read_object(folder).notes == ()
    edit(folder, "</robot>", f"{inner}</robot>")
    with pytest.raises(ObjectError, match="run xacro first"):
        read_object(folder)


def test_byte_order_marks_and_line_ends_of_other_systems_change_nothing(folder: Path) -> None:
    plain = read_object(folder)
    for name in ("mobility.urdf", "meta.json", "semantics.txt", CUBE):
        text = (folder / name).read_bytes().replace(b"\n", b" \r\n")
        (folder / name).write_bytes(b"\xef\xbb\xbf" + text)
    marked = read_object(folder)
    assert [body.part_name for body in marked.bodies] == [body.part_name for body in plain.bodies]
    assert marked.notes == ()
    for ours, theirs in zip(marked.bodies, plain.bodies, strict=True):
        assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(ours.visuals, theirs.visuals, strict=True))


def test_stl_of_both_kinds_is_read() -> None:
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    lines = "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
    ascii_mesh = meshes.parse_mesh(f"solid x\nfacet normal 0 0 1\nouter loop\n{lines}".encode(), "a.STL")
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    rows = np.zeros(2, record)
    rows["corners"] = np.reshape(corners, (2, 9))
    binary = b"solid, though binary".ljust(80) + (2).to_bytes(4, "little") + rows.tobytes()
    binary_mesh = meshes.parse_mesh(binary, "b.stl")
    for mesh in (ascii_mesh, binary_mesh):
        assert len(mesh.vertices) == 4
        assert np.array_equal(mesh.vertices[mesh.faces].reshape(-1, 3), corners)
    for cut in (binary[:-1], b"", b"solid\nvertex 1 2\n", b"solid\nvertex 1 2 3\n", b"solid\nvertex 1 2 nan\n"):
        with pytest.raises(ObjectError):
            meshes.parse_mesh(cut, "c.stl")


def test_an_obj_of_several_blocks_is_read_like_one_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    lines = [f"v {' '.join(map(repr, rng.normal(size=3).tolist()))}" for _ in range(50)]
    lines += [f" f -{k} -{k + 1}  -{k + 2} {k}" for k in range(1, 40)] + ["v 1 2 3 1"]
    data = "\r\n".join(lines).encode()
    whole = meshes.parse_obj(data, "whole")
    expected = [[float(word) for word in line.split()[1:4]] for line in lines if line.startswith("v")]
    assert whole.vertices.tolist() == expected
    monkeypatch.setattr(meshes, "_BLOCK_BYTES", 64)
    blocks = meshes.parse_obj(data, "blocks")
    assert np.array_equal(blocks.vertices, whole.vertices)
    assert np.array_equal(blocks.faces, whole.faces)


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ObjectError, match="no such folder"):
        read_object(tmp_path / "nothing")


def test_an_id_that_cannot_be_stored_is_refused(folder: Path) -> None:
    with pytest.raises(ObjectError, match="the folder's name is the object's id"):
        read_object(folder.rename(folder.parent / "no good"))


def test_a_file_that_is_linked_within_the_folder_is_read(folder: Path) -> None:
    (folder / "link.obj").symlink_to("textured_objs/cube.obj")
    assert ObjectFiles(folder).read("link.obj", 10_000) == CUBE_OBJ.encode()


def test_obj_forms_of_indices_agree() -> None:
    vertices = "v 0 0 0\nv 1 0 0 1.0\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0\n"
    plain = meshes.parse_obj((vertices + "f 1 2 3 4\n").encode(), "plain")
    assert plain.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    for face in ("f 1/1 2/1 3/1 4/1", "f 1//1 2//1 3//1 4//1", "f 1/1/1 2/1/1 3/1/1 4/1/1", "f -4 -3 -2 -1"):
        again = meshes.parse_obj((vertices + face).encode(), face)
        assert np.array_equal(again.faces, plain.faces)
        assert np.array_equal(again.vertices, plain.vertices)


def test_negative_obj_indices_count_from_their_own_line() -> None:
    mesh = meshes.parse_obj(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\r\n\tf -4 -3 -1\r\n", "groups")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3]]


@given(corners=st.lists(st.integers(3, 9), min_size=1, max_size=8))
@settings(max_examples=30)
def test_fans_cover_polygons_of_any_size(corners: list[int]) -> None:
    vertices = "".join(f"v {i} {i * i} 0\n" for i in range(max(corners)))
    faces = "".join("f " + " ".join(str(i + 1) for i in range(n)) + "\n" for n in corners)
    mesh = meshes.parse_obj((vertices + faces).encode(), "fans")
    expected = [[0, i + 1, i + 2] for n in corners for i in range(n - 2)]
    assert mesh.faces.tolist() == expected


@given(data=st.binary(max_size=200))
@settings(max_examples=100)
def test_no_bytes_make_the_parsers_fail_otherwise(data: bytes) -> None:
    for parse in (meshes.parse_obj, urdf.parse_urdf):
        with pytest.raises(ObjectError):
            parse(data, "noise")


@pytest.mark.parametrize("mesh", [meshes.box(np.ones(3)), meshes.frustum(0.5, 0.3, 1.0), meshes.sphere(0.5)])
def test_primitive_shapes_are_closed_and_face_outward(mesh: meshes.Mesh) -> None:
    assert signed_volume(mesh) > 0.2
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    assert sorted(map(tuple, edges)) == sorted((b, a) for a, b in edges)


def test_a_mirroring_scale_keeps_normals_outward() -> None:
    mirrored = meshes.placed(meshes.box(np.ones(3)), np.eye(4), np.array([-1.0, 2.0, 1.0]))
    assert np.isclose(signed_volume(mirrored), 2.0)


def signed_volume(mesh: meshes.Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def translation(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def urdf_rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Written apart from the reader: three rotations about fixed axes."""

    def about(axis: int, angle: float) -> np.ndarray:
        turn, (i, j) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        return turn

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)
