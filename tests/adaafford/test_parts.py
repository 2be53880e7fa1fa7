"""The part of a raw scan: chosen in several ways, kept in the history, and followed where it moves."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaafford import parts
from adaafford.histories import TriedOutcome, read_history
from adaafford.parts import UNMOVED_M, CutOut, PartChoice, PartError, PartFinder, read_segmenter
from adaafford.scans import Scan, Vector, checked_scan
from adaafford.sessions import Session, SessionFiles, parts_file
from cluster.cli.main import run as adaafford
from shared.errors import StoreError, UsageError
from shared.policies.policy import CORE, WEIGHTS_FILE, Policy
from shared.segmentation.scenes import Kind
from shared.segmentation.segmenter import SEGMENTATION_FILE, Evidence, Part, Segmentation, Segmenter, begun, part_labels
from shared.tasks import Task, task_named
from shared.types import Float, OutcomeKind
from tests.support.small_networks import TINY

UP, CAMERA = (0.0, 0.0, 1.0), (0.0, 0.0, 1.0)
TOLD = TriedOutcome(motion=0.2)


class GivenSegmenter(Segmenter):
    """Finds what stands out of a floor at z = 0: doors are what is left and right of y = 0, nearer than x = 1."""

    def __init__(self) -> None:
        super().__init__(begun(0))

    def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
        thing = points[:, 2] > 0.01
        found = []
        for side, confidence in ((1.0, 0.9), (-1.0, 0.7)):
            mine = np.flatnonzero(thing & (points[:, 0] < 1.0) & (side * points[:, 1] > 0))
            if len(mine):
                found.append(Part(mine, {Kind.TURNING: confidence, Kind.SLIDING: 0.0}))
        found.append(Part(np.flatnonzero(thing)[:100], {Kind.TURNING: 0.09, Kind.SLIDING: 0.5}))
        return Segmentation(np.flatnonzero(thing), tuple(found))


@pytest.fixture(autouse=True)
def _given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "bundled_segmenter", GivenSegmenter)


def room(left: float = 0.9, right: float = 0.9) -> Float:
    """A floor, and on it a cabinet with two doors, at these distances."""
    rng = np.random.default_rng(1)
    floor = np.concatenate([rng.uniform(-3, 3, (3000, 2)), np.zeros((3000, 1))], axis=1)
    body = rng.uniform([1.01, -0.3, 0.02], [1.3, 0.3, 0.8], (2000, 3))
    doors = [rng.uniform([x, y, 0.1], [x + 0.02, y + 0.25, 0.7], (1500, 3)) for x, y in ((left, 0.02), (right, -0.27))]
    return np.concatenate([floor, body, *doors])


def write(path: Path, points: Float) -> Path:
    np.savez(path, points=points, camera=np.array(CAMERA))
    return path


PULL_LID = Task(name="pull-lid", primitive="pull", revolute_only=True)
"""As a file would define it."""


def session(folder: Path, part: str | None = "auto", task: str = "pull-closed-door") -> Session:
    files = SessionFiles(folder / "history.json", folder / "heatmap.npz")
    policy = Policy.untrained(task, TINY, 0).defined_as(PULL_LID if task == PULL_LID.name else None)
    for name in CORE:
        policy.with_trained(name)
    return Session(policy, files, part=part, points=256)


def test_a_choice_is_auto_a_number_or_a_click() -> None:
    assert PartChoice.of("auto") == PartChoice(1)
    assert PartChoice.of("3") == PartChoice(3)
    assert PartChoice.of("0.5,-1,2e-1") == PartChoice(1, (0.5, -1.0, 0.2))
    for wrong in ("", "0", "65", "-1", "best", "1,2", "1,2,3,4", "nan,0,0", "inf,0,0", "1e9,0,0"):
        with pytest.raises(UsageError, match="give auto, a number"):
            PartChoice.of(wrong)


@pytest.mark.parametrize(("task", "parts"), [(PULL_LID.name, 2), ("a task that nobody defines", 3)])
def test_what_slides_is_not_of_a_task_that_a_file_defines_for_turning_parts(
    task: str, parts: int, tmp_path: Path
) -> None:
    step = session(tmp_path, task=task).step(write(tmp_path / "scan-1.npz", room()))
    assert step.part is not None and 1 + len(step.part.alternatives) == parts


@pytest.mark.parametrize(("part", "side"), [("auto", 1), ("1", 1), ("2", -1), ("0.9,-0.1,0.4", -1)])
def test_the_part_that_is_asked_for_is_acted_on(part: str, side: int, tmp_path: Path) -> None:
    step = session(tmp_path, part).step(write(tmp_path / "scan-1.npz", room()))
    assert step.part is not None
    assert step.part.chosen.kind == "turning"
    assert side * step.part.chosen.centre[1] > 0 and side * step.point[1] > 0
    assert len(step.part.alternatives) == 1, "what slides is not of this task"
    assert read_history(tmp_path / "history.json").part == part
    shades = np.load(parts_file(tmp_path / "heatmap.npz"))
    chosen = shades["points"][shades["affordance"] == 1.0]
    assert len(chosen) and (side * chosen[:, 1] > 0).all()


def test_the_part_is_followed_where_it_moved_to(tmp_path: Path) -> None:
    first = write(tmp_path / "scan-1.npz", room())
    begun_session = session(tmp_path, "2")
    once = begun_session.step(first)
    assert begun_session.step(first).model_copy(update={"seconds": once.seconds}) == once
    assert session(tmp_path, None).step(first).model_copy(update={"seconds": once.seconds}) == once, "without --part"
    stray = np.tile([[-1.0, -0.1, 0.4]], (5, 1))
    second = write(tmp_path / "scan-2.npz", np.concatenate([room(right=0.7), stray]))
    later = session(tmp_path, "2").step(second, TOLD, 1)
    assert later.tries == 1 and later.part is not None
    assert later.part.chosen.centre[0] == pytest.approx(0.71, abs=0.02)
    again = session(tmp_path, None).step(second, TOLD, 1)
    assert again.model_copy(update={"seconds": later.seconds}) == later
    history = read_history(tmp_path / "history.json")
    assert [each.part is not None for each in history.interactions] == [True, True]


class ForgetfulSegmenter(GivenSegmenter):
    """Does not find the right door where a lamp is seen, which is above z = 2."""

    def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
        found = super().segment(points, camera, seed)
        return found if points[:, 2].max() < 2.0 else Segmentation(found.object, found.parts[:1])


def test_a_part_that_is_not_found_again_and_did_not_move_is_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "bundled_segmenter", ForgetfulSegmenter)
    lamp = [[1.2, 0.0, 2.5]]
    first, *later = (
        write(tmp_path / f"scan-{number}.npz", np.concatenate([room() + 0.002 * number, *([lamp] if number else [])]))
        for number in range(3)
    )
    session(tmp_path, "2").step(first)
    for tries, scan in enumerate(later, start=1):
        step = session(tmp_path, None).step(scan, TOLD, tries)
        assert step.tries == tries and step.part is not None
        assert step.part.chosen.centre[1] < 0 and step.point[1] < 0
        assert (step.part.chosen.number, step.part.chosen.confidence, step.part.chosen.points) == (2, 0.7, 1500)
        assert [part.number for part in step.part.alternatives] == [1]
    moved = write(tmp_path / "scan-3.npz", np.concatenate([room(right=0.7), lamp]))
    with pytest.raises(PartError, match="is not found again"):
        session(tmp_path, None).step(moved, TOLD, 3)
    history = read_history(tmp_path / "history.json")
    assert len(history.tried) == 2, "what is refused leaves the history as it was"


class RememberingSegmenter(GivenSegmenter):
    """Counts the scans that its evidence is of: its confidence in the left door is one over their number."""

    def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
        found = super().segment(points, camera, seed)
        evidence = Evidence(points, np.zeros((len(points), len(Kind))), points, np.ones(len(points)))
        evidence = evidence if earlier is None else evidence.averaged(earlier)
        confidence = {Kind.TURNING: 1 / float(np.median(evidence.scans)), Kind.SLIDING: 0.0}
        return Segmentation(found.object, (Part(found.parts[0].points, confidence), *found.parts[1:]), evidence)


def test_what_the_network_says_is_averaged_over_scans_between_which_nothing_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "bundled_segmenter", RememberingSegmenter)
    scans = [
        write(tmp_path / f"scan-{number}.npz", room(left) + 0.001 * number)
        for number, left in enumerate((0.9, 0.9, 0.9, 0.8, 0.8))
    ]
    whole, told = session(tmp_path, "0.9,0.1,0.4"), list[float]()
    for tries, scan in enumerate(scans):
        step = whole.step(scan, TOLD if tries else None, tries or None)
        again = whole.step(scan, TOLD if tries else None, tries or None)
        fresh = session(tmp_path, None).step(scan, TOLD if tries else None, tries or None)
        assert {one.model_copy(update={"seconds": 0}).model_dump_json() for one in (step, again, fresh)} == {
            step.model_copy(update={"seconds": 0}).model_dump_json()
        }, "a step that is repeated, also by another process"
        assert step.part is not None
        told.append(1 / step.part.chosen.confidence)
    assert np.allclose(told, [1, 2, 3, 1, 2], atol=0.01), "what moved is looked at anew"


def test_each_scan_counts_as_much_as_another_where_its_points_are_near() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(500, 3))
    mean: Evidence | None = None
    for number in range(3):
        one = Evidence(points, np.full((500, 4), float(number)), points + number, np.ones(500))
        mean = one if mean is None else one.averaged(mean)
    assert mean is not None
    assert np.allclose(mean.probabilities, 1.0) and np.allclose(mean.scans, 3.0)
    elsewhere = Evidence(points + 5.0, np.zeros((500, 4)), points, np.ones(500))
    alone = elsewhere.averaged(mean)
    for before, after in ((elsewhere.probabilities, alone.probabilities), (elsewhere.votes, alone.votes)):
        assert np.array_equal(before, after)
    assert np.array_equal(alone.scans, elsewhere.scans)


def test_around_points_that_were_pulled_in_vain_nothing_is_marked() -> None:
    scan, finder = Scan(room()), PartFinder(task_named("pull-closed-door"))

    def marked(*unmoved: Vector) -> Float:
        cut = finder.cut_out(scan, UP, CAMERA, "auto", None, "scan", unmoved=unmoved).scan
        assert cut.movable is not None
        return cut.points[cut.movable]

    whole, x, y, z = marked(), 0.91, 0.15, 0.4
    away = np.linalg.norm(whole - [x, y, z], axis=1)
    assert np.array_equal(marked((x, y, z)), whole[away > UNMOVED_M])
    everywhere = [(x, float(y), float(z)) for y in np.arange(0.02, 0.3, 0.04) for z in np.arange(0.1, 0.74, 0.04)]
    assert np.array_equal(marked(*everywhere), whole), "something has to be left"


@pytest.mark.parametrize(("policy", "kind", "elsewhere"), [
    ("pull-closed-door", OutcomeKind.OK, True),
    ("pull-closed-door", OutcomeKind.NO_CONTACT, False),
    ("push", OutcomeKind.OK, False),
    (PULL_LID.name, OutcomeKind.OK, True),
    ("a task that nobody defines", OutcomeKind.OK, False),
])  # fmt: skip
def test_a_pull_that_moves_nothing_is_not_made_again_there(
    policy: str, kind: OutcomeKind, elsewhere: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = list[Sequence[Vector]]()
    cut_out = PartFinder.cut_out

    def spied(finder: PartFinder, *args: Any) -> CutOut:
        told.append(args[-1])
        return cut_out(finder, *args)

    first = session(tmp_path, task=policy).step(write(tmp_path / "scan-1.npz", room()))
    monkeypatch.setattr(PartFinder, "cut_out", spied)
    again = session(tmp_path, task=policy).step(
        write(tmp_path / "scan-2.npz", room() + 0.001), TriedOutcome(motion=0.0, kind=kind), 1
    )
    assert told == [(), (first.point,) if elsewhere else ()]
    assert not elsewhere or np.linalg.norm(np.subtract(again.point, first.point)) > UNMOVED_M


def test_another_part_may_be_chosen_until_something_was_tried(tmp_path: Path) -> None:
    scan = write(tmp_path / "scan-1.npz", room())
    session(tmp_path, "auto").step(scan)
    other = session(tmp_path, "2").step(scan)
    assert other.part is not None and other.part.chosen.number == 2
    session(tmp_path, "2").step(scan, TOLD, 1)
    with pytest.raises(UsageError, match="begun with another part, 2"):
        session(tmp_path, "auto").step(scan)


def test_what_cannot_be_found_is_said_in_one_line(tmp_path: Path) -> None:
    scan = write(tmp_path / "scan-1.npz", room())
    for part, expected in (("3", "parts found, with confidence: 1 at"), ("5,5,5", "from the nearest part")):
        with pytest.raises(UsageError, match=expected):
            session(tmp_path, part).step(scan)
        assert not (tmp_path / "history.json").exists()
    session(tmp_path, "2").step(scan)
    gone = room()
    with pytest.raises(PartError, match="is not found again"):
        session(tmp_path, None).step(write(tmp_path / "scan-3.npz", room(right=1.5)), TOLD, 1)
    with pytest.raises(UsageError, match="no turning part"):
        session(tmp_path, None).step(write(tmp_path / "scan-4.npz", gone[gone[:, 0] > 1.0]), TOLD, 1)
    assert read_history(tmp_path / "history.json").tried == ()


def test_a_marked_scan_and_a_history_without_part_are_refused(tmp_path: Path) -> None:
    marked = checked_scan(room(), movable=np.ones(len(room())))
    with pytest.raises(UsageError, match="leave out --part"):
        PartFinder(task_named("push")).cut_out(marked, UP, CAMERA, "auto", None, "scan")
    object_alone = room()[3000:]
    session(tmp_path, None).step(write(tmp_path / "scan-1.npz", object_alone))
    with pytest.raises(UsageError, match="begun without a part"):
        session(tmp_path, "auto").step(tmp_path / "scan-1.npz")


def test_a_task_that_acts_on_all_parts_finds_what_slides() -> None:
    scan = Scan(room())
    cut = PartFinder(task_named("push")).cut_out(scan, UP, CAMERA, "3", None, "scan")
    assert cut.answer.chosen.kind == "sliding"
    assert cut.scan.movable is not None and cut.scan.movable.sum() == 100


class GridSegmenter(Segmenter):
    """Everything is of the object, and what is nearer than x = 1 is a door."""

    def __init__(self) -> None:
        pass

    def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
        door = Part(np.flatnonzero(points[:, 0] < 1.0), {Kind.TURNING: 0.9, Kind.SLIDING: 0.0})
        return Segmentation(np.arange(len(points)), (door,))


def test_points_that_float_between_surfaces_are_not_of_the_object() -> None:
    def plane(x: float) -> Float:
        y, z = np.meshgrid(np.arange(60) * 0.01, np.arange(60) * 0.01)
        return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)

    floating = np.array([[1.2, -0.03, 0.1], [0.95, 0.63, 0.3], [1.1, 0.62, 0.5]])
    scan = Scan(np.concatenate([plane(0.9), plane(1.4), floating]))
    cut = PartFinder(task_named("push"), GridSegmenter()).cut_out(scan, UP, CAMERA, "auto", None, "scan")
    assert np.array_equal(cut.scan.points, np.concatenate([plane(0.9), plane(1.4)]))
    assert cut.scan.rows is not None and np.array_equal(cut.scan.rows, np.arange(7200))
    assert len(cut.shades) == len(scan.points)
    # Where one of several views is much finer, the points of the others are no noise.
    uneven = Scan(np.concatenate([plane(0.9)[:1800], plane(1.4)[::7]]))
    whole = PartFinder(task_named("push"), GridSegmenter()).cut_out(uneven, UP, CAMERA, "auto", None, "scan")
    assert np.array_equal(whole.scan.points, uneven.points)


def test_the_confidence_is_that_a_part_moves_as_the_task_wants_it() -> None:
    thirds = np.split(np.arange(300), 3)
    told = (
        {Kind.TURNING: 0.3, Kind.SLIDING: 0.6},
        {Kind.TURNING: 0.2, Kind.SLIDING: 0.1},
        {Kind.TURNING: 0.05, Kind.SLIDING: 0.75},
    )

    class Told(Segmenter):
        def __init__(self) -> None:
            pass

        def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
            return Segmentation(np.arange(300), tuple(map(Part, thirds, told)))

    places = np.random.default_rng(0).uniform(0.5, 1, (300, 3))
    for task, expected in (("push", [0.9, 0.8, 0.3]), ("pull-closed-door", [0.3, 0.2])):
        answer = PartFinder(task_named(task), Told()).cut_out(Scan(places), UP, CAMERA, "auto", None, "scan").answer
        assert [part.confidence for part in (answer.chosen, *answer.alternatives)] == expected
    assert {part.kind for part in (answer.chosen, *answer.alternatives)} == {"turning"}


def test_the_command_says_which_part(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = write(tmp_path / "scan.npz", room())
    flags = ["--cloud", str(scan), "--history", str(tmp_path / "h.json"), "--policy", "pull-closed-door"]
    assert adaafford(["adapt", *flags, "--part", "auto"]) == 0
    assert json.loads(capsys.readouterr().out)["part"]["chosen"]["confidence"] == 0.9
    assert adaafford(["adapt", *flags, "--part", "none"]) == 2
    assert "give auto, a number" in capsys.readouterr().err


def test_a_command_that_goes_on_follows_the_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = write(tmp_path / "scan-1.npz", room())
    write(tmp_path / "scan-2.npz", room(right=0.7))
    write(tmp_path / "empty.npz", room(left=3.0, right=3.0))
    lines = (
        b'{"cloud": "scan-2.npz", "outcome": {"motion": 0.2}, "interaction": 1}\n',
        b'{"cloud": "empty.npz", "outcome": {"motion": 0.1}, "interaction": 2}\n',
        b'{"cloud": "scan-2.npz"}\n',
    )
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"".join(lines))))
    flags = ["--cloud", str(scan), "--history", str(tmp_path / "h.json"), "--policy", "pull-closed-door"]
    assert adaafford(["adapt", *flags, "--part", "2", "--follow"]) == 0
    first, second, lost, again = map(json.loads, capsys.readouterr().out.splitlines())
    assert [step["part"]["chosen"]["centre"][0] for step in (first, second)] == pytest.approx([0.91, 0.71], abs=0.02)
    assert all(step["part"]["chosen"]["centre"][1] < 0 and step["point"][1] < 0 for step in (first, second))
    assert list(lost) == ["error"] and "no turning part is found" in lost["error"]
    assert {**again, "seconds": 0} == {**second, "seconds": 0}, "the refused line left the history as it was"


def test_doors_side_by_side_come_apart_and_stray_votes_do_not_count() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([0, -0.8, 0], [0.02, 0.8, 1.0], (1200, 3)).astype(np.float32)
    kinds = np.full(1200, Kind.TURNING)
    middles = np.where(points[:, 1:2] > 0, [[0.01, 0.4, 0.5]], [[0.01, -0.4, 0.5]])
    votes = (middles + 0.03 * rng.standard_normal((1200, 3))).astype(np.float32)
    labels = part_labels(points, kinds, votes)
    assert set(labels) == {1, 2}
    assert len(set(labels[points[:, 1] > 0])) == len(set(labels[points[:, 1] < 0])) == 1
    far = np.concatenate([points, points[:20] + 5.0])
    assert (part_labels(far, np.full(1220, Kind.TURNING), np.concatenate([votes, far[1200:]]))[1200:] == -1).all()


def test_a_network_comes_back_and_damage_is_refused(tmp_path: Path) -> None:
    files = Segmenter(begun(1).eval()).to_files()
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    read_segmenter(tmp_path)
    (tmp_path / WEIGHTS_FILE).write_bytes(files[WEIGHTS_FILE][:-1])
    with pytest.raises(StoreError, match="SHA-256"):
        read_segmenter(tmp_path)
    (tmp_path / SEGMENTATION_FILE).write_bytes(b"{}")
    with pytest.raises(StoreError):
        read_segmenter(tmp_path)
