"""Gymnasium environments: they keep to its interface, and are the project's own loop to the last bit."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit

import adaafford
import shared.extras as extras_module
from adaafford.gymnasium_ids import env_id, register
from collector.gym.environment import NOT_EXECUTED, action_of, action_values, observation_of
from collector.objects.catalogue import load_ref
from collector.objects.procedural import generate
from collector.random_proposer import RandomProposer
from collector.rollout import interact, object_of, run_rollout
from collector.sim.simulator import Simulator, StageClock
from collector.simulated_objects import SimulatedObjects
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.errors import UsageError
from shared.extensions import Registry
from shared.plan import RolloutRecord
from shared.policies.adaptation import Adapter
from shared.policies.proposers import AipProposer
from shared.tasks import TASKS, task_named
from shared.types import Action, Observation, Order, Outcome, OutcomeKind
from tests.support.example_package import install_here
from tests.support.fake_simulator import FAKE_SIMULATORS, FakeEnvironment
from tests.support.small_policies import history_of, policy_of
from tests.support.small_policies import observation_of as cloud_of

Env = gymnasium.Env[Any, Any]
CAMERA = CameraConfig(image_size=96, points=128, candidates=500)
SMALL = CollectionConfig(camera=CAMERA)
SEED = 3


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"Faucet": 2, "StorageFurniture": 1}, seed=5)
    return folder


@pytest.fixture
def make(objects: Path) -> Iterator[Callable[..., Env]]:
    """Makes environments on small clouds, which are closed after the test."""
    made = []

    def env(name: str = "adaafford/PushFaucet-v0", **settings: Any) -> Env:
        made.append(gymnasium.make(name, **{"objects": objects, "collection": SMALL, **settings}))
        return made[-1]

    yield env
    for each in made:
        each.close()


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> CollectionConfig:
    """Settings with a simulator that computes no physics."""
    for module in ("rollout", "setting"):
        monkeypatch.setattr(f"collector.{module}.SIMULATORS", FAKE_SIMULATORS)
    return SMALL.model_copy(update={"simulator": "fake"})


def random_values(values: dict[str, Any], count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Random actions at points of an observation that may be acted on."""
    proposer = RandomProposer(np.random.default_rng(seed), 0.5)
    proposed = [proposer.propose(observation_of(values), []) for _ in range(count)]
    return [action_values(action) for action in proposed if action is not None]


def same(left: Any, right: Any) -> bool:
    """Whether two things are the same bits."""
    return data_equivalence(left, right, exact=True)


def test_the_ids_are_registered_whichever_is_imported_first() -> None:
    ids = "print(sorted(name for name in gymnasium.registry if name.startswith('adaafford/')))"
    named = sorted(["adaafford/Task-v0", *map(env_id, ("push", "pull", "pull-closed-door", "push-faucet"))])
    assert "adaafford/PullClosedDoor-v0" in named
    before = "import sys, adaafford; assert 'gymnasium' not in sys.modules;"
    look = "from importlib.util import find_spec; assert find_spec('gymnasium') is not None;"
    for first in (f"{before} {look} import gymnasium;", "import gymnasium, adaafford;"):
        code = f"{first} {ids}; import gymnasium.envs; assert gymnasium.__spec__.loader is gymnasium.__loader__"
        done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == str(named)


def test_tasks_of_other_packages_have_an_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_here(tmp_path, monkeypatch)
    monkeypatch.setattr("gymnasium.registry", gymnasium.registry)
    added = {env_id(name) for name in TASKS.names()} - gymnasium.registry.keys()
    assert added
    register()
    assert added <= gymnasium.registry.keys()
    for name in added:
        del gymnasium.registry[name]


@pytest.mark.parametrize("name", ["PushFaucet", "PullClosedDoor"])
def test_gymnasium_finds_nothing_to_complain_of(make: Callable[..., Env], name: str) -> None:
    env = make(f"adaafford/{name}-v0", hidden_in_info=True)
    check_env(env.unwrapped)  # Warnings are errors here.


