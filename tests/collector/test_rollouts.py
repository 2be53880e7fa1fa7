"""Rollouts come out the same whoever runs them, and hold what a replay needs."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import for_task, load_ref, scan
from collector.objects.procedural import generate
from collector.random_proposer import LEAST_COSINE, RandomProposer, edge_points, random_rotation
from collector.rollout import draw_rollout, object_of, run_rollout
from collector.setting import packages_used
from collector.sim.camera import EmbreeCamera, observation_from
from collector.sim.environment import draw_state
from collector.sim.scene import Scene
from collector.sim.simulator import StageClock
from collector.sim.trial import Trial
from collector.worker import Worker
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.errors import ObjectError, UsageError
from shared.geometry import camera_pose
from shared.plan import EvaluationConfig, Job, Plan, RolloutRecord, Setting
from shared.policies.methods import METHODS
from shared.primitives import PRIMITIVES
from shared.store import Store
from shared.tasks import TASKS, task_named
from shared.types import Action, Interaction, Observation, Order, Outcome, OutcomeKind, Proposer, Role
from tests.support.fake_simulator import FAKE_SIMULATORS, FakeEnvironment
from tests.support.single_door import door

FRONT = camera_pose(180, 20, 5)
SMALL = CollectionConfig(
    camera=CameraConfig(image_size=128, points=256, candidates=1000),
    rollout=RolloutConfig(interactions=6, actions_per_state=3, context=2),
)
FAKE = SMALL.model_copy(update={"simulator": "fake"})


class Named(RandomProposer):
    """A random proposer that rows call by another name."""

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self.name = name  # type: ignore[misc]
        self.seen: list[int] = []

    def propose(self, observation: Observation, history: Sequence[Interaction]) -> Action | None:
        self.seen.append(len(history))
        return super().propose(observation, history)


def no_policy(name: str, rng: np.random.Generator, version: int, share: float | None = None) -> Proposer:
    return Named(name, rng)


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 2, "Faucet": 2}, seed=5)
    return folder


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator of that name, for tests of the loop around one."""
    monkeypatch.setattr("collector.rollout.SIMULATORS", FAKE_SIMULATORS)


def plan_for(objects: Path, task: str = "push", **changes: object) -> Plan:
    refs = tuple(entry.ref for entry in for_task(scan(objects), task_named(task)).usable)
    return Plan(setting=Setting(task=task, seed=3, objects=refs, collection=SMALL).model_copy(update=changes))


def rollout(plan: Plan, objects: Path, index: int = 0) -> RolloutRecord:
    return run_rollout(plan, index, load_ref(objects, object_of(plan, index)), no_policy, StageClock())


def test_the_digest_does_not_depend_on_shards_order_or_age_of_the_worker(objects: Path, tmp_path: Path) -> None:
    plan = plan_for(objects)
    digests = []
    for name, ranges in (("one", [(0, 4)]), ("many", [(3, 4), (0, 2), (2, 3)])):
        store = Store.create(tmp_path / name, plan.setting)
        worker = Worker(store.path, objects)
        for low, high in ranges:
            worker.run(plan, Job(plan.key, low, high))
        digests.append(store.digest())
    assert digests[0] == digests[1]


def test_a_worker_without_the_packages_of_a_setting_does_nothing(objects: Path, tmp_path: Path) -> None:
    plan = plan_for(objects, extensions=("primitive twist: my-package 1.2",))
    worker = Worker(Store.create(tmp_path / "store", plan.setting).path, objects)
    with pytest.raises(UsageError, match=r"is of primitive twist: my-package 1\.2, but here is no package; install"):
        worker.run(plan, Job(plan.key, 0, 1))


