"""Exporting objects: other programs find the joints, the masses and the very convex pieces that are simulated."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cluster.cli.main import run
from collector.objects import procedural
from collector.objects.articulation import ArticulatedObject, Mesh
from collector.objects.exporting import MAIN_FILES, Format, export_object, inertial, simulated
from collector.objects.meshes import box, placed
from collector.objects.model import MovablePart
from collector.objects.readers import read_object
from collector.sim.engine import convex_shapes, new_scene, sapien
from collector.sim.scene import Scene
from shared.config import Fidelity
from shared.primitives import PRIMITIVES
from shared.types import HiddenDynamics
from tests.support.environments import environment, install

READERS = Path(__file__).parents[1] / "support" / "foreign_readers.py"
PACKAGES = ("mujoco", "yourdfpy")
MASS = 0.2


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedObject:
    """A cabinet with doors and drawers."""
    (folder,) = procedural.generate(tmp_path_factory.mktemp("made"), {"StorageFurniture": 1}, seed=3)
    return read_object(folder)


def exported(target: ArticulatedObject, format: Format, out: Path) -> Path:
    return export_object(target, format, out / target.ref.id, MASS)


def scene_of(target: ArticulatedObject) -> Scene:
    return Scene(target, HiddenDynamics(part_mass=MASS), Fidelity(), PRIMITIVES.get("push"))


def hulls_of(target: ArticulatedObject) -> list[list[np.ndarray]]:
    """The vertices of the pieces that each part is simulated with, in the object's frame, all joints at 0."""
    poses = target.body_poses(np.zeros(len(target.parts)))[1:]
    return [
        [piece.vertices @ pose[:3, :3].T + pose[:3, 3] for piece in convex_shapes(link)]
        for link, pose in zip(scene_of(target).links, poses, strict=True)
    ]


def assert_same_points(found: np.ndarray, wanted: np.ndarray) -> None:
    """Equal as sets, whatever their order, up to rounding in single precision."""
    distances = np.linalg.norm(found[:, None] - wanted[None], axis=2)
    assert distances.min(axis=1).max() < 1e-5
    assert distances.min(axis=0).max() < 1e-5


def test_an_exported_urdf_is_read_as_the_same_object(target: ArticulatedObject, tmp_path: Path) -> None:
    again = read_object(exported(target, "urdf", tmp_path).parent)
    assert np.array_equal(again.limits(), target.limits())
    assert [body.part_name for body in again.bodies] == [body.part_name for body in target.bodies]
    for ours, theirs in zip(hulls_of(target), hulls_of(again), strict=True):
        assert len(ours) == len(theirs)
        for first, second in zip(ours, theirs, strict=True):
            assert_same_points(first, second)


def test_sapien_loads_an_exported_urdf_with_the_same_joints_pieces_and_inertia(
    target: ArticulatedObject, tmp_path: Path
) -> None:
    main = exported(target, "urdf", tmp_path)
    document = ElementTree.parse(main)  # noqa: S314 - our own.
    for link in document.iter("link"):
        # Without a renderer, SAPIEN cannot load what is only seen.
        for visual in link.findall("visual"):
            link.remove(visual)
    document.write(main)
    scene, _ = new_scene(10)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    loaded = loader.load(str(main))
    # Links are where they belong only after their joints were put somewhere.
    loaded.set_root_pose(sapien.Pose())
    loaded.set_qpos(np.zeros(len(target.parts), dtype=np.float32))
    joints = {joint.name: joint for joint in loaded.joints}
    ours = scene_of(target)
    for k, body in enumerate(target.parts):
        joint = joints[f"joint_{k}"]
        assert body.joint is not None
        assert joint.type.removesuffix("_unwrapped") == body.joint.kind
        assert np.allclose(joint.limit[0], [body.joint.lower, body.joint.upper])
        link = joint.child_link
        assert np.isclose(link.mass, MASS)
        assert np.allclose(np.sort(link.inertia), np.sort(ours.links[k].inertia), rtol=1e-2, atol=2e-8)
        world = link.entity_pose.to_transformation_matrix()
        axis = joint.pose_in_child.to_transformation_matrix()[:3, 0] @ world[:3, :3].T
        expected = target.body_poses(np.zeros(len(target.parts)))[k + 1][:3, :3] @ body.joint.axis
        assert np.allclose(axis, expected, atol=1e-6)
        pieces = [
            shape.vertices @ (world @ shape.local_pose.to_transformation_matrix())[:3, :3].T
            + (world @ shape.local_pose.to_transformation_matrix())[:3, 3]
            for shape in link.collision_shapes
        ]
        for found, wanted in zip(pieces, hulls_of(target)[k], strict=True):
            assert_same_points(found, wanted)
    assert isinstance(scene, sapien.Scene)