def test_an_episode_is_a_rollout_of_the_project_to_the_last_bit(make: Callable[..., Env], objects: Path) -> None:
    order = RolloutConfig(interactions=4, order=Order.CONTINUE)
    plan = SimulatedObjects(objects, task_named("push"), SMALL.model_copy(update={"rollout": order})).plan(SEED)

    def own(index: int) -> RolloutRecord:
        target = load_ref(objects, object_of(plan, index))
        return run_rollout(plan, index, target, no_policy, StageClock())

    env = make("adaafford/Push-v0")
    successes = 0
    for index, record in enumerate(map(own, range(3))):
        acting = adaafford.from_gymnasium(env, SEED if index == 0 else None)
        assert (acting.info["object_id"], acting.info["rollout"]) == (record.object.id, index)
        for row in record.interactions:
            observation = record.observations[row.observation]
            for each in fields(observation):
                assert np.array_equal(getattr(acting.observe(), each.name), getattr(observation, each.name)), each.name
            assert same_outcome(acting.execute(row.action), row.outcome)
            successes += row.outcome.success
        assert acting.over
        assert record.interactions
    assert successes


def test_stored_interactions_that_began_in_the_first_state_come_out_as_they_are_stored(
    make: Callable[..., Env], objects: Path
) -> None:
    order = RolloutConfig(interactions=4)
    plan = SimulatedObjects(objects, task_named("push"), SMALL.model_copy(update={"rollout": order})).plan(SEED)
    acting = adaafford.from_gymnasium(make("adaafford/Push-v0"), seed=SEED)
    successes = []
    for index in range(3):
        record = run_rollout(plan, index, load_ref(objects, object_of(plan, index)), no_policy, StageClock())
        for row in record.interactions:
            assert row.observation == 0, "all of them restart from one state"
            acting.reset(options={"rollout": index})
            again = acting.execute(row.action)
            assert (again.kind, again.success) == (row.outcome.kind, row.outcome.success)
            successes.append(again.success)
    assert {True, False} == set(successes)


def same_outcome(left: Outcome, right: Outcome) -> bool:
    """Whether all fields are the same bits, NaN included."""
    return all(
        np.array_equal(getattr(left, each.name), getattr(right, each.name), equal_nan=each.name != "kind")
        for each in fields(left)
    )


def no_policy(*args: Any) -> Any:
    raise AssertionError("random interactions need none")


def test_a_seed_gives_the_same_episodes_again(make: Callable[..., Env], objects: Path) -> None:
    episodes = []
    for env in (make(), make()):
        for seed in (SEED, None, SEED):
            values, info = env.reset(seed=seed)
            steps = [env.step(action) for action in random_values(values, 2)]
            episodes.append(((values, info), steps))
    assert [info["rollout"] for (_, info), _ in episodes] == [0, 1, 0] * 2
    assert same(episodes[0], episodes[2])
    assert same(episodes[:3], episodes[3:])
    assert not same(episodes[0], episodes[1])


def test_without_a_seed_episodes_differ_between_environments(make: Callable[..., Env], fake: CollectionConfig) -> None:
    first, second = (make(collection=fake).reset()[0] for _ in range(2))
    assert not same(first, second)


def test_options_choose_the_object_and_the_rollout(make: Callable[..., Env], fake: CollectionConfig) -> None:
    env = make("adaafford/Push-v0", collection=fake, hidden_in_info=True)
    listed = [env.reset(seed=SEED if k == 0 else None) for k in range(4)]
    assert same(env.reset(options={"rollout": 2}), listed[2])
    assert same(env.reset(), listed[3])
    _, info = env.reset(seed=SEED, options={"object": "faucet-0001"})
    assert info["object_id"] == "faucet-0001"
    assert info["hidden"]["part_mass"] == listed[0][1]["hidden"]["part_mass"]


