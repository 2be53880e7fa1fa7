"""Adapting to scans: frames come back, hostile files are refused, and files say what the loop in memory says."""

import io
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from adaafford.heatmaps import colours, write_heatmap
from adaafford.histories import MAX_TRIES, History, TriedOutcome, read_history, write_history
from adaafford.pretrained import PRETRAINED_FOLDER, load_policy, only_pretrained, pretrained_names
from adaafford.scans import ScanFrame, action_at, checked_scan, observation_of
from adaafford.sessions import Request, Session, SessionFiles, Step
from cluster.cli.commands.adapt import MAX_LINE_BYTES, lines_of
from cluster.cli.main import run as adaafford
from shared.errors import StoreError, UsageError
from shared.geometry import camera_pose, gripper_rotation, points_in_view
from shared.networks.network_config import NetworkConfig
from shared.policies.adaptation import Adapter, frames_in_view
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.types import Action, Float, OutcomeKind
from tests.support.fabricate import fabricate_observation
from tests.support.finished_run import make_finished_run
from tests.support.killed_writers import kill_while_writing

NETWORK = NetworkConfig(
    centres=(32, 8), radii=(0.3, 0.8), neighbours=4, abstraction=((8,), (16,)), propagation=((16,), (16,)),
    feature_width=16, latent_width=16,
)  # fmt: skip


def front(count: int = 3000, seed: int = 1) -> Float:
    """A cabinet's front, 0.9 m ahead of a camera at the origin, z up."""
    return np.random.default_rng(seed).uniform([0.9, -0.3, -0.4], [0.95, 0.3, 0.4], (count, 3))


@pytest.fixture
def policy_folder(tmp_path: Path) -> Path:
    policy = Policy.untrained("pull-closed-door", NETWORK, seed=5)
    for name in ("prior", "aap", "aip"):
        policy.with_trained(name)
    folder = tmp_path / "policy"
    folder.mkdir()
    for name, data in policy.to_files(half=True).items():
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "object" / "scan.npz"
    path.parent.mkdir()
    np.savez(path, points=front())
    return path


def session(policy_folder: Path, scan: Path, **changes: object) -> Session:
    files = SessionFiles(scan.parent / "history.json", scan.parent / "heatmap.npz")
    return Session(load_policy(policy_folder), files, **changes)  # type: ignore[arg-type]


# Frames.


direction = arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: float(np.linalg.norm(v)) > 0.1)


@given(up=direction, origin=arrays(np.float64, 3, elements=st.floats(-2, 2)))
def test_points_and_directions_come_back_and_up_is_up(up: Float, origin: Float) -> None:
    frame = ScanFrame(up=tuple(up), origin=tuple(origin), camera=(0.0, 0.0, 0.0))
    rotation = frame.world_from_scan
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    points = front(20)
    np.testing.assert_allclose([frame.point_to_scan(p) for p in frame.to_world(points)], points, atol=1e-12)
    np.testing.assert_allclose(frame.direction_to_scan(rotation @ up), up, atol=1e-12)


def test_how_a_scan_is_turned_and_moved_changes_nothing_that_networks_see() -> None:
    """A camera's own frame (x right, y down, z forward) and a robot's (z up, elsewhere) show the same."""
    points = front()
    robot = checked_scan(points + np.array([3.0, 4.0, 1.0]))
    optical = checked_scan(np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1))
    expected = points - (points.min(axis=0) + points.max(axis=0)) / 2
    for scan, up, camera in ((robot, (0.0, 0.0, 1.0), (3.0, 4.0, 1.0)), (optical, (0.0, -1.0, 0.0), (0.0, 0.0, 0.0))):
        observation = observation_of(scan, ScanFrame.around(scan, up, camera))
        # The camera looks along +x of the view frame, with z up, as it does in what the points were made in.
        np.testing.assert_allclose(points_in_view(observation), expected[observation.pixels], atol=2e-3)


def test_estimated_normals_face_the_camera() -> None:
    flat = front()
    flat[:, 0] = 0.9
    scan = checked_scan(flat)
    normals = observation_of(scan, ScanFrame.around(scan)).normals
    world = ScanFrame.around(scan).world_from_scan @ [-1.0, 0.0, 0.0]
    assert (normals @ world > 0.98).all()