def test_a_policy_proposes_with_one_thread(objects: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_for(objects)
    guided = Plan(setting=plan.setting, proposer="aip", policy_version=1)
    worker, threads = Worker(Store.create(tmp_path / "store", plan.setting).path, objects), list[int]()
    monkeypatch.setattr("collector.worker.run_rollout", lambda *_: threads.append(torch.get_num_threads()))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        worker.execute(guided, 0, StageClock())
        assert (threads, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


def test_a_job_done_twice_is_done_once(objects: Path, tmp_path: Path) -> None:
    plan = plan_for(objects)
    store = Store.create(tmp_path / "store", plan.setting)
    job = Job(plan.key, 0, 1)
    first, second = (Worker(store.path, objects).run(plan, job) for _ in range(2))
    assert first.interactions == second.interactions == 6
    assert len(store.committed()) == 1


def test_an_object_that_changed_since_is_refused(objects: Path, tmp_path: Path) -> None:
    plan = plan_for(objects)
    changed = tuple(ref.model_copy(update={"content_hash": "0" * 64}) for ref in plan.setting.objects)
    plan = Plan(setting=plan.setting.model_copy(update={"objects": changed}))
    Store.create(tmp_path / "store", plan.setting)
    with pytest.raises(ObjectError):
        Worker(tmp_path / "store", objects).run(plan, Job(plan.key, 0, 1))


def test_a_rollout_is_about_one_part_and_rollouts_about_all(objects: Path) -> None:
    plan = plan_for(objects)
    touched: dict[str, set[int]] = {}
    for index in range(16):
        record = rollout(plan, objects, index)
        parts = {row.target_part for row in record.interactions}
        assert len(parts) == 1
        for seen in record.observations:
            assert set(seen.part_ids[seen.movable].tolist()) == parts
        touched.setdefault(record.object.id, set()).update(parts)
    assert max(map(len, touched.values())) > 1


@pytest.mark.usefixtures("fake")
def test_restart_order_tries_several_actions_from_one_observed_state(objects: Path) -> None:
    record = rollout(plan_for(objects, collection=FAKE), objects)
    assert record.status == "ok"
    assert [row.step for row in record.interactions] == list(range(6))
    assert {row.order for row in record.interactions} == {Order.RESTART}
    for first in (0, 3):
        group = record.interactions[first : first + 3]
        assert len({row.observation for row in group}) == 1
        assert all(np.array_equal(row.joint_positions, group[0].joint_positions) for row in group)


@pytest.mark.usefixtures("fake")
def test_continue_order_starts_where_the_last_try_left_the_object(objects: Path) -> None:
    config = FAKE.model_copy(update={"rollout": RolloutConfig(interactions=8, order=Order.CONTINUE)})
    record = rollout(plan_for(objects, collection=config), objects)
    assert {row.order for row in record.interactions} == {Order.CONTINUE}
    assert any(row.outcome.success for row in record.interactions[:-1])
    for row, following in zip(record.interactions, record.interactions[1:], strict=False):
        if row.outcome.motion > 0.01:
            part = row.target_part - 1
            assert abs(following.joint_positions[part] - row.joint_positions[part]) > 1e-4


@pytest.mark.usefixtures("fake")
def test_a_policy_proposes_first_and_random_tries_fill_the_rest(objects: Path) -> None:
    plan = plan_for(objects, collection=FAKE).model_copy(update={"proposer": "aip", "policy_version": 2})
    record = rollout(plan, objects)
    assert [(row.proposer, row.policy_version) for row in record.interactions] == [("aip", 2)] * 2 + [("random", 0)] * 4
    assert [row.order for row in record.interactions] == [Order.CONTINUE] * 2 + [Order.RESTART] * 4


def test_a_row_is_enough_to_replay_its_interaction(objects: Path) -> None:
    plan = plan_for(objects)
    for index in range(2):
        record = rollout(plan, objects, index)
        target = load_ref(objects, record.object)
        for row in record.interactions:
            primitive = PRIMITIVES.get(row.primitive)
            scene = Scene(target, record.dynamics, plan.setting.collection.fidelity, primitive)
            scene.put(row.joint_positions)
            again = Trial(scene, row.action, row.target_part, primitive, plan.setting.collection.fidelity).run()
            assert again.kind is row.outcome.kind
            assert again.success is row.outcome.success
            # Half a percent, since a part that swings on for a radian multiplies what the scene has left of before.
            assert again.end_joint_position == pytest.approx(row.outcome.end_joint_position, abs=5e-3, rel=5e-3)


def test_points_and_normals_of_rows_are_those_of_their_clouds(objects: Path) -> None:
    record = rollout(plan_for(objects), objects)
    for row in record.interactions:
        cloud = record.observations[row.observation]
        assert np.array_equal(cloud.points[row.action.point_index], row.action.point)
        assert cloud.part_ids[row.action.point_index] == row.target_part
        assert cloud.movable[row.action.point_index]
        assert row.action.approach @ row.normal < -(LEAST_COSINE - 0.02)
        assert np.linalg.norm(row.hand_start[:3] + 0.15 * row.action.approach - row.action.point) < 1e-9


def test_the_recorded_twist_says_where_the_touched_point_goes(objects: Path) -> None:
    rows = [row for index in range(4) for row in rollout(plan_for(objects), objects, index).interactions]
    moved = [row for row in rows if row.outcome.success and row.outcome.motion < 0.2]
    assert moved
    for row in moved:
        signed = row.outcome.end_joint_position - row.outcome.start_joint_position
        expected = signed * (np.cross(row.joint_twist[:3], row.action.point) + row.joint_twist[3:])
        assert row.outcome.displacement == pytest.approx(expected, abs=0.15 * np.linalg.norm(expected) + 1e-4)
        assert row.joint_names[row.target_part - 1] == row.target_joint


@pytest.mark.usefixtures("fake")
def test_evaluation_gives_every_method_the_same_start_and_the_same_questions(objects: Path) -> None:
    evaluation = EvaluationConfig(methods=("where2act", "ours-random", "ours-final"), budgets=(1, 2), queries=3)
    plan = plan_for(objects, kind="evaluation", evaluation=evaluation, collection=FAKE)
    record = rollout(plan, objects)
    queries = [row for row in record.interactions if row.role is Role.QUERY]
    assert len(queries) == 3
    for method in evaluation.methods:
        rows = [row for row in record.interactions if row.method == method]
        assert np.array_equal(rows[0].joint_positions, queries[0].joint_positions)
        tries = [row for row in rows if row.role is Role.CONTEXT]
        exploits = [row for row in rows if row.role is Role.EXPLOIT]
        again = [row for row in rows if row.role is Role.EXPLOIT_AT_START]
        assert len(tries) == (0 if method == "where2act" else 2)
        assert [row.budget for row in exploits] == [1, 2]
        assert [row.budget for row in again] == ([] if method == "where2act" else [1, 2])
        assert all(np.array_equal(row.joint_positions, queries[0].joint_positions) for row in again)
        assert {row.proposer for row in tries} <= {"random", "aip"}
        assert {row.proposer for row in exploits} == {"where2act" if method == "where2act" else "aap"}


@pytest.mark.usefixtures("fake")
def test_evaluation_by_share_comes_last_and_leaves_all_other_rows_as_they_are(objects: Path) -> None:
    evaluation = EvaluationConfig(methods=("where2act", "ours-random", "ours-final"), budgets=(1, 2), queries=3)
    by_share = evaluation.model_copy(update={"exploit_share": 0.01})
    natural, both = (
        rollout(plan_for(objects, kind="evaluation", evaluation=told, collection=FAKE), objects)
        for told in (evaluation, by_share)
    )
    count = len(natural.interactions)
    for row, same in zip(natural.interactions, both.interactions[:count], strict=True):
        assert (row.step, row.role, row.method, row.budget) == (same.step, same.role, same.method, same.budget)
        assert np.array_equal(row.action.rotation, same.action.rotation)
        assert row.outcome.end_joint_position == same.outcome.end_joint_position
    start, more = natural.interactions[0].joint_positions, both.interactions[count:]
    context, exploit = Role.CONTEXT_BY_SHARE, Role.EXPLOIT_BY_SHARE
    # AIP alone draws its tries anew; the others are told what they have tried.
    assert [(row.method, row.role, row.budget) for row in more] == [
        *(("where2act", exploit, budget) for budget in (1, 2)),
        *(("ours-random", exploit, budget) for budget in (1, 2)),
        *(("ours-final", context, -1) for _ in range(2)),
        *(("ours-final", exploit, budget) for budget in (1, 2)),
    ]
    assert all(np.array_equal(row.joint_positions, start) for row in more if row.role is exploit)


@pytest.mark.usefixtures("fake")
def test_repeats_come_last_at_the_start_and_are_of_methods_with_interactions(objects: Path) -> None:
    told = EvaluationConfig(methods=("where2act", "ours-random"), budgets=(1, 2), queries=3, exploit_share=0.01)
    with_repeats = told.model_copy(update={"repeats": True})
    before, after = (
        rollout(plan_for(objects, kind="evaluation", evaluation=each, collection=FAKE), objects)
        for each in (told, with_repeats)
    )
    more = after.interactions[len(before.interactions) :]
    assert [(row.method, row.role, row.budget) for row in more] == [
        ("ours-random", Role.REPEAT_AT_START, budget) for budget in (1, 2)
    ]
    start = before.interactions[0].joint_positions
    assert all(np.array_equal(row.joint_positions, start) for row in more)
    assert "repeats" not in told.model_dump_json()


def test_a_setting_without_a_share_is_the_document_that_it_was() -> None:
    assert "exploit_share" not in EvaluationConfig().model_dump_json()
    told = EvaluationConfig(exploit_share=0.01)
    assert EvaluationConfig.model_validate_json(told.model_dump_json()) == told
    for wrong in (0.0, 1.5, -0.01):
        with pytest.raises(ValidationError, match="exploit_share"):
            EvaluationConfig(exploit_share=wrong)


@pytest.mark.usefixtures("fake")
def test_methods_use_their_own_proposers_budgets_and_policies(objects: Path) -> None:
    methods = ("where2act-interaction", "where2act-adaptation", "ours-argfps", "ours-no-iteration", "ours-final")
    evaluation = EvaluationConfig(methods=methods, budgets=(2, 1), queries=1)
    plan = plan_for(objects, kind="evaluation", evaluation=evaluation, collection=FAKE).model_copy(
        update={"policy_version": 3}
    )
    record = rollout(plan, objects)
    for name in methods:
        method, rows = METHODS.get(name), [row for row in record.interactions if row.method == name]
        version = 1 if name == "ours-no-iteration" else 3
        assert {row.policy_version for row in rows} == {version}
        tries = [row for row in rows if row.role is Role.CONTEXT]
        exploits = [row for row in rows if row.role is Role.EXPLOIT]
        assert {row.proposer for row in tries} == {method.tries}
        assert {row.proposer for row in exploits} == {method.critic}
        budgets = [4] if name == "where2act-interaction" else [1, 2]
        assert [row.budget for row in exploits] == budgets
        assert len(tries) == budgets[-1]


def test_draws_depend_on_the_plan_and_the_number_alone(objects: Path) -> None:
    plan = plan_for(objects)
    assert draw_rollout(plan, 5) == draw_rollout(plan, 5)
    assert draw_rollout(plan, 5).dynamics != draw_rollout(plan, 6).dynamics
    assert draw_rollout(plan, 5, attempt=1).dynamics == draw_rollout(plan, 5).dynamics
    assert draw_rollout(plan, 5, attempt=1).azimuth_deg != draw_rollout(plan, 5).azimuth_deg
    count = len(plan.setting.objects)
    for turn in range(3):
        ids = {object_of(plan, turn * count + k).id for k in range(count)}
        assert len(ids) == count


def test_faucets_draw_every_direction(objects: Path) -> None:
    plan = plan_for(objects, "push-faucet")
    assert len({draw_rollout(plan, k).dynamics.direction for k in range(40)}) == 3
    record = rollout(plan, objects)
    assert all(row.target_joint and row.joint_limits.shape[1] == 2 for row in record.interactions)


def test_states_follow_the_published_mixture() -> None:
    rng, limits = np.random.default_rng(0), np.tile([[0.0, 1.0]], (4, 1))
    states = np.array([draw_state(limits, False, rng) for _ in range(2000)])
    assert (states == 0).all(axis=1).mean() == pytest.approx(0.5 + 0.5 / 16, abs=0.04)
    assert states.max() > 0.9
    assert not draw_state(limits, True, rng).any()


def test_random_approaches_stay_within_their_cap_and_fill_it() -> None:
    rng, normal = np.random.default_rng(0), np.array([0.0, 0.6, -0.8])
    rotations = np.array([random_rotation(normal, rng) for _ in range(500)])
    cosines = -(rotations[:, :, 2] @ normal)
    assert cosines.min() >= LEAST_COSINE - 1e-9
    assert cosines.mean() == pytest.approx((1 + LEAST_COSINE) / 2, abs=0.01)
    assert np.abs(rotations[:, :, 0].mean(axis=0)).max() < 0.15


def test_edges_are_found_where_the_part_ends() -> None:
    image = EmbreeCamera(door(), FRONT, CameraConfig()).capture(np.zeros(1))
    cloud = observation_from(image, FRONT, (1,), CameraConfig(), np.random.default_rng(0))
    assert cloud is not None
    edges = edge_points(cloud)
    assert cloud.movable[edges].all()
    to_edge = 0.3 - np.abs(cloud.points[:, 1:]).max(axis=1)
    assert to_edge[edges].max() < 0.05
    inner = np.flatnonzero(cloud.movable & (to_edge < 0.01))
    assert np.isin(inner, edges).mean() > 0.9
    proposer = RandomProposer(np.random.default_rng(0), edge_share=1.0)
    proposed = [proposer.propose(cloud, ()) for _ in range(50)]
    assert all(action is not None and action.point_index in edges for action in proposed)


def test_a_depth_image_is_kept_beside_the_same_cloud() -> None:
    kept = CameraConfig(keep_depth=True)
    image = EmbreeCamera(door(), FRONT, kept).capture(np.zeros(1))
    plain, cloud = (
        observation_from(image, FRONT, (1,), config, np.random.default_rng(0)) for config in (CameraConfig(), kept)
    )
    assert plain is not None and plain.dense is None
    assert cloud is not None and cloud.dense is not None
    assert np.array_equal(cloud.points, plain.points)
    dense = cloud.dense.points()
    assert len(dense) == len(image.pixels)
    np.testing.assert_allclose(dense, image.points, atol=1e-3)


def test_an_unknown_method_is_refused_with_those_there_are() -> None:
    with pytest.raises(UsageError, match="ours-final"):
        METHODS.get("ours-fianl")


@pytest.mark.real_objects
@pytest.mark.parametrize("object_id", ["45166", "149", "100189", "7263"])
def test_real_objects_give_rollouts(real_objects: Path, object_id: str) -> None:
    target: ArticulatedObject = load_ref(real_objects, scan(real_objects / object_id).usable[0].ref)
    plan = Plan(setting=Setting(task="push", seed=0, objects=(target.ref,), collection=SMALL))
    record = run_rollout(plan, 0, target, no_policy, StageClock())
    assert record.status == "ok"
    assert len(record.interactions) == 6


@pytest.mark.usefixtures("fake")
def test_a_rollout_ends_where_the_simulation_diverges(objects: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = iter([False, True])

    def execute(environment: FakeEnvironment, action: Action) -> Outcome:
        return Outcome(OutcomeKind.UNSTABLE if next(outcomes) else OutcomeKind.OK, 0.0, False)

    monkeypatch.setattr(FakeEnvironment, "execute", execute)
    record = rollout(plan_for(objects, collection=FAKE), objects)
    assert [row.outcome.kind for row in record.interactions] == [OutcomeKind.OK, OutcomeKind.UNSTABLE]


def test_a_setting_says_what_it_left_to_the_task() -> None:
    task = task_named("pull-closed-door")
    resolved = task.resolve(SMALL)
    assert (resolved.primitive, resolved.dynamics, resolved.rollout.edge_share) == (task.primitive, task.dynamics, 0.5)
    told = SMALL.model_copy(update={"rollout": RolloutConfig(edge_share=0.0)})
    assert task.resolve(told).rollout.edge_share == 0.0
    assert task.resolve(resolved) == resolved


def test_what_has_the_default_hand_and_simulator_is_written_as_before_these_had_names() -> None:
    written = SMALL.as_document()
    assert not {"gripper", "simulator"} & written.keys()
    assert FAKE.as_document() == {**written, "simulator": "fake"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"primitive": "shove"},
            "unknown primitive 'shove'; allowed: push, push-left, push-up, pull, pull-left, pull-up",
        ),
        ({"gripper": "claw"}, "unknown gripper 'claw'; allowed: panda, suction"),
        ({"simulator": "dream"}, "unknown simulator 'dream'; allowed: sapien"),
    ],
)
def test_a_setting_with_an_unknown_name_is_refused_with_those_there_are(changes: dict[str, str], said: str) -> None:
    with pytest.raises(UsageError) as refused:
        packages_used(task_named("push"), SMALL.model_copy(update=changes))
    assert str(refused.value) == said
    assert packages_used(task_named("pull"), SMALL) == ()


def test_a_setting_means_the_same_whether_it_was_resolved_or_not(objects: Path) -> None:
    for name in TASKS.names():
        written = plan_for(objects, name)
        resolved = plan_for(objects, name, collection=task_named(name).resolve(SMALL))
        assert written.setting.terms == resolved.setting.terms
        assert draw_rollout(written, 3) == draw_rollout(resolved, 3)
    points = [
        [row.action.point_index for row in rollout(plan, objects, 1).interactions]
        for plan in (plan_for(objects, "pull"), plan_for(objects, "pull", collection=task_named("pull").resolve(SMALL)))
    ]
    assert points[0] == points[1]


def test_no_simulator_is_imported_before_one_is_chosen() -> None:
    script = "import sys, collector.rollout; print(sorted({'sapien', 'coacd', 'embreex'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