def test_hidden_dynamics_are_told_on_request_alone(make: Callable[..., Env]) -> None:
    _, info = make().reset(seed=SEED)
    assert info.keys() == {"object_id", "category", "rollout"}
    env = make(hidden_in_info=True)
    values, info = env.reset(seed=SEED)
    draw = env.unwrapped.start.draw  # type: ignore[attr-defined]
    told = info["hidden"]
    assert {name: told[name] for name in draw.dynamics.values} == draw.dynamics.values
    assert told["direction"] == draw.dynamics.direction.value
    assert np.linalg.norm(told["joint_twist"][:3]) == pytest.approx(1.0)
    for _ in range(3):
        values, *_, info = env.step(random_values(values, 1)[0])
        assert info["hidden"]["joint_position"] == pytest.approx(info["end_joint_position"], abs=0.1)
        assert info["hidden"]["joint_limits"].shape == (2,)


def test_an_action_at_a_point_that_is_not_movable_changes_nothing(make: Callable[..., Env]) -> None:
    env = make(hidden_in_info=True)
    before, info = env.reset(seed=SEED)
    fixed = int(np.flatnonzero(before["movable"] == 0)[0])
    after, reward, terminated, truncated, told = env.step({**random_values(before, 1)[0], "point_index": fixed})
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert same(before, after)
    assert {**info, "outcome": NOT_EXECUTED, "success": False, "motion": 0.0}.keys() == told.keys()
    assert same(told["hidden"], info["hidden"])
    acting = adaafford.from_gymnasium(env, SEED)
    point = acting.observe().points[fixed].astype(np.float64)
    with pytest.raises(UsageError, match="not executed, as the task may not act on its point; choose a movable point"):
        acting.execute(Action(fixed, point, np.eye(3)))


class Ending(FakeEnvironment):
    """Ends its rollouts, at the first interaction, in ways that are rare."""

    outcome, shows, in_view, acted = OutcomeKind.OK, True, True, False

    def execute(self, action: Action) -> Outcome:
        self.acted = True
        return Outcome(self.outcome, 0.1, self.outcome is OutcomeKind.OK)

    def observe(self) -> Observation:
        seen = super().observe()
        if not self.in_view and self.acted:
            raise LookupError("no pixel sees the object")
        return seen if self.shows or not self.acted else replace(seen, movable=np.zeros_like(seen.movable))