def test_an_action_far_from_the_cloud_is_refused() -> None:
    scan = checked_scan(front())
    frame = ScanFrame.around(scan)
    observation = observation_of(scan, frame)
    found = action_at(observation, frame, (0.9, 0.1, 0.2), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert np.linalg.norm(frame.point_to_scan(found.point) - [0.9, 0.1, 0.2]) < 0.06
    np.testing.assert_allclose(frame.direction_to_scan(found.approach), [1, 0, 0], atol=1e-9)
    with pytest.raises(UsageError, match="off the cloud"):
        action_at(observation, frame, (900.0, 100.0, 200.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(UsageError, match="not parallel"):
        action_at(observation, frame, (0.9, 0.1, 0.2), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))


# Files.


def test_lines_that_are_too_long_are_one_line_each() -> None:
    long = b"x" * (3 * MAX_LINE_BYTES)
    found = list(lines_of(io.BytesIO(long + b"\n{}\n" + long)))
    assert [line[:3] for line in found] == [b"xxx", b"{}\n", b"xxx"]
    assert [len(line) >= MAX_LINE_BYTES for line in found] == [True, False, True]


def test_a_history_comes_back(tmp_path: Path) -> None:
    frame = ScanFrame(origin=(0.9, 0.0, 0.0))
    history = History.model_validate(
        {"frame": frame, "interactions": [
            {"cloud": "a/scan.ply", "point": (1, 2, 3), "approach": (1, 0, 0), "forward": (0, 0, 1),
             "outcome": {"motion": 0.2}},
        ]}
    )  # fmt: skip
    write_history(tmp_path / "history.json", history)
    assert read_history(tmp_path / "history.json") == history


def test_a_session_that_was_killed_leaves_nothing_to_the_next(tmp_path: Path) -> None:
    history = tmp_path / "history.json"
    kill_while_writing(history)
    write_history(history, History(frame=ScanFrame(origin=(0.9, 0.0, 0.0))))
    assert list(tmp_path.iterdir()) == [history]


@pytest.mark.parametrize(
    ("told", "success"),
    [
        (TriedOutcome(motion=0.2), True),
        (TriedOutcome(motion=0.005), False),
        (TriedOutcome(motion=0.2, success=False), False),
        (TriedOutcome(motion=0.2, kind=OutcomeKind.OK), True),
        (TriedOutcome(motion=0.2, kind=OutcomeKind.NO_GRASP), False),
        (TriedOutcome(motion=0.0, grasp_width=0.03), False),
    ],
)
def test_an_outcome_succeeds_by_its_motion_unless_told(told: TriedOutcome, success: bool) -> None:
    assert told.outcome.success is success
    assert told.outcome.motion == told.motion
    assert told.outcome.kind is told.kind
    assert told.outcome.grasp_opening == pytest.approx(
        float("nan") if told.grasp_width is None else told.grasp_width, nan_ok=True
    )


def test_an_outcome_without_details_says_that_they_are_unknown() -> None:
    told = TriedOutcome.model_validate_json('{"motion": 0.0}').outcome
    assert told.kind is OutcomeKind.UNKNOWN
    assert math.isnan(told.grasp_opening)


def entry(**changes: object) -> dict[str, object]:
    known: dict[str, object] = {"cloud": "scan.npz", "point": [0.92, 0, 0], "approach": [1, 0, 0]}
    return known | {"forward": [0, 0, 1], "outcome": {"motion": 0.1}} | changes


def history_text(*interactions: object, **changes: object) -> str:
    known = {"format": "adaafford-history", "schema_version": 1, "frame": {"origin": [0.92, 0, 0]}}
    return json.dumps(known | {"interactions": interactions} | changes)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "Invalid JSON"),
        ("[" * 5000, "Invalid JSON"),
        (" " * (2 << 20), "larger than"),
        (history_text(format="other"), "format"),
        (history_text(schema_version=2), "schema_version"),
        (history_text(frame={"origin": [0, 0, 0], "up": [0, 0, 0]}), "needs a direction"),
        (history_text(frame={"origin": [float("nan"), 0, 0]}), "origin"),
        (history_text(frame={"origin": [1e300, 0, 0]}), "origin"),
        (history_text(entry(cloud="/etc/passwd")), "without '..'"),
        (history_text(entry(cloud="../scan.npz")), "without '..'"),
        (history_text(entry(outcome={"motion": -1})), "motion"),
        (history_text(entry(outcome={"motion": 1e9})), "motion"),
        (history_text(entry(point=[1, 2])), "point"),
        (history_text(entry(more=1)), "more"),
        (history_text(entry(outcome=None), entry()), "has no outcome though others follow"),
        (history_text(*[entry()] * (MAX_TRIES + 1)), "interactions"),
    ],
)
def test_a_hostile_history_is_refused_in_one_line(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "history.json").write_text(text)
    with pytest.raises((UsageError, StoreError)) as refused:
        read_history(tmp_path / "history.json")
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


