"""The procedural generator: conventions of PartNet-Mobility, determinism, and facts that are truly hidden."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from collector.objects import procedural
from collector.objects.articulation import ArticulatedObject, Mesh
from collector.objects.catalogue import qualifying_parts, scan
from collector.objects.model import ObjectModel
from collector.objects.procedural.cabinets import storage_furniture
from collector.objects.procedural.shapes import GRID, normalised
from collector.objects.readers import read_object
from collector.objects.writing import object_files, write_object
from shared.errors import UsageError
from shared.tasks import TASKS
from tests.support.synced import Synced

EACH = 6
IDS = [f"{category.lower()}-{index:04d}" for category in procedural.EVERY_CATEGORY for index in range(EACH)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made")
    folders = procedural.generate(out, dict.fromkeys(procedural.EVERY_CATEGORY, EACH), seed=0)
    assert [folder.name for folder in folders] == IDS
    return out


@pytest.fixture(scope="module")
def objects(made: Path) -> dict[str, ArticulatedObject]:
    return {object_id: read_object(made / object_id) for object_id in IDS}


def world(described: ArticulatedObject, positions: np.ndarray) -> list[list[Mesh]]:
    """Visual meshes of each body where the joints put them."""
    return [
        [Mesh(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces) for mesh in body.visuals]
        for body, pose in zip(described.bodies, described.body_poses(positions), strict=True)
    ]


def triangle_set(bodies: list[list[Mesh]]) -> set[bytes]:
    """Triangles as bytes, whatever their order; corners keep theirs."""
    return {corners.tobytes() for meshes in bodies for mesh in meshes for corners in mesh.vertices[mesh.faces] + 0.0}


def vertices_of(meshes: list[Mesh]) -> np.ndarray:
    return np.concatenate([mesh.vertices for mesh in meshes])


@pytest.mark.parametrize("object_id", IDS)
def test_conventions(objects: dict[str, ArticulatedObject], object_id: str) -> None:
    described = objects[object_id]
    assert described.ref.category in procedural.EVERY_CATEGORY
    assert (described.limits()[:, 0] == 0).all()
    assert (described.limits()[:, 1] > 1e-3).all()
    bodies = world(described, np.zeros(len(described.parts)))
    vertices = np.concatenate([vertices_of(meshes) for meshes in bodies])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert np.allclose(low + high, 0, atol=4 * GRID)
    assert np.isclose(np.linalg.norm(high - low), 2.0, atol=8 * GRID)
    assert np.array_equal(vertices, np.round(vertices / GRID) * GRID)


@pytest.mark.parametrize("object_id", IDS)
def test_pieces_are_convex_closed_and_face_outward(objects: dict[str, ArticulatedObject], object_id: str) -> None:
    for body in objects[object_id].bodies:
        assert body.collisions == body.visuals
        for mesh in body.collisions:
            corners = mesh.vertices[mesh.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            heights = np.einsum("fi,fvi->fv", normals, mesh.vertices[None] - corners[:, :1])
            # Vertices lie on the grid, so that sides with four corners are plane up to its pitch.
            assert heights.max() < 40 * GRID


@pytest.mark.parametrize("object_id", IDS)
def test_each_part_moves_alone_and_opens_outward(objects: dict[str, ArticulatedObject], object_id: str) -> None:
    described = objects[object_id]
    closed = world(described, np.zeros(len(described.parts)))
    for k, body in enumerate(described.parts, start=1):
        positions = np.zeros(len(described.parts))
        positions[k - 1] = 0.5 * described.limits()[k - 1, 1]
        opened = world(described, positions)
        hanging = {k} | {i for i, b in enumerate(described.bodies) if b.joint and b.joint.parent == k}
        moved = {
            i
            for i, (before, after) in enumerate(zip(closed, opened, strict=True))
            if not np.allclose(vertices_of(before), vertices_of(after), atol=1e-12)
        }
        assert moved == hanging
        shift = vertices_of(opened[k]).mean(axis=0) - vertices_of(closed[k]).mean(axis=0)
        if "door" in body.part_name or body.part_name == "drawer":
            assert shift[0] < -0.02, "doors and drawers open towards the front"
        if described.ref.category == "HandleCabinet" and body.part_name == "handle":
            assert shift[0] < -0.01, "bars of a latch come out"
        elif "lid" in body.part_name or body.part_name == "handle":
            assert shift[2] > 0.02, "lids and handles rise"
        if body.part_name in ("button", "lever"):
            assert shift[0] > 0, "buttons and paddles go in"


@pytest.mark.parametrize("object_id", [i for i in IDS if i.split("-")[0] not in {"switch", "faucet", "swanfaucet"}])
def test_parts_clear_the_body_and_each_other(objects: dict[str, ArticulatedObject], object_id: str) -> None:
    """Samples of one body's surface are never deep inside a convex piece of another, closed or half open."""
    described = objects[object_id]
    for openness in (0.0, 0.5):
        bodies = world(described, openness * described.limits()[:, 1])
        related = {(b.joint.parent, i) for i, b in enumerate(described.bodies) if b.joint and b.joint.parent > 0}
        for (i, first), (j, second) in combinations(enumerate(bodies), 2):
            if (i, j) in related or described.bodies[j].part_name == "button":
                continue  # It goes into what carries it: in physics, neighbours in the tree pass through each other.
            for inner, outer in ((first, second), (second, first)):
                samples = np.concatenate([mesh.vertices[mesh.faces].mean(axis=1) for mesh in inner])
                assert max(depth_inside(samples, mesh) for mesh in outer) < 0.012, (object_id, openness, i, j)