@pytest.mark.parametrize("change", [{"outcome": OutcomeKind.UNSTABLE}, {"shows": False}, {"in_view": False}, {}])
def test_an_episode_terminates_where_the_loop_would_end(
    make: Callable[..., Env], fake: CollectionConfig, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    for name, value in change.items():
        monkeypatch.setattr(Ending, name, value)
    ending = Registry("simulator", Simulator, {"fake": Simulator(Ending)})
    monkeypatch.setattr("collector.rollout.SIMULATORS", ending)
    env = make(collection=fake, end_at_success=not change)
    values, _ = env.reset(seed=SEED)
    action = random_values(values, 1)[0]
    after, reward, terminated, truncated, info = env.step(action)
    assert (terminated, truncated) == (True, False)
    assert reward == (0.0 if "outcome" in change else 1.0)
    assert info["outcome"] == change.get("outcome", OutcomeKind.OK).value
    assert "start_joint_position" not in info, "it is not a number"
    assert after in env.observation_space
    with pytest.raises(UsageError, match="the episode is over, or none has begun; call reset"):
        env.step(action)


def test_wrappers_count_and_cut_off_episodes(make: Callable[..., Env], fake: CollectionConfig) -> None:
    env = RecordEpisodeStatistics(make(collection=fake))
    values, _ = env.reset(seed=SEED)
    steps = [env.step(action) for action in random_values(values, 4)]
    assert [truncated for _, _, _, truncated, _ in steps] == [False, False, False, True]
    assert steps[-1][-1]["episode"]["r"] == sum(float(reward) for _, reward, *_ in steps)
    assert steps[-1][-1]["episode"]["l"] == 4
    longer = make(collection=fake, max_episode_steps=6)
    assert isinstance(longer, TimeLimit)
    values, _ = longer.reset(seed=SEED)
    assert [longer.step(action)[3] for action in random_values(values, 6)] == [False] * 5 + [True]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectors_of_environments_give_what_each_gives_alone(make: Callable[..., Env], objects: Path, mode: str) -> None:
    settings = {"objects": objects, "collection": {"camera": CAMERA.model_dump()}, "hidden_in_info": True}
    many = gymnasium.make_vec("adaafford/PushFaucet-v0", num_envs=2, vectorization_mode=mode, **settings)
    alone = [make(**settings) for _ in range(2)]
    try:
        values, _ = many.reset(seed=SEED)
        first = [env.reset(seed=SEED + k)[0] for k, env in enumerate(alone)]
        assert all(same({name: values[name][k] for name in values}, first[k]) for k in range(2))
        actions = [random_values(first[k], 2, seed=k) for k in range(2)]
        for pair in zip(*actions, strict=True):
            batch = {name: np.stack([action[name] for action in pair]) for name in pair[0]}
            values, rewards, _, _, info = many.step(batch)
            for k, (env, action) in enumerate(zip(alone, pair, strict=True)):
                own, reward, *_, told = env.step(action)
                assert same({name: values[name][k] for name in values}, own)
                assert (rewards[k], info["outcome"][k]) == (reward, told["outcome"])
                assert info["hidden"]["joint_friction"][k] == told["hidden"]["joint_friction"]
    finally:
        many.close()


def test_aip_proposes_through_gymnasium_what_it_proposes_in_the_projects_loop(
    make: Callable[..., Env], objects: Path
) -> None:
    def proposer() -> AipProposer:
        return AipProposer(Adapter(policy_of()), np.random.default_rng(1), budget=2, at_least=2)

    plan = SimulatedObjects(objects, task_named("push-faucet"), SMALL)
    own = list(interact(plan.start(plan.plan(SEED), 0).environment, proposer(), 2))
    acting, aip = adaafford.from_gymnasium(make(), SEED), proposer()
    for known, interaction in enumerate(own):
        action = aip.propose(acting.observe(), own[:known])
        assert action is not None
        assert action.point_index == interaction.action.point_index
        assert np.array_equal(action.rotation, interaction.action.rotation)
        assert same_outcome(acting.execute(action), interaction.outcome)
    assert len(own) == 2


def test_actions_keep_their_bits_in_the_space(make: Callable[..., Env]) -> None:
    observation = cloud_of()
    for interaction in history_of(observation, 50):
        action = interaction.action
        again = action_of(action_values(action), observation)
        assert again.point_index == action.point_index
        assert np.array_equal(again.point, action.point)
        assert np.array_equal(again.rotation[:, [0, 2]], action.rotation[:, [0, 2]])
        assert np.abs(again.rotation - action.rotation).max() < 1e-15


def test_any_two_directions_give_a_frame() -> None:
    observation, rng = cloud_of(), np.random.default_rng(0)
    for _ in range(50):
        approach, forward = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
        rotation = action_of({"point_index": 3, "approach": approach, "forward": forward}, observation).rotation
        assert rotation.T @ rotation == pytest.approx(np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert rotation[:, 2] == pytest.approx(approach / np.linalg.norm(approach), abs=1e-6)
        assert rotation[:, 0] @ forward > 0
        assert abs(rotation[:, 1] @ forward) < 1e-6


UP, SIDEWAYS = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"point_index": 200, "approach": UP, "forward": SIDEWAYS}, "no point 200; allowed: 0 to 199"),
        ({"point_index": -1, "approach": UP, "forward": SIDEWAYS}, "no point -1; allowed: 0 to 199"),
        ({"point_index": 0, "approach": UP, "forward": UP}, "must be finite, not zero and not parallel"),
        ({"point_index": 0, "approach": [0, 0, 0], "forward": SIDEWAYS}, "must be finite, not zero and not parallel"),
        ({"point_index": 0, "approach": [0, 0, np.nan], "forward": SIDEWAYS}, "must be finite, not zero"),
        ({"point_index": 0, "approach": [0, 1], "forward": SIDEWAYS}, "an action has 'point_index', and 'approach'"),
        ({"point_index": "x", "approach": UP, "forward": SIDEWAYS}, "an action has 'point_index', and 'approach'"),
        ({"approach": UP, "forward": SIDEWAYS}, "an action has 'point_index', and 'approach'"),
        (7, "an action has 'point_index', and 'approach'"),
    ],
)
def test_what_is_no_action_is_refused_in_one_line(values: Any, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        action_of(values, cloud_of())
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("Task", {"task": "pusk"}, "unknown task 'pusk'; allowed: push, pull"),
        ("Task", {"task": "gone.toml"}, "gone.toml: "),
        ("Task", {}, "a Gymnasium environment: setting 'task': Field required"),
        ("Push", {"objects": "/nowhere"}, "/nowhere: no such folder"),
        ("Push", {"objects": {"Teapot": 1}}, "unknown category 'Teapot'; allowed: "),
        ("Push", {"objects": {"Faucet": 0}}, "setting 'objects"),
        ("Push", {"objects": 7}, "setting 'objects"),
        ("PullClosedDoor", {"objects": {"Faucet": 1}}, "no object that 'pull-closed-door' applies to"),
        ("Push", {"collection": {"camera": {"point": 64}}}, "unknown setting 'collection.camera.point'; did you mean"),
        ("Push", {"hidden": True}, "a Gymnasium environment: unknown setting 'hidden'; "),
        ("Push", {"objects_seed": -1}, "setting 'objects_seed': Input should be greater than or equal to 0"),
    ],
)
def test_bad_settings_are_refused_in_one_line(name: str, settings: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as refused:
        gymnasium.make(f"adaafford/{name}-v0", **settings)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"object": "99"}, "no object '99' that 'push-faucet' applies to; there are 2, such as 'faucet-0000'"),
        ({"rollout": -1}, "options of reset: setting 'rollout': Input should be greater"),
        ({"objekt": "faucet-0000"}, "options of reset: unknown setting 'objekt'; did you mean 'object'?"),
    ],
)
def test_bad_options_are_refused_in_one_line(make: Callable[..., Env], options: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as refused:
        make().reset(options=options)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_without_objects_procedural_ones_are_made_and_removed(fake: CollectionConfig) -> None:
    env = gymnasium.make("adaafford/PullClosedDoor-v0", collection=fake)
    folder = env.unwrapped._objects._folder  # type: ignore[attr-defined]
    found = {env.reset(seed=SEED if k == 0 else None)[1]["object_id"] for k in range(2)}
    assert found == {"storagefurniture-0000", "storagefurniture-0001"}
    assert folder.is_dir()
    env.close()
    env.close()
    assert not folder.exists()


def test_objects_that_never_come_into_view_are_told(
    make: Callable[..., Env], fake: CollectionConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeEnvironment, "shows_a_target", lambda self: False)
    with pytest.raises(UsageError, match="no object comes to rest in view; look at `adaafford objects check --settle`"):
        make(collection=fake).reset(seed=SEED)


def test_the_object_is_drawn(make: Callable[..., Env]) -> None:
    env = make(render_mode="rgb_array")
    with pytest.raises(UsageError, match="nothing to draw before the first reset"):
        env.unwrapped.render()
    values, _ = env.reset(seed=SEED)
    closed: Any = env.render()
    assert closed.shape == (96, 96, 3)
    seen = closed.reshape(-1, 3)[values["pixels"]]
    assert (seen < 255).any(axis=1).all(), "every point of the cloud is a pixel of the picture"
    grey = np.ptp(seen.astype(int), axis=1) < 3
    assert not grey[values["movable"] == 1].any()
    assert grey[values["part_ids"] == 0].all()


def test_without_gymnasium_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    found = extras_module.find_spec
    monkeypatch.setattr(extras_module, "find_spec", lambda name: None if name == "gymnasium" else found(name))
    for name in [name for name in sys.modules if name.startswith("collector.gym")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(UsageError) as refused:
        import_module("collector.gym.environment")
    line = "a Gymnasium environment needs gymnasium, not installed here: pip install 'adaafford[gym]'"
    assert str(refused.value) == line