def test_heatmaps_of_every_format_hold_the_affordance(tmp_path: Path) -> None:
    import plotly.io  # noqa: F401  Its import may warn; the page alone is asked about below.

    points, heat = front(50), np.linspace(0, 1, 50, dtype=np.float32)
    for name in ("heat.ply", "heat.npz", "heat.html"):
        write_heatmap(tmp_path / name, points, heat, np.arange(50, dtype=np.uint32))
    held = np.load(tmp_path / "heat.npz", allow_pickle=False)
    np.testing.assert_array_equal(held["affordance"], heat)
    np.testing.assert_allclose(read_scan_points(tmp_path / "heat.ply"), points, atol=1e-6)
    page = (tmp_path / "heat.html").read_text()
    assert "<html" in page
    assert 'src="http' not in page
    assert (colours(heat)[[0, -1]] == [[30, 60, 140], [200, 20, 30]]).all()
    with pytest.raises(UsageError, match=r"allowed: \.ply, \.npz, \.html"):
        write_heatmap(tmp_path / "heat.obj", points, heat, np.arange(50, dtype=np.uint32))


def read_scan_points(path: Path) -> Float:
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as file:
        return np.asarray(load_ply(file)["vertices"])


# Policies.


def test_a_policy_is_found_by_folder_file_run_or_name(
    policy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = load_policy(policy_folder).to_files()
    assert load_policy(policy_folder / WEIGHTS_FILE).to_files() == wanted
    run = make_finished_run(tmp_path / "run", objects=2)
    assert load_policy(run.path).task == "push-faucet"
    brought = tmp_path / "pretrained"
    brought.mkdir()
    (brought / "pull-closed-door").symlink_to(policy_folder)
    monkeypatch.setattr("adaafford.pretrained.PRETRAINED_FOLDER", brought)
    assert pretrained_names() == [only_pretrained()] == ["pull-closed-door"]
    assert load_policy("pull-closed-door").to_files() == wanted
    with pytest.raises(UsageError, match=r"no policy 'push': give a name \(pull-closed-door\)"):
        load_policy("push")


@pytest.mark.parametrize(
    "name",
    ["pull", "pull-closed-door", "pull-closed-door-sparse", "pull-sparse", "push", "push-faucet", "push-faucet-sparse"],
)
def test_the_package_brings_a_policy_with_its_card(name: str) -> None:
    policy = load_policy(name)
    assert (policy.task, policy.trained) == (name.removesuffix("-sparse"), {"prior", "aap", "aip"})
    card = (PRETRAINED_FOLDER / name / "README.md").read_text()
    assert "procedural objects only" in card
    assert "gap closed" in card
    scan = checked_scan(front(10_000))
    heat = Adapter(policy).affordance(observation_of(scan, ScanFrame.around(scan)), [])
    assert np.ptp(heat) > 0.01, "no place is better than another"


def test_scores_in_half_precision_agree(policy_folder: Path) -> None:
    whole = Policy.untrained("pull-closed-door", NETWORK, seed=5)
    scan = checked_scan(front())
    observation = observation_of(scan, ScanFrame.around(scan))
    before, after = (Adapter(p).affordance(observation, []) for p in (whole, load_policy(policy_folder)))
    np.testing.assert_allclose(before, after, atol=1e-2)


def test_an_exported_policy_has_a_card_and_adapts(tmp_path: Path, scan: Path) -> None:
    run = make_finished_run(tmp_path / "run", objects=2)
    out = tmp_path / "exported"
    for _ in range(2):
        assert adaafford(["export-policy", str(run.path), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["README.md", "done.json", POLICY_FILE, WEIGHTS_FILE]
    card = (out / "README.md").read_text()
    for word in (
        "push-faucet",
        "procedural objects only",
        "licence | MIT",
        "half precision",
        "## Limits",
        "## Results",
    ):
        assert word in card
    assert session(out, scan).step(scan).do == "try"


def test_an_export_leaves_other_files_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_finished_run(tmp_path / "run", objects=2)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    assert adaafford(["export-policy", str(run.path), "--out", str(tmp_path / "mine")]) == 2
    assert "holds something that is not an exported policy" in capsys.readouterr().err


# The loop.


@pytest.mark.parametrize("proposer", ["aip", "aip-spread", "information-gain", "purefps"])
def test_a_session_fills_its_history_and_then_acts(policy_folder: Path, scan: Path, proposer: str) -> None:
    live = session(policy_folder, scan, budget=1, proposer=proposer)
    first = live.step(scan)
    assert (first.do, first.tries) == ("try", 0)
    history = read_history(scan.parent / "history.json")
    assert history.pending is not None
    assert history.pending.point == first.point
    heat = np.load(scan.parent / "heatmap.npz")
    assert heat["points"].shape == (2048, 3)
    np.testing.assert_allclose(heat["points"], front()[heat["indices"]], atol=1e-3)
    second = live.step(scan, TriedOutcome(motion=0.3))
    assert (second.do, second.tries) == ("act", 1)
    assert not np.array_equal(np.load(scan.parent / "heatmap.npz")["affordance"], heat["affordance"])
    assert len(read_history(scan.parent / "history.json").interactions) == 2


def test_a_scan_that_was_written_over_is_noticed(policy_folder: Path, scan: Path) -> None:
    """A robot that saves every scan under one name would give the policy interactions with scans that it never saw."""
    live = session(policy_folder, scan)
    live.step(scan)
    np.savez(scan, points=front(seed=2))
    renewed = live.step(scan)
    assert renewed.tries == 0
    live.step(scan, TriedOutcome(motion=0.2))
    np.savez(scan, points=front(seed=3))
    with pytest.raises(UsageError, match="use a new file name for every scan"):
        live.step(scan, TriedOutcome(motion=0.2))
    later = scan.with_name("scan-2.npz")
    scan.rename(later)
    np.savez(scan, points=front(seed=2))
    assert live.step(later, TriedOutcome(motion=0.2)).tries == 2


def test_a_history_ends_somewhere(policy_folder: Path, scan: Path) -> None:
    (scan.parent / "history.json").write_text(history_text(*[entry()] * MAX_TRIES))
    with pytest.raises(UsageError, match="begin another"):
        session(policy_folder, scan).step(scan)


def without_time(step: Step) -> Step:
    return step.model_copy(update={"seconds": 0.0})


def test_a_step_that_is_asked_for_again_is_the_same(policy_folder: Path, scan: Path) -> None:
    steps = [session(policy_folder, scan).step(scan) for _ in range(2)]
    assert without_time(steps[0]) == without_time(steps[1])
    assert len(read_history(scan.parent / "history.json").interactions) == 1
    lost = session(policy_folder, scan).step(scan, TriedOutcome(motion=0.2))
    assert without_time(session(policy_folder, scan).step(scan)) == without_time(lost)


def test_an_outcome_that_is_told_again_is_counted_once(policy_folder: Path, scan: Path) -> None:
    later = scan.with_name("scan-2.npz")
    np.savez(later, points=front(seed=2))
    assert session(policy_folder, scan).step(scan).interaction == 1
    for _ in range(2):  # By the scan that came with it.
        step = session(policy_folder, scan).step(later, TriedOutcome(motion=0.2))
        assert (step.tries, step.interaction) == (1, 2)
    for outcome in (TriedOutcome(motion=0.0), TriedOutcome(motion=0.0)):  # By its number, with any scan.
        assert session(policy_folder, scan).step(later, outcome, interaction=2).tries == 2
    assert session(policy_folder, scan).step(later, TriedOutcome(motion=0.2), interaction=1).tries == 2
    before = (scan.parent / "history.json").read_bytes()
    with pytest.raises(UsageError, match=r"interaction 1 has an outcome already, motion 0\.2"):
        session(policy_folder, scan).step(later, TriedOutcome(motion=0.3), interaction=1)
    with pytest.raises(UsageError, match="interaction 4 was not proposed; the history holds 3"):
        session(policy_folder, scan).step(later, TriedOutcome(motion=0.3), interaction=4)
    assert (scan.parent / "history.json").read_bytes() == before


def test_a_request_asks_for_one_thing(policy_folder: Path, scan: Path) -> None:
    assert Request.read(b'{"health": true}').health
    for line in (b"{}", b'{"cloud": "a.npz", "health": true}', b'{"cloud": "a.npz", "interaction": 1}'):
        with pytest.raises(UsageError, match=r'write \{"cloud": "scan.ply"\}'):
            Request.read(line)
    live = session(policy_folder, scan)
    assert (live.health.steps, live.health.last) == (0, None)
    live.step(scan)
    live.step(scan, TriedOutcome(motion=0.2))
    assert (live.health.steps, live.health.tries) == (2, 1)
    assert live.health.last is not None
    assert live.health.last.propose > 0


def test_files_carry_a_session_over_processes(policy_folder: Path, scan: Path, tmp_path: Path) -> None:
    """Begun anew before every step, a session says what one that lives on says."""
    other = tmp_path / "other" / scan.name
    other.parent.mkdir()
    other.write_bytes(scan.read_bytes())
    alive = session(policy_folder, scan)
    outcomes = [None, TriedOutcome(motion=0.0), TriedOutcome(motion=0.2)]
    lasting = [alive.step(scan, outcome) for outcome in outcomes]
    anew = [session(policy_folder, other).step(other, outcome) for outcome in outcomes]
    assert [without_time(step) for step in lasting] == [without_time(step) for step in anew]


def test_misuse_is_refused_and_changes_nothing(policy_folder: Path, scan: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no proposal that waits"):
        session(policy_folder, scan).step(scan, TriedOutcome(motion=0.2))
    assert not (scan.parent / "history.json").exists()
    session(policy_folder, scan).step(scan)
    before = (scan.parent / "history.json").read_bytes()
    with pytest.raises(UsageError, match="was begun with up"):
        session(policy_folder, scan, up=(0.0, 1.0, 0.0)).step(scan)
    np.savez(tmp_path / "elsewhere.npz", points=front())
    with pytest.raises(UsageError, match="is not in the folder of the history"):
        session(policy_folder, scan).step(tmp_path / "elsewhere.npz")
    scan.with_name("loop.npz").symlink_to("loop.npz")
    for name in (f"{'x' * 300}.npz", "loop.npz"):
        with pytest.raises(UsageError, match="there is no such file"):
            session(policy_folder, scan).step(scan.parent / name)
    assert (scan.parent / "history.json").read_bytes() == before


@pytest.mark.parametrize("name", ["scan\u202f1.npz", "scan\u00a01.npz", "scan\u30001.npz", "\u03b4\u200d.npz"])
def test_a_scan_may_have_any_name_that_can_be_read(name: str, policy_folder: Path, scan: Path) -> None:
    named = scan.rename(scan.with_name(name))
    session(policy_folder, named).step(named)
    assert [each.cloud for each in read_history(scan.parent / "history.json").interactions] == [name]
    assert session(policy_folder, named).step(named, TriedOutcome(motion=0.2)).tries == 1


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (os.fsdecode(b"scan\xff.npz"), "scan\\udcff.npz: needs a name without control characters, in UTF-8"),
        ("x\x1b[31my.npz", "x\\x1b[31my.npz: needs a name without control characters"),
        ("x\ny.npz", "x\\ny.npz: needs a name without control characters"),
        ("/".join(["d" * 200] * 5) + "/scan.npz", "needs a name of 1 to 1000 characters; given 1013"),
    ],
)
def test_a_name_that_a_history_cannot_hold_is_refused_before_any_work(
    name: str, expected: str, policy_folder: Path, scan: Path
) -> None:
    named = scan.parent / name
    named.parent.mkdir(parents=True, exist_ok=True)
    scan.rename(named)
    with pytest.raises(UsageError) as refused:
        session(policy_folder, scan).step(named)
    assert expected in str(refused.value)
    assert str(refused.value).isprintable()
    assert not [path for path in scan.parent.iterdir() if path.stem in ("history", "heatmap")]


def test_names_too_long_for_the_disk_are_refused(policy_folder: Path, scan: Path) -> None:
    for length in (250, 300):  # The first is too long for the temporary file beside it alone.
        files = SessionFiles(scan.with_name("h" * length), None)
        with pytest.raises(UsageError, match="cannot be written"):
            Session(load_policy(policy_folder), files).step(scan)
    (scan.parent / "history.json").write_text(history_text(entry(cloud=f"{'x' * 300}.npz")))
    with pytest.raises(UsageError, match="there is no such file"):
        session(policy_folder, scan).step(scan)


def test_a_frame_that_is_none_is_refused_in_one_line(
    policy_folder: Path, scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--cloud", str(scan), "--history", str(scan.parent / "history.json"), "--policy", str(policy_folder)]
    for flags, expected in (
        (["--up", "0", "0", "0"], "needs a direction, such as 0 0 1"),
        (["--camera", "nan", "0", "0"], "nan"),
        (["--camera", "1e9", "0", "0"], "less than or equal to 10000"),
    ):
        assert adaafford(["adapt", *where, *flags]) == 2
        line = capsys.readouterr().err
        assert expected in line
        assert line.count("\n") == 1


def test_a_long_session_forgets_scans_that_nothing_was_tried_on(policy_folder: Path, scan: Path) -> None:
    lasting = session(policy_folder, scan)
    for number in range(4):
        again = scan.parent / f"again-{number}.npz"
        np.savez(again, points=front() + 0.001 * number)
        lasting.step(again)
    assert len(lasting._seen) == 1


def test_what_was_tried_is_remembered_though_its_hash_was_left_out(policy_folder: Path, scan: Path) -> None:
    (scan.parent / "history.json").write_text(history_text(entry()))
    later = scan.with_name("later.npz")
    np.savez(later, points=front(seed=2))
    lasting = session(policy_folder, scan)
    lasting.step(later)
    before = dict(lasting._seen)
    lasting.step(later)
    assert len(before) == 2
    assert all(lasting._seen[key] is observation for key, observation in before.items())


def test_what_looks_wrong_in_a_scan_is_said_once_and_changes_nothing(
    policy_folder: Path, scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = front()
    points = np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1)
    points[::2] = 0
    np.savez(scan, points=points)
    where = ["--cloud", str(scan), "--history", str(scan.parent / "history.json"), "--policy", str(policy_folder)]
    assert adaafford(["adapt", *where]) == 0
    first = capsys.readouterr()
    up, missing = first.err.splitlines()
    assert "up is probably 0 -1 0" in up
    assert "1500 of 3000 points were not measured" in missing
    assert read_history(scan.parent / "history.json").frame.up == (0.0, 0.0, 1.0)
    assert adaafford(["adapt", *where]) == 0
    again = capsys.readouterr()
    assert again.err.splitlines() == [missing], "the history says what is up"
    assert json.loads(again.out) | {"seconds": 0} == json.loads(first.out) | {"seconds": 0}
    other = [*where[:3], str(scan.parent / "other.json"), *where[4:], "--up", "0", "0", "1"]
    assert adaafford(["adapt", *other]) == 0
    assert capsys.readouterr().err.splitlines() == [missing]


@pytest.mark.parametrize("line", [b'\xef\xbb\xbf{"cloud": "scan.ply"}', b'{"cloud": "scan.ply", "outcome": null}\r\n'])
def test_a_request_is_read(line: bytes) -> None:
    assert Request.read(line) == Request(cloud="scan.ply")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"\xff\xfe{\0", "UTF-16"),
        (b'{"cloud": "a.ply", "cloud": "b.ply"}', "the name 'cloud' occurs twice"),
        (b'{"cloud": "a\\u001b.ply"}', "cloud: needs a name without control characters"),
        (b'{"cloud": "a.ply", "outcome": {"motion": NaN}}', "outcome.motion"),
        (b"[" * 60_000, "Invalid JSON"),
    ],
)
def test_a_request_that_is_none_is_refused_in_one_line(line: bytes, expected: str) -> None:
    with pytest.raises(UsageError, match=r'write {"cloud": "scan.ply"}') as refused:
        Request.read(line)
    assert expected in str(refused.value)
    assert str(refused.value).isprintable()


