"""`adaafford learn`: waits for rollouts, learns from what was there, publishes once, and is resumed to the same end."""

import json
import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster.cli.main import run
from learner.alternation import Collect, alternate
from learner.data.dataset import load_dataset
from learner.data.sampling import kept_for_validation, split
from learner.rounds import Following, Pace, publish
from learner.settings import PUBLISHED_FILE, AlternationConfig
from learner.stages.jobs import DONE_FILE, StageJob
from shared.errors import StoreError
from shared.io.files import DRIVER_LOCK, exclusive_lock
from shared.plan import Job, Plan
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE
from shared.store.coverage import Snapshot
from shared.store.store import Store
from tests.support.as_toml import as_toml
from tests.support.fabricate import fabricate_rollouts
from tests.support.small_networks import TINY
from tests.support.small_trainings import FAST, fabricated_plan

PLAN = fabricated_plan()
PACE = Pace(first=8, more=4, poll_s=0.05)
CONFIG = FAST.model_copy(update={"alternation": AlternationConfig(rounds=2, patience=2)})


def commit(store: Store, start: int, stop: int, version: int = 0) -> None:
    plan = PLAN.model_copy(update={"proposer": "aip", "policy_version": version}) if version else PLAN
    job = Job(plan.key, start, stop)
    store.commit(plan, job, fabricate_rollouts(plan, job, interactions=12, per_observation=4), {})


def collect(where: str) -> None:
    """What collectors do, who follow a learner that publishes after 8 rollouts and after 4 more."""
    store = Store.create(where, PLAN.setting)
    commit(store, 0, 4)
    commit(store, 4, 8)
    while 1 not in store.policy_versions():
        pass_some_time()
    commit(store, 0, 4, version=1)


def pass_some_time() -> None:
    threading.Event().wait(0.05)


def follow(where: str, out: Path) -> None:
    alternate(Following(StageJob("prior", where, out), PACE), CONFIG)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, Path]:
    """A store and a learner that began before there was any, to the end."""
    folder = tmp_path_factory.mktemp("learn")
    collectors = threading.Thread(target=collect, args=(str(folder / "store"),))
    collectors.start()
    follow(str(folder / "store"), folder / "out")
    collectors.join()
    return Store.open(folder / "store"), folder / "out"


def test_each_round_learns_from_what_was_there_and_publishes(followed: tuple[Store, Path]) -> None:
    store, out = followed
    seen = [Snapshot.model_validate_json((out / f"data-{number}.json").read_bytes()) for number in (1, 2)]
    assert [snapshot.ranges for snapshot in seen] == [
        {"random-v0": ((0, 8),)},
        {"aip-v1": ((0, 4),), "random-v0": ((0, 8),)},
    ]
    assert store.policy_versions() == (1, 2)
    for version in (1, 2):
        made = {name: (out / f"aip-{version}" / name).read_bytes() for name in (WEIGHTS_FILE, POLICY_FILE)}
        assert store.read_policy(version) == made


def test_it_goes_on_where_it_was_stopped_whatever_came_since(followed: tuple[Store, Path]) -> None:
    store, out = followed
    commit(store, 8, 10)
    weights = store.read_policy(2)
    (out / "aip-2" / DONE_FILE).unlink()
    follow(store.where, out)
    assert (out / "aip-2" / WEIGHTS_FILE).read_bytes() == weights[WEIGHTS_FILE]
    assert store.policy_versions() == (1, 2)


def test_validation_objects_stay_what_they_are_while_objects_come(followed: tuple[Store, Path]) -> None:
    store, out = followed
    kept = kept_for_validation(ref.id for ref in PLAN.setting.objects)
    for number in (1, 2):
        snapshot = Snapshot.model_validate_json((out / f"data-{number}.json").read_bytes())
        dataset = load_dataset(store.as_of(snapshot), TINY)
        parts = split(dataset, None, kept)
        assert {dataset.objects[each] for each in parts.validation} <= kept
        assert not {dataset.objects[each] for each in parts.train} & kept


