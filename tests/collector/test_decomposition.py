"""Cavities: what is hollow becomes so for the hand, what is convex stays as it was, and a cache cannot be poisoned."""

import dataclasses
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from collector.objects import decomposition, meshes
from collector.objects.articulation import ArticulatedObject, Mesh
from collector.objects.catalogue import load_ref, scan
from collector.objects.child_process import decode, encode
from collector.objects.decomposition import Decomposer
from collector.objects.procedural import generate
from collector.sim.scene import Scene
from shared.config import FIDELITIES
from shared.errors import ObjectError, UsageError
from shared.geometry import gripper_rotation
from shared.io.private import cache_folder
from shared.primitives import PRIMITIVES
from shared.types import HiddenDynamics
from tests.support.single_door import drawer

EASY = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=1.0)
WALL = 0.05
RIM = 0.3


def open_box() -> Mesh:
    """One closed surface: a box of 0.6 x 0.6 x 0.6 about the origin, hollow but for its floor and walls."""
    outer = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (-0.3, RIM)])
    inner = np.array(
        [[x, y, z] for x in (WALL - 0.3, 0.3 - WALL) for y in (WALL - 0.3, 0.3 - WALL) for z in (WALL - 0.3, RIM)]
    )
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4]]
    inside = [[8 + k for k in side[::-1]] for side in sides]
    rim = [[1, 5, 13, 9], [5, 7, 15, 13], [7, 3, 11, 15], [3, 1, 9, 11]]
    quads = [*sides, *inside, *rim]
    faces = [[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)]
    return Mesh(np.concatenate([outer, inner]), np.array(faces, dtype=np.int32))


def hollow() -> ArticulatedObject:
    """An open box that stands still, and a drawer far from it, since an object has a part that moves."""
    closed = drawer()
    root = dataclasses.replace(closed.bodies[0], visuals=(open_box(),), collisions=(open_box(),))
    part = closed.bodies[1]
    assert part.joint is not None
    aside = part.joint.parent_from_body.copy()
    aside[:3, 3] = 3.0, 0.0, 0.0
    part = dataclasses.replace(part, joint=dataclasses.replace(part.joint, parent_from_body=aside))
    return dataclasses.replace(closed, bodies=(root, part))


def ell() -> Mesh:
    """A prism over an L: the simplest mesh that is not convex."""
    outline = np.array([[0.0, 0], [0.4, 0], [0.4, 0.1], [0.1, 0.1], [0.1, 0.4], [0, 0.4]])
    vertices = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.1)])
    caps = [[0, 3, 1], [1, 3, 2], [0, 5, 3], [3, 5, 4]]
    sides = [[k, (k + 1) % 6, (k + 1) % 6 + 6] for k in range(6)] + [[k, (k + 1) % 6 + 6, k + 6] for k in range(6)]
    return Mesh(vertices, np.array([*caps, *(np.array(caps)[:, ::-1] + 6), *sides], dtype=np.int32))


def presses(target: ArticulatedObject, x: float) -> bool:
    """Whether the hand presses on anything with its fingers well below the open box's rim."""
    scene = Scene(target, EASY, FIDELITIES["fast"], PRIMITIVES.get("push"))
    scene.put(np.zeros(1))
    down = gripper_rotation(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]))
    scene.gripper.place(down, np.array([x, 0.0, RIM]), opened=False)
    scene.system.step()
    contact = scene.contact()
    return contact.palm or bool(contact.finger_on)


@pytest.fixture
def decomposer(tmp_path: Path) -> Iterator[Decomposer]:
    with Decomposer(tmp_path / "cache") as made:
        yield made


def test_a_finger_fits_into_a_box_only_when_it_is_decomposed(decomposer: Decomposer) -> None:
    opened = decomposer.decomposed(hollow())
    assert len(opened.bodies[0].collisions) >= 5
    assert opened.bodies[0].visuals[0].vertices.shape == (16, 3)
    assert presses(hollow(), 0.0)
    assert not presses(opened, 0.0)
    # The walls are still there.
    assert presses(opened, 0.3 - WALL / 2)


def test_convex_and_flat_meshes_stay_as_they_are(decomposer: Decomposer) -> None:
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    for mesh in (meshes.box(np.ones(3)), meshes.frustum(0.3, 0.2, 0.5), meshes.sphere(0.4), flat):
        assert decomposer.pieces(mesh) == (mesh,)


def test_the_pieces_are_the_same_bits_from_any_process_and_from_the_cache(tmp_path: Path) -> None:
    found = []
    for cache in ("one", "other"):
        with Decomposer(tmp_path / cache) as decomposer:
            found.append(encode(decomposer.pieces(ell())))
    with Decomposer(tmp_path / "one") as again:
        found.append(encode(again.pieces(ell())))
        assert again._child._child is None
    assert found[0] == found[1] == found[2]
    assert len(decode(found[0])) >= 2


