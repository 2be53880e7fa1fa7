"""Collection that follows a learner: every number once, under the newest policy, whatever is killed and resumed."""

import itertools
import threading
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.commands.collect import CollectCommand
from cluster.cli.main import run
from cluster.collection.driver import LatestPolicy, collect
from cluster.collection.status_writer import read_status
from cluster.workers.job_queue import LOOK_S, PolicySource, RolloutQueue
from cluster.workers.worker_group import SerialWorkerGroup
from collector.job_result import JobResult
from collector.watchdog import UnderWay
from shared.errors import WorkerError
from shared.plan import Job, Plan, missing_ranges
from shared.store import Store, verify
from tests.support.fabricate import fabricate_rollout, fabricate_setting

OBJECTS = Path("objects")
SETTING = fabricate_setting()
PER_SHARD = 2


def plan_of(version: int) -> Plan:
    return Plan(setting=SETTING, proposer="aip", policy_version=version)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.create(tmp_path / "store", SETTING)


def publish(store: Store, version: int) -> None:
    store.publish_policy(version, {"weights.safetensors": b"weights %d" % version})


class LearningWorker:
    """Commits rollouts out of thin air, and publishes policies as a learner would, after so many shards."""

    def __init__(self, store: Store, publishes: Mapping[int, int], breaks_at: int | None = None) -> None:
        self.store, self.publishes, self.breaks_at = store, publishes, breaks_at
        self.shards = 0

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        assert files["weights.safetensors"] == b"weights %d" % version

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> JobResult:
        if self.shards == self.breaks_at:
            raise RuntimeError("killed")
        records = [fabricate_rollout(plan, index) for index in range(job.start, job.stop)]
        self.store.commit(plan, job, records, {})
        self.shards += 1
        if self.shards in self.publishes:
            publish(self.store, self.publishes[self.shards])
        return JobResult(job.shard_id, len(records), 0, 0, {}, {"total": 0.5})


def fill(
    store: Store, rollouts: int, plan: LatestPolicy, publishes: Mapping[int, int], breaks_at: int | None = None
) -> None:
    worker = LearningWorker(store, publishes, breaks_at)
    collect(store, plan, rollouts, PER_SHARD, lambda: SerialWorkerGroup(lambda: worker), OBJECTS)


def held(store: Store) -> dict[int, list[int]]:
    """Rollouts of each version."""
    found: dict[int, list[int]] = {}
    for shard in store.committed():
        found.setdefault(int(shard.plan_key.removeprefix("aip-v")), []).extend(range(shard.start, shard.stop))
    return {version: sorted(numbers) for version, numbers in sorted(found.items())}


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """New policies are seen at once, as though shards took long."""
    monkeypatch.setattr("cluster.workers.job_queue.LOOK_S", 0.0)


@pytest.mark.usefixtures("at_once")
def test_new_versions_are_taken_up_without_a_stop(store: Store) -> None:
    publish(store, 1)
    fill(store, 10, LatestPolicy(), {2: 2, 3: 3})
    assert held(store) == {1: [0, 1, 2, 3], 2: [4, 5], 3: [6, 7, 8, 9]}
    assert verify(store) == []
    rows = store.interactions(["rollout", "policy_version"]).to_pydict()
    assert {(r, v) for r, v in zip(rows["rollout"], rows["policy_version"], strict=True)} == {
        (number, version) for version, numbers in held(store).items() for number in numbers
    }


@pytest.mark.usefixtures("at_once")
def test_a_stopped_one_goes_on_with_the_newest_and_does_nothing_twice(store: Store) -> None:
    publish(store, 1)
    with pytest.raises(WorkerError):
        fill(store, 8, LatestPolicy(), {}, breaks_at=2)
    publish(store, 2)
    fill(store, 8, LatestPolicy(), {})
    assert held(store) == {1: [0, 1, 2, 3], 2: [4, 5, 6, 7]}
    digest = store.digest()
    fill(store, 8, LatestPolicy(), {})
    assert store.digest() == digest


@pytest.mark.usefixtures("at_once")
def test_rounds_wait_for_the_next_version(store: Store) -> None:
    publish(store, 1)
    learner = threading.Timer(1.0, publish, (store, 2))
    learner.start()
    fill(store, 7, LatestPolicy(per_version=5), {})
    learner.join()
    assert held(store) == {1: [0, 1, 2, 3, 4], 2: [5, 6]}


@pytest.mark.usefixtures("at_once")
def test_rounds_are_the_same_whenever_they_are_stopped(store: Store, tmp_path: Path) -> None:
    whole = Store.create(tmp_path / "whole", SETTING)
    for each in (store, whole):
        publish(each, 1)
    fill(whole, 6, LatestPolicy(per_version=3), {2: 2})
    with pytest.raises(WorkerError):
        fill(store, 6, LatestPolicy(per_version=3), {}, breaks_at=1)
    fill(store, 6, LatestPolicy(per_version=3), {1: 2})
    assert store.digest() == whole.digest()


