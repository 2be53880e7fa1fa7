"""Rehearsals: a simulated robot behind the protocol of `adapt --follow`; ended at any moment, it counts all once."""

import json
from collections.abc import Callable, Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaafford.histories import TriedOutcome, read_history
from adaafford.parts import PartError
from adaafford.pretrained import load_policy
from adaafford.scans import read_scan
from adaafford.sessions import ReachError, Session, SessionFiles, Step
from cluster.cli.library import simulated, simulated_again
from cluster.cli.main import run as adaafford
from cluster.evaluation import rehearsal
from cluster.evaluation.rehearsal import STATE, Executed, Setting, SimulatedRobot
from collector.objects.procedural.catalogue import generate
from collector.sim.camera import LEVEL_M, noisy
from collector.sim.environment import SapienEnvironment, camera_for
from shared.config import CameraConfig
from shared.errors import UsageError
from shared.policies.adaptation import Adapter
from shared.policies.proposers import ExploitProposer
from shared.types import Action, Outcome, OutcomeKind
from tests.support.small_policies import policy_with_all

TASK = "pull-closed-door"


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 2}, 1)
    return folder


@pytest.fixture
def make_robot(objects: Path, tmp_path: Path) -> Callable[[], SimulatedRobot]:
    def make(**changes: object) -> SimulatedRobot:
        environment, again = next(simulated_again(objects, TASK, seed=1))
        told = {"task": TASK, "object": environment.object.ref.id, "seed": 1, "number": 0, "noise": 1.0, "marked": True}
        return SimulatedRobot(environment, again, Setting.model_validate(told | changes), tmp_path)

    return make


def a_step(robot: SimulatedRobot, interaction: int) -> Step:
    """A proposal at a movable point of the last scan, head on."""
    scan = read_scan(robot.folder / robot.request.cloud)
    assert scan.movable is not None
    x, y, z = np.median(scan.points[scan.movable], axis=0).tolist()
    return Step(
        do="try", tries=interaction - 1, interaction=interaction, point=(x, y, z), approach=(1, 0, 0),
        forward=(0, 0, 1), belief=0.5, seconds=0.0,
    )  # fmt: skip