def test_a_damaged_or_forged_cache_entry_is_computed_again(
    decomposer: Decomposer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = decomposer.pieces(ell())
    sound = encode(pieces)
    computed = []
    monkeypatch.setattr(decomposer, "_computed", lambda mesh: computed.append(mesh) or pieces)
    (entry,) = (path for path in (tmp_path / "cache").rglob("*") if path.is_file())
    (tmp_path / "secret").write_bytes(sound)
    far, strange = Mesh(pieces[0].vertices + 5.0, pieces[0].faces), Mesh(np.full((4, 3), np.nan), pieces[0].faces[:0])
    wild = Mesh(pieces[0].vertices, pieces[0].faces + 1000)
    meshes_of = ([far, far], [pieces[0]] * 1000, [strange, strange], [wild, wild], [pieces[0]])
    assert encode(decomposer.pieces(ell())) == sound
    assert not computed
    for forged in (sound[:-1], b"", b"\x80\x04K\x01.", *map(encode, meshes_of), "link", "folder"):
        computed.clear()
        entry.unlink()
        if isinstance(forged, bytes):
            entry.write_bytes(forged)
        elif forged == "link":
            entry.symlink_to(tmp_path / "secret")
        else:
            entry.mkdir()
        assert encode(decomposer.pieces(ell())) == sound
        assert len(computed) == 1
        assert stat.S_ISREG(os.lstat(entry).st_mode)
        assert entry.read_bytes() == sound


def test_a_mesh_that_takes_too_long_is_refused_and_the_next_is_not(
    decomposer: Decomposer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decomposition, "LIMIT_S", 0.01)
    with pytest.raises(ObjectError, match=r"link 'base': a mesh of 28 triangles takes longer than 0\.01 s"):
        decomposer.decomposed(hollow())
    monkeypatch.undo()
    assert len(decomposer.pieces(ell())) > 1
    giant = Mesh(ell().vertices, np.tile(ell().faces, (12_000, 1)))
    with pytest.raises(ObjectError, match="240000 triangles; at most"):
        decomposer.pieces(giant)


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with Decomposer(tmp_path / "file") as decomposer, pytest.raises(UsageError, match="set XDG_CACHE_HOME"):
        decomposer.pieces(meshes.box(np.ones(3)))


def test_the_cache_is_where_the_user_keeps_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("pieces") == tmp_path / "adaafford/pieces"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder("pieces") == tmp_path / ".cache/adaafford/pieces"
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cache_folder("pieces") == tmp_path / ".cache/adaafford/pieces"


@pytest.mark.parametrize("home", ["a file", "unset", "empty", "relative"])
def test_without_a_home_decompositions_are_kept_among_temporary_files_of_this_user_alone(
    home: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def nobody(user: int) -> NoReturn:
        raise KeyError(f"getpwuid(): uid not found: {user}")

    (tmp_path / "file").touch()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", {"a file": str(tmp_path / "file"), "relative": "home"}.get(home, ""))
    if home == "unset":
        monkeypatch.delenv("HOME")
        monkeypatch.setattr("pwd.getpwuid", nobody)
    with tempfile.TemporaryDirectory(prefix="", dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        assert cache_folder("pieces") == Path(folder) / f"adaafford-{os.geteuid()}" / "pieces"
        with Decomposer(cache_folder("pieces")) as decomposer:
            assert len(decomposer.pieces(ell())) > 1
        monkeypatch.delenv("TMPDIR")
        monkeypatch.setattr("shared.io.private._TEMPORARY", (str(tmp_path / "missing"),))
        with pytest.raises(UsageError, match=r"set TMPDIR to a folder .*, or XDG_CACHE_HOME to one for caches"):
            cache_folder("pieces")


def test_a_setting_decides_what_is_loaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    generate(tmp_path / "objects", {"Faucet": 1}, seed=1)
    (entry,) = scan(tmp_path / "objects").usable
    obj = next(entry.folder.rglob("*.obj"))
    mesh = ell()
    obj.write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in mesh.faces + 1)
    )
    (entry,) = scan(tmp_path / "objects").usable
    hulls = load_ref(tmp_path / "objects", entry.ref, "hulls")
    opened = load_ref(tmp_path / "objects", entry.ref, "decomposed")
    count = [sum(len(body.collisions) for body in target.bodies) for target in (hulls, opened)]
    assert count[1] > count[0]
    assert hulls.ref == opened.ref


@pytest.mark.slow
def test_generated_objects_are_made_of_convex_pieces(decomposer: Decomposer, tmp_path: Path) -> None:
    generate(tmp_path / "objects", {"Safe": 1, "TrashCan": 1, "KitchenPot": 1}, seed=1)
    calls: list[tuple[int, int]] = []
    for entry in scan(tmp_path / "objects").usable:
        target = load_ref(tmp_path / "objects", entry.ref)
        opened = decomposer.decomposed(target, lambda done, total: calls.append((done, total)))
        assert [body.collisions for body in opened.bodies] == [body.collisions for body in target.bodies]
        assert calls == [(k + 1, len(calls)) for k in range(len(calls))]
        calls.clear()