def test_the_command_proposes_takes_an_outcome_and_writes_a_heatmap(
    policy_folder: Path, scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--cloud", str(scan), "--history", str(scan.parent / "history.json"), "--policy", str(policy_folder)]
    assert adaafford(["adapt", *where]) == 0
    first = json.loads(capsys.readouterr().out)
    assert (first["do"], first["tries"]) == ("try", 0)
    assert (scan.parent / "heatmap.ply").is_file()
    assert adaafford(["adapt", *where, "--outcome", "0.2"]) == 0
    assert json.loads(capsys.readouterr().out)["tries"] == 1
    for wrong, expected in (
        (["--outcome", "-1"], "--outcome: setting 'motion'"),
        (["--kind", "no-grasp"], "give --outcome MOTION"),
        (["--grasp-width", "0.02"], "give --outcome MOTION"),
        (["--outcome", "0", "--grasp-width", "20"], "--outcome: setting 'grasp_width'"),
        (["--outcome", "0", "--grasp-width", "nan"], "--outcome: setting 'grasp_width'"),
        (["--out", "heat.obj"], "not a kind of heatmap"),
        (
            ["--out", "nowhere/heat.ply", "--cloud", "none.ply"],
            "nowhere/heat.ply: there is no folder nowhere; create it",
        ),
        (["--budget", "0"], "at least one interaction"),
        (["--proposer", "afps"], "allowed: aip, aip-spread"),
        (["--points", "9"], "allowed are 64 to 16384"),
    ):
        assert adaafford(["adapt", *where, *wrong]) == 2
        line = capsys.readouterr().err
        assert expected in line
        assert line.count("\n") == 1


@pytest.mark.slow
def test_a_robot_may_follow_line_by_line(policy_folder: Path, scan: Path) -> None:
    command = [sys.executable, "-m", "cluster", "adapt", "--cloud", str(scan), "--policy", str(policy_folder)]
    command += ["--history", str(scan.parent / "history.json"), "--follow"]
    lines = [b'{"cloud": "scan.npz", "outcome": {"motion": 0.2}}', b"nonsense", b'{"cloud": "../x.npz"}', b"\xff"]
    done = subprocess.run(command, input=b"\n".join(lines) + b"\n", capture_output=True, check=True)
    first, second, *refused = [json.loads(line) for line in done.stdout.splitlines()]
    assert [first["tries"], second["tries"]] == [0, 1]
    assert [list(each) for each in refused] == [["error"]] * 3


def test_the_example_of_the_readme_runs(policy_folder: Path) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text()
    example = text.split("```python\n")[1].split("```")[0]
    assert '"pull-closed-door"' in example
    names: dict[str, object] = {}
    exec(example.replace('"pull-closed-door"', repr(str(policy_folder))), names)  # noqa: S102
    heat, best, history = names["heat"], names["best"], names["history"]
    assert isinstance(heat, np.ndarray)
    assert heat.shape == (2048,)
    assert isinstance(best, Action)
    assert isinstance(history, list)
    assert 1 <= len(history) <= 4


def test_a_simulated_view_that_comes_as_a_scan_shows_networks_the_same() -> None:
    """From the simulator's world through a file's frame and back, in whatever frame the file is."""
    rng = np.random.default_rng(4)
    seen = fabricate_observation(rng, 2048, camera_pose(170.0, 40.0, 5.0), parts=2)
    turn = gripper_rotation(np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0]))
    offset = np.array([2.0, -1.0, 0.5])
    camera, up = turn @ seen.world_from_camera[:3, 3] + offset, turn[:, 2]
    scan = checked_scan(seen.points @ turn.T + offset, seen.normals @ turn.T, seen.movable)
    frame = ScanFrame(up=tuple(up.tolist()), camera=tuple(camera.tolist()), origin=tuple(offset.tolist()))
    read = observation_of(scan, frame)
    np.testing.assert_allclose(points_in_view(read), points_in_view(seen)[read.pixels], atol=1e-3)
    assert (read.movable == seen.movable[read.pixels]).all()
    rotation = gripper_rotation(np.array([0.8, 0.0, -0.6]), rng.normal(size=3))
    action = Action(7, seen.points[7].astype(np.float64), rotation)
    point, approach, forward = (turn @ action.point + offset, turn @ action.approach, turn @ action.forward)
    again = action_at(read, frame, tuple(point), tuple(approach), tuple(forward))
    assert read.pixels[again.point_index] == 7
    np.testing.assert_allclose(frames_in_view(read, [again]), frames_in_view(seen, [action]), atol=1e-6)