def test_an_answer_that_comes_again_is_executed_once(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot()
    assert robot.request.outcome is None
    step = a_step(robot, 1)
    told = robot.execute(step)
    assert (told.interaction, told.cloud) == (1, "scan-2.npz")
    assert robot.execute(step) == told
    assert make_robot().execute(step) == told, "in another process, too"
    with pytest.raises(UsageError, match="interaction 3 cannot follow 1"):
        robot.execute(step.model_copy(update={"interaction": 3}))
    with pytest.raises(UsageError, match="interaction 1 cannot follow 1"):
        robot.execute(step.model_copy(update={"point": (9.0, 9.0, 9.0)}))
    assert len(robot.executed) == 1


def test_actions_and_outcomes_are_the_same_whether_or_not_a_rehearsal_was_interrupted(
    make_robot: Callable[..., SimulatedRobot], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aimed, used = list[Action](), list[SapienEnvironment]()

    def opened(environment: SapienEnvironment, action: Action) -> Outcome:
        aimed.append(action)
        lower, upper = environment.object.limits().T
        environment.restore(lower + (upper - lower) * len(aimed) / 40)
        used.append(environment)
        return Outcome(OutcomeKind.OK, 0.1 * used.count(environment), True)  # What an engine keeps decides.

    monkeypatch.setattr(SapienEnvironment, "execute", opened)
    step, points, told = a_step(make_robot(), 1), [], []
    for interrupted in (False, True):
        for path in tmp_path.iterdir():
            path.unlink()
        aimed.clear()
        robot = make_robot()
        scan = read_scan(robot.folder / robot.request.cloud)
        for number, point in enumerate(scan.points[scan.movable][50::2000][:12].tolist(), 1):
            robot.execute(step.model_copy(update={"interaction": number, "point": tuple(point)}))
            robot = make_robot() if interrupted else robot
        points.append([tuple(action.point) for action in aimed])
        told.append(robot.executed)
    assert points[0] == points[1]
    assert told[0] == told[1]
    assert len(set(points[0])) > 2


@pytest.mark.slow
def test_simulated_outcomes_are_the_same_to_the_last_bit_after_an_interruption(
    make_robot: Callable[..., SimulatedRobot], tmp_path: Path
) -> None:
    told = []
    for interrupted in (False, True):
        for path in tmp_path.iterdir():
            path.unlink()
        robot = make_robot()
        for number in range(1, 4):
            robot.execute(a_step(robot, number))
            robot = make_robot() if interrupted else robot
        told.append(robot.executed)
    assert told[0] == told[1]


def test_a_scene_is_scanned_raw_and_the_same_after_an_interruption(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot(scene=True, marked=False)
    path = robot.folder / robot.request.cloud
    whole, scanned = path.read_bytes(), read_scan(path)
    assert scanned.movable is None
    width, height = np.ptp(scanned.points[:, 1]), np.ptp(scanned.points[:, 2])
    assert width > 3.0 > height, "a floor"
    (robot.folder / STATE).unlink()
    path.unlink()
    make_robot(scene=True, marked=False)
    assert path.read_bytes() == whole


def test_what_points_into_the_air_touches_nothing(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot()
    told = robot.execute(a_step(robot, 1).model_copy(update={"point": (9.0, 9.0, 9.0)}))
    assert told.outcome == TriedOutcome(motion=0.0, success=False, kind=OutcomeKind.NO_CONTACT)


def test_another_rehearsal_is_not_continued(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot()
    with pytest.raises(UsageError, match="another rehearsal"):
        make_robot(noise=0.0)
    (robot.folder / STATE).write_text("{")
    with pytest.raises(UsageError, match="name another folder"):
        make_robot()


class Killed(BaseException):
    """The process ended."""


def killing(at: int) -> Callable[[Path, bytes], None]:
    """A writer that is ended at a write: before the file is there where `at` is even, after it otherwise."""
    from shared.io.files import write_atomically

    writes = count()

    def write(path: Path, data: bytes) -> None:
        now = next(writes) == at // 2
        if now and at % 2 == 0:
            raise Killed
        write_atomically(path, data)
        if now:
            raise Killed

    return write


@pytest.mark.slow
def test_a_rehearsal_that_is_ended_at_every_write_counts_everything_once(
    make_robot: Callable[..., SimulatedRobot], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def played() -> Executed:
        robot = make_robot()
        session = Session(policy, SessionFiles(tmp_path / "history.json", None), budget=1, points=256)
        succeeded = rehearsal.rehearse(robot, session, lambda step, request: None)
        assert succeeded is robot.executed[-1].outcome.success
        return robot.executed[-1]

    policy, kills = policy_with_all(), 0
    for at in count():
        for path in tmp_path.iterdir():
            path.unlink()
        with monkeypatch.context() as patched:
            write = killing(at)
            patched.setattr(rehearsal, "write_atomically", write)
            patched.setattr("adaafford.histories.write_atomically", write)
            try:
                played()
                break
            except Killed:
                kills += 1
        last = played()
        assert played() == last, "a finished rehearsal stays as it is"
        state = rehearsal.State.model_validate_json((tmp_path / STATE).read_bytes())
        tried = read_history(tmp_path / "history.json").tried
        assert [one.step.interaction for one in state.executed] == list(range(1, len(state.executed) + 1))
        assert [one.outcome for one in state.executed] == [one.outcome for one in tried]
        assert last == state.executed[-1]
        assert last.step.do == "act"
    assert kills >= 12


def test_the_hand_goes_where_it_is_told(
    make_robot: Callable[..., SimulatedRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    executed = list[Action]()

    def execute(_: object, action: Action) -> Outcome:
        executed.append(action)
        return Outcome(OutcomeKind.OK, 0.1, True)

    monkeypatch.setattr(SapienEnvironment, "execute", execute)
    robot = make_robot()
    step = a_step(robot, 1)
    robot.execute(step)
    assert np.allclose(executed[0].point + rehearsal.BASE, step.point, atol=1e-6)


@pytest.mark.parametrize("succeeded", [True, False])
@pytest.mark.parametrize("error", [PartError, ReachError])
def test_a_final_action_counts_where_no_other_can_be_proposed_after_it(
    succeeded: bool,
    error: type[UsageError],
    make_robot: Callable[..., SimulatedRobot],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SapienEnvironment, "execute", lambda *_: Outcome(OutcomeKind.OK, 0.1, succeeded))
    robot = make_robot()
    session = Session(policy_with_all(), SessionFiles(robot.folder / "history.json", None), budget=1, points=256)
    seen = session.step

    def step(cloud: Path, outcome: TriedOutcome | None = None, interaction: int | None = None) -> Step:
        if interaction == 2:
            raise error("it is not found again, or out of reach")
        return seen(cloud, outcome, interaction)

    monkeypatch.setattr(session, "step", step)
    assert rehearsal.rehearse(robot, session, lambda *_: None) is succeeded
    assert [one.step.do for one in robot.executed] == ["try", "act"]
    with pytest.raises(error):
        rehearsal.rehearse(robot, session, lambda *_: None, rehearsal.Goal(50.0, within=4))


@pytest.mark.parametrize("error", [PartError, ReachError])
def test_a_rollout_in_which_nothing_can_be_proposed_is_given_up_and_the_next_one_begins(
    error: type[UsageError],
    objects: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def step(*_: object) -> Step:
        raise error("nothing can be proposed")

    monkeypatch.setattr(Session, "step", step)
    flags = ["--task", TASK, "--policy", TASK, "--objects", str(objects), "--rollouts", "2"]
    assert adaafford(["rehearse", str(tmp_path / "new"), *flags]) == 0
    said = capsys.readouterr().out
    assert [line.split(":")[0] for line in said.splitlines()[:2]] == ["0001 given up", "0002 given up"]
    assert "0 of 2 final actions succeeded" in said


def test_a_goal_is_pursued_by_several_actions(make_robot: Callable[..., SimulatedRobot], tmp_path: Path) -> None:
    policy = policy_with_all()
    for repeat in (False, True):
        robot = make_robot()
        session = Session(policy, SessionFiles(robot.folder / "history.json", None), budget=1, points=256)
        assert not rehearsal.rehearse(robot, session, lambda *_: None, rehearsal.Goal(50.0, within=4, repeat=repeat))
        assert [one.step.do for one in robot.executed] == ["try", "act", "act", "act"]
        points = {one.step.point for one in robot.executed[1:]}
        assert (len(points) == 1) is repeat
        before, after = robot._state.start, robot.executed[-1].joint_positions
        assert robot.moved in [abs(a - b) for a, b in zip(after, before, strict=True)]
        assert rehearsal.rehearse(robot, session, lambda *_: None, rehearsal.Goal(0.0, within=4))
        for path in tmp_path.iterdir():
            path.unlink()


def test_lines_go_between_session_and_robot(
    objects: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What `rehearse` prints is what `adapt --follow` reads, and the other way round."""
    session = Session(policy_with_all(), SessionFiles(tmp_path / "robot" / "history.json", None), budget=1, points=256)

    def answers(stream: object) -> Iterator[bytes]:
        yield b'{"do": "dance"}\n'
        for _ in range(2):
            request = json.loads(capsys.readouterr().out.splitlines()[0 if not said else -1])
            said.append(request)
            yield (
                session.step(
                    tmp_path / "robot" / request["cloud"],
                    TriedOutcome.model_validate(request["outcome"]) if "outcome" in request else None,
                    request.get("interaction"),
                )
                .model_dump_json()
                .encode()
            )

    said: list[dict[str, object]] = []
    monkeypatch.setattr("cluster.cli.commands.adapt.lines_of", answers)
    assert adaafford(["rehearse", str(tmp_path / "robot"), "--task", TASK, "--objects", str(objects)]) == 0
    assert [request["cloud"] for request in said] == ["scan-1.npz", "scan-2.npz"]
    assert said[1]["interaction"] == 1
    assert json.loads(capsys.readouterr().out)["interaction"] == 2


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--noise", "-1"], "allowed are 0 to 10"),
        (["--rollouts", "2"], "needs --policy"),
        (["--budget", "0"], "allowed are 1 to 32"),
        (["--seed", "-1"], "not negative"),
        (["--goal", "0.5"], "needs --policy"),
        (["--policy", "push-faucet", "--goal", "-1"], "more than 0"),
        (["--policy", "push-faucet"], "a policy for 'push-faucet', but --task is 'pull-closed-door'"),
        (["--repeat"], "give one"),
        (["--budget", "6"], "allowed are 7"),
        (["--task", "juggle"], "juggle"),
        (["--objects", "/nowhere"], "/nowhere"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert adaafford(["rehearse", str(tmp_path / "new"), "--task", TASK, *flags]) == 2
    line = capsys.readouterr().err
    assert expected in line
    assert line.count("\n") == 1


@pytest.mark.parametrize(("flags", "folder"), [([], "0001"), (["--rollouts", "2"], "0002")])
def test_a_folder_of_another_session_is_refused(
    flags: list[str], folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / folder
    taken.mkdir()
    (taken / "history.json").write_text("{}")
    place = tmp_path if flags else taken
    assert adaafford(["rehearse", str(place), "--task", TASK, "--policy", TASK, *flags]) == 2
    assert capsys.readouterr().err == (
        f"adaafford: {taken}: has the history.json of another session; name another folder\n"
    )
    assert [path.name for path in taken.iterdir()] == ["history.json"]


def test_a_bundled_policy_that_uses_the_surface_between_the_fingers_acts_on_a_simulated_object(objects: Path) -> None:
    observation = next(simulated(objects, "pull-closed-door", seed=1)).observe()
    adapter = Adapter(load_policy("pull-closed-door"))
    assert adapter.policy.config.pinch_profile
    action = ExploitProposer(adapter, np.random.default_rng(1)).propose(observation, [])
    assert action is not None
    assert observation.movable[action.point_index]


# The errors of a depth camera.


def test_noise_has_the_deviation_that_was_measured_and_leaves_pixels_out_at_edges(objects: Path) -> None:
    (environment,) = islice(simulated(objects, TASK, seed=1), 1)
    config, pose = CameraConfig(), environment.observe().world_from_camera
    image = camera_for(environment.object, pose, config).capture(environment.state())
    place = pose[:3, 3]
    assert noisy(image, config.image_size, place, 0.0, np.random.default_rng(1)) is image
    seen = noisy(image, config.image_size, place, 1.0, np.random.default_rng(1))
    again = noisy(image, config.image_size, place, 1.0, np.random.default_rng(1))
    np.testing.assert_array_equal(seen.points, again.points)
    assert 0.8 < len(seen.pixels) / len(image.pixels) < 1
    true = dict(zip(image.pixels.tolist(), image.depths.tolist(), strict=True))
    error = seen.depths - np.array([true[pixel] for pixel in seen.pixels.tolist()])
    # The quartiles of a normal distribution, which the few mixed pixels hardly move.
    deviation = np.subtract(*np.quantile(error, [0.75, 0.25])) / 1.349
    assert LEVEL_M < deviation < 1.3 * LEVEL_M
    rays = (seen.points - place) / seen.depths[:, None]
    np.testing.assert_allclose(rays @ pose[:3, 0], 1.0, atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"gripper": "Panda Hand"}, "setting 'gripper'"),
        ({"arm": "a" * 1001}, "setting 'arm'"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_simulated_objects_of_no_possible_setting_are_refused(objects: Path, settings: Any, said: str) -> None:
    with pytest.raises(UsageError, match=f"adaafford.simulated: {said}"):
        next(simulated(objects, TASK, **settings))