def test_enough_is_also_something_to_judge_by(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", PLAN.setting)
    (kept,) = kept_for_validation(ref.id for ref in PLAN.setting.objects)
    number = next(k for k, ref in enumerate(PLAN.setting.objects) if ref.id == kept)
    others = [k for k in range(4) if k != number]
    for k in others:
        commit(store, k, k + 1)
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        commit(store, number, number + 1)

    following = Following(StageJob("prior", store.where, tmp_path / "out"), Pace(first=3, more=1), sleep)
    following.collect(Collect("collect-random", 0))
    job = following.job(1)
    assert len(slept) == 1
    assert job.snapshot is not None and job.snapshot.rollouts == 4
    assert job.validation_objects == {kept}


def test_a_policy_is_published_once_under_the_next_free_version(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", PLAN.setting)
    store.publish_policy(1, {WEIGHTS_FILE: b"of another learner"})
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / WEIGHTS_FILE).write_bytes(name.encode())
        (tmp_path / name / POLICY_FILE).write_bytes(b"{}")
    assert [publish(store, tmp_path, name, tmp_path / name) for name in ("a", "b", "a")] == [2, 3, 2]
    # Killed between the note and the publication, while another learner took the version.
    (tmp_path / PUBLISHED_FILE).write_text(json.dumps({"a": 1}))
    assert publish(store, tmp_path, "a", tmp_path / "a") == 4
    assert store.read_policy(4)[WEIGHTS_FILE] == b"a"
    (tmp_path / PUBLISHED_FILE).write_text("[")
    with pytest.raises(StoreError, match="damaged"):
        publish(store, tmp_path, "a", tmp_path / "a")


@pytest.mark.slow
def test_the_command_learns_from_a_finished_store_in_a_bucket_and_publishes_the_best(
    s3_url: str, tmp_path: Path
) -> None:
    store = Store.create(s3_url, PLAN.setting)
    commit(store, 0, 8)
    config = CONFIG.model_copy(update={"alternation": AlternationConfig(rounds=1), "threads": 1})
    (tmp_path / "learner.toml").write_text(as_toml(config.model_dump(mode="json")))
    arguments = ["learn", "--store", s3_url, "--out", str(tmp_path / "out"), "--config", str(tmp_path / "learner.toml")]
    for _ in range(2):
        assert run(arguments) == 0
        assert store.policy_versions() == (1,)
    assert store.read_policy(1)[WEIGHTS_FILE] == (tmp_path / "out" / "aip-1" / WEIGHTS_FILE).read_bytes()


def test_a_second_learner_in_the_same_folder_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with exclusive_lock(tmp_path / "out" / DRIVER_LOCK):
        assert run(["learn", "--store", str(tmp_path / "store"), "--out", str(tmp_path / "out"), "--follow"]) == 2
    assert "is in use by process" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert run(["learn", "--store", "s", "--out", str(tmp_path / "file" / "out"), "--follow"]) == 2
    assert "no folder can be made of this name" in capsys.readouterr().err


def test_nothing_to_wait_for_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["learn", "--store", str(tmp_path / "none"), "--out", str(tmp_path / "out")]
    assert run(arguments) == 2
    assert "there is no such folder" in capsys.readouterr().err
    assert run([*arguments, "--follow", "--more-rollouts", "0"]) == 2
    assert "--more-rollouts must be above 0" in capsys.readouterr().err


@settings(max_examples=15)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=6), st.data())
def test_a_snapshot_is_what_was_there_and_no_more(
    tmp_path_factory: pytest.TempPathFactory, sizes: list[int], data: st.DataObject
) -> None:
    store = Store.create(tmp_path_factory.mktemp("snapshot"), PLAN.setting)
    stops = [sum(sizes[: count + 1]) for count in range(len(sizes))]
    jobs = [Job(PLAN.key, stop - size, stop) for stop, size in zip(stops, sizes, strict=True)]
    order = data.draw(st.permutations(jobs))
    early = data.draw(st.integers(0, len(jobs)))
    for job in order[:early]:
        commit(store, job.start, job.stop)
    digest, snapshot = store.digest(), Snapshot.of(store.parts())
    for job in order[early:]:
        commit(store, job.start, job.stop)
    then = store.as_of(Snapshot.model_validate_json(snapshot.model_dump_json()))
    assert then.digest() == digest
    assert snapshot.rollouts == sum(job.stop - job.start for job in order[:early]) == len(then.rollouts())
    assert set(then.interactions(["rollout"])["rollout"].to_pylist()) == {
        number for job in order[:early] for number in range(job.start, job.stop)
    }


def test_a_plan_is_not_confused_with_another(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store", PLAN.setting)
    commit(store, 0, 2)
    snapshot = Snapshot.of(store.parts())
    commit(store, 0, 2, version=1)
    assert {part.shard.plan_key for part in store.as_of(snapshot).parts()} == {Plan(setting=PLAN.setting).key}