def depth_inside(points: np.ndarray, mesh: Mesh) -> float:
    """How deep the deepest of the points lies in a convex mesh; negative outside."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float((-(points @ normals.T) + (corners[:, 0] * normals).sum(axis=1)).min(axis=1).max())


def test_twins_look_the_same_to_the_last_bit_and_turn_about_opposite_sides(tmp_path: Path) -> None:
    left, right = (
        read_object(write_object(tmp_path / side, normalised(storage_furniture(side)))) for side in ("left", "right")
    )
    closed = np.zeros(1)
    assert triangle_set(world(left, closed)) == triangle_set(world(right, closed))
    opened = [triangle_set(world(twin, np.array([0.5]))) for twin in (left, right)]
    assert opened[0] != opened[1]
    left_joint, right_joint = left.parts[0].joint, right.parts[0].joint
    assert left_joint is not None
    assert right_joint is not None
    assert np.array_equal(left_joint.axis, -right_joint.axis)
    mirror = np.array([1.0, -1.0, 1.0])
    origins = [twin.body_poses(closed)[1][:3, 3] for twin in (left, right)]
    assert np.array_equal(origins[0], mirror * origins[1])
    assert origins[0][1] > 0.3
    assert left_joint.upper == right_joint.upper


def test_the_hidden_door_has_an_edge_to_pinch(tmp_path: Path) -> None:
    twin = read_object(write_object(tmp_path / "left", normalised(storage_furniture("left", overhang=0.03))))
    body, door = world(twin, np.zeros(1))
    for axis in (1, 2):
        for sign in (-1, 1):
            stands_proud = (sign * vertices_of(door)[:, axis]).max() - (sign * vertices_of(body)[:, axis]).max()
            assert 0.02 < stands_proud < 0.04


def test_both_hinge_sides_and_both_senses_occur(tmp_path: Path) -> None:
    def axis_signs(category: str, parts: str) -> set[float]:
        assemblies = [procedural.build(category, 1, index) for index in range(40)]
        return {sum(part.axis) for assembly in assemblies for part in assembly.parts if part.name == parts}

    assert axis_signs("StorageFurniture", "rotation_door") == {-1.0, 1.0}
    assert axis_signs("Faucet", "switch") == {-1.0, 1.0}


def test_the_sense_of_a_switch_leaves_no_trace_in_its_shape() -> None:
    """Among faucets, the shape's own asymmetry does not correlate with the axis: the two are drawn apart."""
    faucets = [procedural.build("Faucet", 2, index) for index in range(60)]
    switches = [part for faucet in faucets for part in faucet.parts if part.name == "switch"]
    lean = [np.sign(np.mean([p.vertices[:, 1].mean() for p in part.pieces]) - part.origin[1]) for part in switches]
    signs = [sum(part.axis) for part in switches]
    assert abs(np.corrcoef(np.array(lean) + 1e-9 * np.arange(len(lean)), signs)[0, 1]) < 0.4


def test_objects_depend_on_seed_category_and_index_alone(made: Path, tmp_path: Path) -> None:
    few = procedural.generate(tmp_path, {"Safe": 2, "Box": 1}, seed=0)
    for folder in few:
        assert read_object(folder).ref == read_object(made / folder.name).ref
    other = object_files(procedural.build("Safe", 1, 0))
    assert other != object_files(procedural.build("Safe", 0, 0))
    assert object_files(procedural.build("Safe", 0, 1)) != object_files(procedural.build("Safe", 0, 0))


def test_the_same_command_again_changes_nothing(tmp_path: Path) -> None:
    def state() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("*"))}

    procedural.generate(tmp_path, {"Box": 2}, seed=0)
    before = state()
    procedural.generate(tmp_path, {"Box": 2}, seed=0)
    assert state() == before
    procedural.generate(tmp_path, {"Box": 3}, seed=0)
    assert before.items() <= {**state(), tmp_path: 0}.items()


def test_an_object_that_has_its_name_survives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced = Synced(monkeypatch)
    (folder,) = procedural.generate(tmp_path, {"Box": 1}, seed=0)
    assert synced.lacks(folder) == []


def test_another_object_is_never_overwritten(tmp_path: Path) -> None:
    (folder,) = procedural.generate(tmp_path, {"Box": 1}, seed=0)
    before = read_object(folder).ref
    with pytest.raises(UsageError, match="holds another object"):
        procedural.generate(tmp_path, {"Box": 1}, seed=1)
    assert read_object(folder).ref == before
    assert [path.name for path in tmp_path.iterdir()] == ["box-0000"]


@pytest.mark.parametrize(("counts", "seed"), [({"Spoon": 1}, 0), ({"Box": -1}, 0), ({"Box": 1}, -1)])
def test_bad_requests_are_refused(tmp_path: Path, counts: dict[str, int], seed: int) -> None:
    with pytest.raises(UsageError, match=r"allowed|must not be negative"):
        procedural.generate(tmp_path, counts, seed)


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UsageError, match="cannot be written"):
        procedural.generate(tmp_path / "file", {"Box": 1}, 0)


def test_the_ambiguous_tasks_find_their_parts(made: Path) -> None:
    catalogue = scan(made)
    assert catalogue.refused == ()
    counts = {task.name: sum(bool(qualifying_parts(e, task)) for e in catalogue.usable) for task in TASKS}
    assert counts["push"] == counts["pull"] == len(IDS)
    assert counts["push-faucet"] == EACH
    assert counts["pull-closed-door"] >= EACH // 2


def test_normalising_keeps_the_shape() -> None:
    before: ObjectModel = storage_furniture("left")
    after = normalised(before)
    sizes = [[np.ptp(piece.vertices, axis=0) for piece in a.body] for a in (before, after)]
    ratios = np.array(sizes[1]) / np.array(sizes[0])
    assert np.allclose(ratios, ratios.mean(), rtol=0.01)