def test_the_first_policy_is_waited_for(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    def publish_when_waited_for() -> None:
        while (status := read_status(store.backend)) is None or status.state != "waiting":
            time.sleep(0.02)
        publish(store, 1)

    learner = threading.Thread(target=publish_when_waited_for, daemon=True)
    learner.start()
    fill(store, 2, LatestPolicy(), {})
    learner.join()
    assert held(store) == {1: [0, 1]}
    assert "waiting" in capsys.readouterr().err


@given(
    done=st.lists(st.tuples(st.integers(0, 40), st.integers(1, 9)).map(lambda t: (t[0], t[0] + t[1]))),
    switches=st.lists(st.integers(1, 5), max_size=6),
    per_shard=st.integers(1, 7),
    per_plan=st.none() | st.integers(1, 9),
)
def test_each_number_is_handed_out_once_in_jobs_of_one_plan(
    done: list[tuple[int, int]], switches: list[int], per_shard: int, per_plan: int | None
) -> None:
    first = (version for version, times in enumerate(switches, 1) for _ in range(times))
    versions = itertools.chain(first, itertools.count(len(switches) + 1))
    queue = RolloutQueue(lambda: plan_of(next(versions)), missing_ranges(40, done), per_shard, per_plan)
    taken = []
    while not queue.ended:
        planned = queue.take()
        if planned is not None:
            taken.append(planned)
    numbers = [number for planned in taken for number in range(planned.job.start, planned.job.stop)]
    assert sorted(numbers) == sorted(set(range(40)) - {n for low, high in done for n in range(low, high)})
    assert len(numbers) == len(set(numbers))
    assert all(planned.job.plan_key == planned.plan.key for planned in taken)
    assert all(planned.job.stop - planned.job.start <= per_shard for planned in taken)
    made = Counter(planned.plan.key for planned in taken for _ in range(planned.job.start, planned.job.stop))
    assert per_plan is None or max(made.values(), default=0) <= per_plan


def test_a_new_policy_takes_effect_within_the_bound_and_versions_never_go_back(store: Store) -> None:
    now = 0.0
    announced: list[int] = []
    policy_source = PolicySource(store, "aip", None, lambda plan: announced.append(plan.policy_version), lambda: now)
    assert policy_source() is None
    publish(store, 2)
    publish(store, 1)
    now += LOOK_S
    assert policy_source() == plan_of(2)
    publish(store, 3)
    assert policy_source() == plan_of(2)
    now += LOOK_S
    assert policy_source() == plan_of(3)
    assert announced == [2, 3]


@pytest.mark.usefixtures("at_once")
def test_the_driver_writes_down_how_it_stands(store: Store) -> None:
    publish(store, 1)
    with pytest.raises(WorkerError):
        fill(store, 8, LatestPolicy(), {}, breaks_at=2)
    status = read_status(store.backend)
    assert status is not None
    assert (status.state, status.title, status.policy) == ("stopped", "aip-latest", 1)
    assert (status.done, status.total, status.left) == (4, 8, 4)
    assert status.restarts == 3
    assert not status.is_alive(status.written)
    fill(store, 8, LatestPolicy(), {})
    status = read_status(store.backend)
    assert status is not None and (status.state, status.done, status.rollouts) == ("done", 8, 4)
    assert verify(store) == []


@pytest.mark.parametrize(
    ("flags", "policy"),
    [
        (["--proposer", "aip", "--policy", "2"], 2),
        (["--proposer", "aip", "--policy", "latest"], "latest"),
        (["--proposer", "aip", "--policy", "latest", "--per-version", "5"], "latest"),
        ([], 0),
    ],
)
def test_a_policy_is_a_version_or_the_latest(
    flags: list[str], policy: int | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    understood: list[CollectCommand] = []
    monkeypatch.setattr("cluster.cli.commands.collect.run_collection", understood.append)
    assert run(["collect", "--store", "S", *flags]) == 0
    assert understood[0].policy == policy


@pytest.mark.parametrize(
    "flags",
    [
        ["--proposer", "aip"],
        ["--policy", "latest"],
        ["--proposer", "aip", "--policy", "-1"],
        ["--proposer", "aip", "--policy", "2", "--per-version", "5"],
        ["--per-version", "5"],
        ["--proposer", "aip", "--policy", "latest", "--per-version", "0"],
    ],
)
def test_policies_that_make_no_sense_are_refused_in_one_line(
    flags: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["collect", "--store", "S", *flags]) == 2
    assert capsys.readouterr().err.count("\n") == 1
