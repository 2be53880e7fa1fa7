"""Arms in rollouts, proposals and sessions: what an arm cannot reach is neither executed nor proposed."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from adaafford.histories import TriedOutcome
from adaafford.scans import ScanFrame, checked_scan, observation_of, read_scan
from adaafford.sessions import Session, SessionFiles, Step
from cluster.cli.library import simulated_again
from cluster.cli.main import run as adaafford
from cluster.evaluation.rehearsal import Setting as Rehearsal
from cluster.evaluation.rehearsal import SimulatedRobot
from cluster.evaluation.resimulation import chosen_interactions, resimulate
from collector.objects.articulation import SURFACE_POINTS, surface_at
from collector.objects.catalogue import load_ref, scan
from collector.objects.procedural.catalogue import generate
from collector.rollout import draw_arm_base
from collector.setting import make_setting
from collector.sim.armed import ArmedEnvironment
from collector.sim.restoration import restored
from collector.sim.simulator import StageClock
from collector.worker import Worker
from shared.arms.arm import ARMS, URDF
from shared.arms.kinematics import ArmReach, chain_of, reachable_points
from shared.config import CameraConfig, CollectionConfig, Fidelity, RolloutConfig
from shared.errors import StoreError, UsageError
from shared.geometry import camera_pose, gripper_rotation
from shared.plan import Job, Plan, Setting
from shared.policies.adaptation import Adapter
from shared.policies.proposers import SpreadAipProposer, proposer_named
from shared.primitives import PRIMITIVES
from shared.store import Store
from shared.store.codecs.columns import ROLLOUT_COLUMNS, RolloutRow
from shared.store.codecs.tables import read_table, table_bytes
from shared.store.layout import ARM_VERSION
from shared.store.validity import check_rollouts
from shared.store.writer import rollout_digest
from shared.tasks import Task, task_named
from shared.types import Action, HiddenDynamics, Interaction, Observation, Outcome, OutcomeKind
from tests.adaafford.test_adapt_command import front
from tests.collector.test_determinism import ROLLOUTS, collected
from tests.support.arms import urdf_of
from tests.support.fabricate import fabricate_rollout, fabricate_setting
from tests.support.fake_simulator import FakeEnvironment
from tests.support.single_door import door
from tests.support.small_policies import policy_with_all

PANDA = ARMS.get("panda")
PROPOSERS = (
    "aip",
    "fps",
    "purefps",
    "argfps",
    "aip-spread",
    "information-gain",
    "information-value",
    "aap",
    "where2act",
)
INTO = gripper_rotation(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def cabinet(seed: int = 1) -> Observation:
    """A front 0.4 m wide that an arm at the camera reaches in part."""
    scan = checked_scan(front(600, seed) * [0.75, 1.5, 1.2] + [0.0, 0.0, 0.3])
    return observation_of(scan, ScanFrame.around(scan), points=256)


def with_arm(observation: Observation, seed: int = 1) -> Observation:
    """The same before a Panda, on the floor at the camera."""
    x, y, _ = observation.world_from_camera[:3, 3]
    scan_floor = float(observation.points[:, 2].min()) - 0.1
    base = (float(x), float(y), scan_floor, float(np.arctan2(-y, -x)))
    reach = ArmReach(PANDA, base, PRIMITIVES.get("push"), observation.points.astype(np.float64))
    return dataclasses.replace(observation, reach=reach)


def reached(observation: Observation, action: Action | None) -> bool:
    assert observation.reach is not None and action is not None
    return observation.reach.trajectory(action) is not None


# Proposals.


@pytest.mark.parametrize("name", PROPOSERS)
def test_each_proposer_proposes_what_the_arm_reaches(name: str) -> None:
    adapter, rng = Adapter(policy_with_all()), np.random.default_rng(1)
    seen = cabinet()
    armed = with_arm(seen)
    free = [proposer_named(name, adapter, np.random.default_rng(k), 4).propose(seen, []) for k in range(4)]
    for _ in range(3):
        assert reached(armed, proposer_named(name, adapter, rng, 4).propose(armed, []))
    if name in ("aip", "aap", "where2act"):
        assert not all(reached(armed, action) for action in free), "the arm made no difference"


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["panda", "ur5e"])
def test_none_of_a_thousand_proposals_is_out_of_reach(arm: str) -> None:
    adapter, rng = Adapter(policy_with_all()), np.random.default_rng(2)
    seen = with_arm(cabinet())
    base = (*seen.world_from_camera[:2, 3].tolist(), float(seen.points[:, 2].min()) - 0.1, 0.0)
    reach = ArmReach(ARMS.get(arm), base, PRIMITIVES.get("pull"), seen.points.astype(np.float64))
    armed = dataclasses.replace(seen, reach=reach)
    for k in range(1000):
        name = PROPOSERS[k % 2 * 6]
        assert reached(armed, proposer_named(name, adapter, rng, 4, 0.2 if name == "aip" else None).propose(armed, []))


def test_aip_goes_near_an_earlier_interaction_where_the_arm_reaches_nothing_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen, adapter = cabinet(), Adapter(policy_with_all())
    first = SpreadAipProposer(adapter, np.random.default_rng(1), 4).propose(seen, [])
    assert first is not None
    near = np.linalg.norm(seen.points - first.point, axis=1) < 0.1

    class NearTheFirst:
        def trajectory(self, action: Action) -> np.ndarray | None:
            return np.zeros((1, 1)) if near[action.point_index] else None

    monkeypatch.setattr("shared.policies.adaptation.reachable_points", lambda observation: near)
    armed = dataclasses.replace(seen, reach=NearTheFirst())
    history = [Interaction(armed, first, Outcome(OutcomeKind.OK, 0.0, False))]
    far = SpreadAipProposer(adapter, np.random.default_rng(1), 4, at_least=4).propose(seen, history)
    assert far is not None
    assert not near[far.point_index]
    assert reached(armed, SpreadAipProposer(adapter, np.random.default_rng(1), 4, at_least=4).propose(armed, history))


def test_an_arm_that_reaches_everything_changes_no_choice() -> None:
    class Everything:
        def trajectory(self, action: Action) -> np.ndarray:
            return np.zeros((1, 1))

    seen = cabinet()
    armed = dataclasses.replace(seen, reach=Everything())
    for name in PROPOSERS:
        first, second = (
            proposer_named(name, Adapter(policy_with_all()), np.random.default_rng(3), 4).propose(each, [])
            for each in (seen, armed)
        )
        assert first is not None and second is not None
        assert first.point_index == second.point_index
        np.testing.assert_array_equal(first.rotation, second.rotation)


# Rollouts.


def test_what_is_out_of_reach_is_not_executed_and_a_known_arm_is_told() -> None:
    clock, task = StageClock(), task_named("push")
    fake = FakeEnvironment(
        door(), task, CollectionConfig(), HiddenDynamics(), camera_pose(180, 30, 5), np.random.default_rng(1), clock
    )
    fake.reset(np.random.default_rng(1))
    for known in (True, False):
        armed = ArmedEnvironment(fake, PANDA, (-0.95, 0.0, -0.3, 0.0), known, clock)
        armed.restore(door().limits()[:, 0])
        seen = armed.observe()
        assert seen is armed.observe(), "the same state is the same observation"
        assert (seen.reach is not None) is known
        before = armed.state().copy()
        far = armed.execute(Action(0, np.array([0.0, 0.0, 3.0]), INTO))
        assert (far.kind, far.motion, far.success, far.steps) == (OutcomeKind.UNREACHABLE, 0.0, False, 0)
        assert far.kind.is_label and not far.kind.is_valid
        np.testing.assert_array_equal(armed.state(), before)
        assert armed.execute(Action(0, np.array([-0.3, 0.0, 0.2]), INTO)).kind is OutcomeKind.OK


def test_the_base_of_a_rollout_stands_before_the_object_and_faces_it() -> None:
    task = task_named("pull")
    setting = make_setting(task, CollectionConfig(arm="ur5e"), seed=3, objects=(door().ref,))
    plan = Plan(setting=setting)
    bases = [draw_arm_base(plan, index, door()) for index in range(30)]
    assert bases == [draw_arm_base(plan, index, door()) for index in range(30)]
    assert len(set(bases)) == 30
    surface = surface_at(door(), door().limits()[:, 0])
    assert len(surface) == SURFACE_POINTS
    for x, y, z, yaw in bases:
        assert x < surface[:, 0].min() and z == surface[:, 2].min()
        assert abs(np.arctan2(-y, -x) - yaw) < 0.25
    assert (
        draw_arm_base(Plan(setting=make_setting(task, CollectionConfig(), seed=3, objects=(door().ref,))), 0, door())
        == ()
    )


def test_surfaces_move_with_their_parts() -> None:
    closed, open_ = (surface_at(door(), np.array([at])) for at in (0.0, 1.5))
    moved = np.linalg.norm(closed - open_, axis=1) > 1e-9
    assert 0.3 < moved.mean() < 0.9
    assert open_[:, 0].min() < closed[:, 0].min() - 0.3


def test_an_arm_is_part_of_a_setting_only_if_there_is_one(tmp_path: Path) -> None:
    task, refs = task_named("pull"), (door().ref,)
    assert "arm" not in json.dumps(make_setting(task, CollectionConfig(), seed=1, objects=refs).as_document())
    named = make_setting(task, CollectionConfig(arm="panda"), seed=1, objects=refs)
    assert named.arm is PANDA and "arm_definition" not in named.as_document()
    file = tmp_path / "secret-place" / "own.urdf"
    file.parent.mkdir()
    file.write_text(urdf_of(PANDA))
    own = make_setting(task, CollectionConfig(arm=str(file)), seed=1, objects=refs)
    assert own.collection.arm == URDF and "secret" not in own.model_dump_json()
    again = Setting.model_validate_json(json.dumps(own.as_document()))
    assert again == own and again.arm == own.arm
    with pytest.raises(UsageError, match="allowed: panda, ur5e"):
        make_setting(task, CollectionConfig(arm="puma"), seed=1, objects=refs)


def test_the_base_is_part_of_a_rollout_that_has_one() -> None:
    plain = fabricate_rollout(Plan(setting=fabricate_setting()), 0)
    armed = dataclasses.replace(plain, arm_base=(1.0, 2.0, 3.0, 4.0))
    assert rollout_digest(plain) != rollout_digest(armed)
    data = table_bytes(ROLLOUT_COLUMNS, [RolloutRow(plain, 0), RolloutRow(armed, 0)])
    assert read_table(data, ROLLOUT_COLUMNS, 2, "x").column("arm_base").to_pylist() == [[], [1.0, 2.0, 3.0, 4.0]]
    with pytest.raises(StoreError, match="arm_base of 4 numbers"):
        bad = dataclasses.replace(plain, arm_base=(1.0,))
        check_rollouts([bad], Job(plain.plan_key, 0, 1), len(plain.observations[0].points), "x")
    older = [column for column in ROLLOUT_COLUMNS if column.name != "arm_base"]
    data = table_bytes(older, [RolloutRow(plain, 0)])
    assert read_table(data, ROLLOUT_COLUMNS, 1, "x").column("arm_base").to_pylist() == [[]]


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 2}, 1)
    return folder


@pytest.mark.slow
def test_a_collection_with_an_arm_has_one_digest_for_any_number_of_workers(objects: Path, tmp_path: Path) -> None:
    more = {"collection.arm": "panda"}
    stores = [collected(tmp_path / f"{n}", objects, n, ROLLOUTS // max(n, 1), **more) for n in (0, 2)]
    assert stores[0].digest() == stores[1].digest()
    rows = stores[0].interactions(["outcome", "motion", "steps"]).to_pylist()
    out = [row for row in rows if row["outcome"] == "unreachable"]
    assert 0 < len(out) < len(rows)
    assert all(row["motion"] == 0 and row["steps"] == 0 for row in out)
    plan = Plan(setting=stores[0].setting)
    records = stores[0].read_rollouts(Job(plan.key, 0, ROLLOUTS).shard_id)
    assert all(len(record.arm_base) == 4 for record in records)


# Sessions with a robot.


def session_of(folder: Path, **changes: object) -> Session:
    np.savez(folder / "scan.npz", points=front(600) * [0.75, 1.5, 1.2] + [0.0, 0.0, 0.3])
    files = SessionFiles(folder / "history.json", folder / "heatmap.npz")
    return Session(policy_with_all(), files, points=256, arm=PANDA, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_a_step_gives_the_trajectory_of_its_action(tmp_path: Path, up: tuple[float, float, float]) -> None:
    session = session_of(tmp_path)
    if up[1]:
        # The camera's own frame: x right, y down, z forward.
        points = np.load(tmp_path / "scan.npz")["points"]
        np.savez(tmp_path / "scan.npz", points=np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1))
        files = SessionFiles(tmp_path / "history.json", tmp_path / "heatmap.npz")
        # The base faces the object, which is along z: a quarter turn about up from x.
        session = Session(
            policy_with_all(), files, points=256, up=up, arm=PANDA, base=(0.0, 0.0, 0.0, float(np.pi / 2))
        )
    step = session.step(tmp_path / "scan.npz")
    assert session.step(tmp_path / "scan.npz").trajectory == step.trajectory, "a step that is repeated"
    assert step.trajectory is not None and step.trajectory.joints[0] == "panda_joint1"
    path = np.array(step.trajectory.waypoints)
    hand = chain_of(PANDA).hands(path)[-1]
    turn = np.eye(3) if not up[1] else np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    end = np.array(step.point) - 0.10 * np.array(step.approach)
    assert np.linalg.norm(hand[:3, 3] - turn @ end) < 2e-3
    assert np.arccos(np.clip(hand[:3, 2] @ (turn @ step.approach), -1, 1)) < np.deg2rad(0.5)
    assert (path >= chain_of(PANDA).lower).all() and (path <= chain_of(PANDA).upper).all()
    heat = np.load(tmp_path / "heatmap.npz")
    assert heat["reachable"].shape == heat["affordance"].shape and heat["reachable"].any()


def test_an_arm_needs_a_task_that_is_known(tmp_path: Path) -> None:
    policy, files = policy_with_all(), SessionFiles(tmp_path / "history.json", None)
    policy.task = "push-slowly"
    with pytest.raises(UsageError, match="in the policy's task 'push-slowly' is not known here"):
        Session(policy, files, arm=PANDA)
    Session(policy.defined_as(Task(name="push-slowly", primitive="push")), files, arm=PANDA)


def test_an_arm_that_reaches_nothing_is_said_and_nothing_is_written(tmp_path: Path) -> None:
    session = session_of(tmp_path, base=(5.0, 0.0, 0.0, 0.0))
    with pytest.raises(UsageError, match="reaches none of the actions"):
        session.step(tmp_path / "scan.npz")
    assert not (tmp_path / "history.json").exists()


def test_points_out_of_reach_are_marked() -> None:
    armed = with_arm(cabinet())
    marked = reachable_points(armed)
    assert marked.any() and not marked.all()
    away = np.linalg.norm(armed.points - armed.world_from_camera[:3, 3], axis=1)
    assert away[marked].mean() < away[~marked].mean()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--arm", "puma"], "allowed: panda, ur5e"),
        (["--base", "1", "0", "0", "0"], "name the arm"),
        (["--arm", "panda", "--base", "nan", "0", "0", "0"], "finite"),
    ],
)
def test_flags_of_an_arm_that_cannot_be_honoured(
    flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "scan.npz", points=front(600))
    base = ["--cloud", str(tmp_path / "scan.npz"), "--history", str(tmp_path / "h.json"), "--policy", "push-faucet"]
    assert adaafford(["adapt", *base, *flags]) == 2
    shown = capsys.readouterr().err
    assert said in shown and shown.count("\n") == 1


@pytest.mark.parametrize("static", [False, True])
def test_a_rehearsed_arm_answers_unreachable(static: bool, objects: Path, tmp_path: Path) -> None:
    environment, again = next(simulated_again(objects, "pull-closed-door", seed=1, arm="panda"))
    told = {"task": "pull-closed-door", "object": environment.object.ref.id, "seed": 1, "number": 0, "noise": 0.0}
    setting = Rehearsal.model_validate(told | {"marked": True, "arm": "panda"})
    robot = SimulatedRobot(environment, again, setting, tmp_path)
    assert robot.base is not None and robot.base[:3] == (0.0, 0.0, 0.0)
    seen = read_scan(tmp_path / robot.request.cloud)
    assert seen.movable is not None
    point = seen.points[seen.movable][0].tolist()
    if static:
        assert isinstance(environment, ArmedEnvironment)
        observed = environment.observe()
        point = (observed.points[observed.part_ids == 0][0] - environment.base[:3]).tolist()
    step = Step(
        do="try", tries=0, interaction=1, point=point, approach=(-1, 0, 0), forward=(0, 0, 1), belief=0.5, seconds=0
    )
    told_outcome = robot.execute(step).outcome
    assert told_outcome == TriedOutcome(motion=0.0, success=False, kind=OutcomeKind.UNREACHABLE)


def test_a_worker_stores_where_the_arm_stood(objects: Path, tmp_path: Path) -> None:
    camera = CameraConfig(image_size=64, points=64, candidates=200)
    collection = CollectionConfig(
        arm="panda", camera=camera, fidelity=Fidelity(), rollout=RolloutConfig(interactions=8, continued=0)
    )
    refs = tuple(entry.ref for entry in scan(objects).usable)
    plan = Plan(setting=make_setting(task_named("push"), collection, seed=1, objects=refs))
    store = Store.create(tmp_path / "store", plan.setting)
    job = Job(plan.key, 0, 1)
    Worker(tmp_path / "store", objects).run(plan, job)
    (record,) = store.read_rollouts(job.shard_id)
    assert len(record.arm_base) == 4
    assert store.document.schema_version == ARM_VERSION == store.committed()[0].schema_version
    out = [row for row in record.interactions if row.outcome.kind is OutcomeKind.UNREACHABLE]
    assert 0 < len(out) < len(record.interactions)
    # Only what was executed is executed again.
    again = resimulate(store, objects, rows=100, seed=1)
    assert len(again.rows) == len(record.interactions) - len(out)
    assert all(row.stored.kind is row.again.kind for row in again.rows)
    assert len(chosen_interactions(store, rollout=0)[1]) == len(again.rows)
    with pytest.raises(UsageError, match="the arm cannot reach it"):
        restored(load_ref(objects, record.object), collection, record, out[0])