def test_mass_centre_and_moments_are_those_of_a_box() -> None:
    edges = np.array([0.2, 0.3, 0.4])
    moved = np.eye(4)
    moved[:3, 3] = [1.0, 2.0, 3.0]
    part = MovablePart("lid", "revolute", (placed(box(edges), moved),), (1.0, 2.0, 0.0), (0.0, 0.0, 1.0), 1.0)
    found = inertial(part, 2.0)
    assert np.allclose(found.centre, [0.0, 0.0, 3.0])
    squares = edges**2
    assert np.allclose(found.moments, np.diag(2.0 / 12 * (squares.sum() - squares)), atol=1e-7)


def test_a_part_without_volume_has_a_mass_all_the_same() -> None:
    sheet = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], dtype=np.int32))
    found = inertial(MovablePart("lid", "revolute", (sheet,), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0), 2.0)
    assert (np.diag(found.moments) > 0).all()


def test_the_command_exports_every_usable_object(
    target: ArticulatedObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "made"
    procedural.generate(made, {"Faucet": 1, "Box": 1}, seed=1)
    for name in ("urdf", "mjcf"):
        assert run(["objects", "export", str(made), "--format", name, "--out", str(tmp_path / name)]) == 0
    assert "2 exported, 0 refused" in capsys.readouterr().out
    for each in made.iterdir():
        assert (tmp_path / "urdf" / each.name / "mobility.urdf").is_file()
        assert (tmp_path / "mjcf" / each.name / "object.xml").is_file()
    # A folder that holds something else is left alone.
    (tmp_path / "urdf" / "faucet-0000" / "mobility.urdf").write_text("")
    assert run(["objects", "export", str(made), "--out", str(tmp_path / "urdf")]) == 2
    assert "holds another object" in capsys.readouterr().err


@pytest.fixture(scope="module")
def foreign_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python that has the other programs: this one, or that of another environment."""
    if all(find_spec(name) for name in PACKAGES):
        return Path(sys.executable)
    python = environment(tmp_path_factory.mktemp("environment"))
    install(python, *PACKAGES)
    return python


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_mujoco_and_yourdfpy_find_the_same_joints_and_pieces(
    target: ArticulatedObject, tmp_path: Path, foreign_python: Path
) -> None:
    files = [exported(target, name, tmp_path / name) for name in MAIN_FILES]
    done = subprocess.run([foreign_python, str(READERS), *map(str, files)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    poses = target.body_poses(np.zeros(len(target.parts)))
    for said in map(json.loads, done.stdout.splitlines()):
        assert len(said["joints"]) == len(target.parts)
        for k, body in enumerate(target.parts):
            found = said["joints"][f"joint_{k}"]
            assert body.joint is not None
            assert found["kind"] == body.joint.kind
            assert np.allclose(found["limits"], [body.joint.lower, body.joint.upper], atol=1e-9)
            assert np.allclose(found["axis"], poses[k + 1][:3, :3] @ body.joint.axis, atol=1e-6)
            assert np.allclose(found["anchor"], poses[k + 1][:3, 3], atol=1e-6)
            assert np.isclose(found["mass"], MASS)
            hulls = hulls_of(target)[k]
            assert len(found["hulls"]) == len(hulls)
            for theirs, ours in zip(found["hulls"], hulls, strict=True):
                assert_same_points(np.array(theirs), ours)


def test_what_is_simulated_is_what_is_exported(target: ArticulatedObject) -> None:
    model = simulated(target)
    assert [len(part.collisions or ()) for part in model.parts] == [len(body.collisions) for body in target.parts]
