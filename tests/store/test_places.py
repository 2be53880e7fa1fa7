"""Laws of a place, held by every implementation, and a store on each of them: the same content, the same digest."""

import dataclasses
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cluster.cli.main import run
from learner.data.dataset import load_dataset
from shared.errors import StoreError, UsageError
from shared.networks.network_config import NetworkConfig
from shared.plan import Job, Plan, RolloutRecord
from shared.store import Store, check_place, info, verify
from shared.store.backends.base import StorageBackend, Transaction, backend_of
from shared.store.backends.local import LocalBackend
from shared.store.backends.s3 import S3Backend
from tests.support.fabricate import fabricate_rollouts, fabricate_setting, identical

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)
JOB = Job(PLAN.key, 0, 2)


@pytest.fixture
def place(where: str) -> StorageBackend:
    if "://" not in where:
        Path(where).mkdir()
    return backend_of(where)


def publication(files: dict[str, bytes], folder: str = "shards/a") -> Transaction:
    def describe(held: object) -> bytes:
        return repr(sorted(dict(held).items())).encode()  # type: ignore[call-overload]

    return Transaction(folder, files, "mark.json", describe, check=lambda: None, lock="lock")


def test_what_is_created_is_there_once(place: StorageBackend) -> None:
    assert not place.exists("plans/a.json")
    assert place.create("plans/a.json", b"first")
    assert not place.create("plans/a.json", b"second")
    assert place.read("plans/a.json", 5) == b"first"
    assert list(place.exist(["plans/a.json", "plans/b.json"])) == [True, False]
    assert list(place.read_all([("plans/a.json", 9)] * 3)) == [b"first"] * 3


def test_reading_is_bounded_and_says_what_is_missing(place: StorageBackend) -> None:
    place.create("a", b"12345")
    with pytest.raises(StoreError, match=r"/a: larger than the 4 bytes"):
        place.read("a", 4)
    with pytest.raises(StoreError, match=r"/b: .*restore"):
        place.read("b", 4)


def test_names_and_leaves_are_those_of_a_folder(place: StorageBackend) -> None:
    for key in ("top", "shards/b/x", "shards/b/deep/y", "shards/a", "shards2/z"):
        place.create(key, b"")
    assert place.names("") == ["shards", "shards2", "top"]
    assert place.names("shards") == ["a", "b"]
    assert place.names("nothing") == []
    assert place.leaves("shards") == ["shards/a", "shards/b/deep/y", "shards/b/x"]
    assert place.leaves("nothing") == []


def test_names_from_one_on_come_in_order(place: StorageBackend) -> None:
    for name in "abcd":
        place.publish(publication({"x/y": b"1", "z": b"2"}, f"shards/{name}1"))
    assert list(place.names_from("shards", "b")) == ["b1", "c1", "d1"]
    assert list(place.names_from("shards", "b2")) == ["c1", "d1"]
    assert list(place.names_from("shards", "e")) == []


def test_more_names_than_one_page_are_listed(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.store.backends.s3.PAGE", 3)
    place = backend_of(s3_url)
    for k in range(10):
        place.create(f"shards/{k}", b"")
    assert len(place.leaves("shards")) == len(place.names("shards")) == 10


def test_what_tells_of_the_moment_is_replaced_and_removed(place: StorageBackend) -> None:
    for content in (b"first", b"", b"third and longer"):
        place.replace("status/a.json", content)
        assert place.read("status/a.json", 99) == content
    assert place.names("status") == ["a.json"]
    for _ in range(2):
        place.remove("status/a.json")
        assert not place.exists("status/a.json")


def test_the_first_publisher_wins(place: StorageBackend) -> None:
    assert place.publish(publication({"x": b"1", "d/y": b"2"}))
    assert not place.publish(publication({"x": b"1", "d/y": b"2"}))
    assert place.leaves("shards/a") == ["shards/a/d/y", "shards/a/mark.json", "shards/a/x"]
    assert place.read("shards/a/mark.json", 99) == b"[('d/y', b'2'), ('x', b'1')]"


def test_a_publisher_takes_over_or_replaces_what_a_dead_one_left(place: StorageBackend) -> None:
    place.create("shards/a/x", b"of the dead")
    assert place.publish(publication({"x": b"1", "y": b"2"}))
    held = place.read("shards/a/x", 99)
    assert held == (b"of the dead" if place.writes_in_place else b"1")
    assert place.read("shards/a/mark.json", 99) == repr([("x", held), ("y", b"2")]).encode()


def test_moving_a_folder_moves_everything_in_it_and_can_be_repeated(place: StorageBackend) -> None:
    place.publish(publication({"x": b"1", "d/y": b"2"}))
    for _ in range(2):
        place.move("shards/a", "aside/a")
        assert place.leaves("shards/a") == []
        assert place.leaves("aside") == ["aside/a/d/y", "aside/a/mark.json", "aside/a/x"]


def test_a_store_is_the_same_wherever_it_lies(where: str, tmp_path: Path) -> None:
    whole = Store.create(tmp_path / "whole", SETTING)
    whole.commit(PLAN, Job(PLAN.key, 0, 5), fabricate_rollouts(PLAN, Job(PLAN.key, 0, 5)), {})
    store = Store.create(where, SETTING)
    for job in (JOB, Job(PLAN.key, 2, 5), JOB):
        manifest = store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
        assert identical(Store.open(where).read_rollouts(manifest.shard_id), tuple(fabricate_rollouts(PLAN, job)))
    store.publish_policy(1, {"weights.safetensors": bytes(999), "policy.json": b"{}"})
    store.publish_policy(1, {"weights.safetensors": bytes(999), "policy.json": b"{}"})
    with pytest.raises(StoreError, match="exists with other content"):
        store.publish_policy(1, {"policy.json": b"{}"})
    assert store.policy_versions() == (1,)
    assert store.read_policy(1)["policy.json"] == b"{}"
    assert store.digest() == whole.digest()
    assert store.interactions(["motion"]).column("motion") == whole.interactions(["motion"]).column("motion")
    assert info(store).rollouts == 5
    assert store.plans() == (PLAN,)
    assert verify(store) == []
    for clash in (Job(PLAN.key, 1, 3), Job(PLAN.key, 4, 6)):
        with pytest.raises(StoreError, match="overlaps"):
            store.commit(PLAN, clash, fabricate_rollouts(PLAN, clash), {})
    with pytest.raises(StoreError, match="seed: the store has 7, given 8"):
        Store.create(where, fabricate_setting(seed=8))


def slower(rollouts: list[RolloutRecord]) -> list[RolloutRecord]:
    """The same rollouts, as another worker would have timed them."""
    return [
        dataclasses.replace(r, interactions=tuple(dataclasses.replace(i, seconds=9.0) for i in r.interactions))
        for r in rollouts
    ]


def test_writers_of_the_same_shard_at_once_do_no_harm(where: str) -> None:
    store = Store.create(where, SETTING)
    rollouts = fabricate_rollouts(PLAN, JOB)
    with ThreadPoolExecutor(4) as pool:
        writers = [
            pool.submit(Store.open(where).commit, PLAN, JOB, (rollouts, slower(rollouts))[k % 2], {}) for k in range(6)
        ]
        manifests = [writer.result() for writer in writers]
    assert manifests == store.committed() * 6
    assert verify(store) == []


def test_a_half_written_shard_of_the_same_content_is_finished(s3_url: str) -> None:
    store = Store.create(s3_url, SETTING)
    other = Store.create(f"{s3_url}-other", SETTING)
    shard = other.commit(PLAN, JOB, slower(fabricate_rollouts(PLAN, JOB)), {}).shard_id
    for name in ("interactions.parquet", "observations.zarr/zarr.json"):
        store.backend.create(f"shards/{shard}/{name}", other.backend.read(f"shards/{shard}/{name}", 1 << 20))
    assert store.committed() == []
    assert verify(store) == [], "somebody may be writing it"
    store.commit(PLAN, JOB, fabricate_rollouts(PLAN, JOB), {})
    assert verify(store) == []
    assert store.digest() == other.digest()


def test_a_half_written_shard_of_other_content_is_refused(s3_url: str) -> None:
    store = Store.create(s3_url, SETTING)
    store.backend.create(f"shards/{JOB.shard_id}/rollouts.parquet", b"something else")
    with pytest.raises(StoreError, match=r"store repair|cannot be decoded"):
        store.commit(PLAN, JOB, fabricate_rollouts(PLAN, JOB), {})
    assert store.committed() == []


def test_a_learner_reads_from_a_bucket(s3_url: str, tmp_path: Path) -> None:
    setting = fabricate_setting(points=64)
    plan = Plan(setting=setting)
    clouds = []
    for where in (s3_url, tmp_path / "store"):
        store = Store.create(where, setting)
        store.commit(plan, JOB, fabricate_rollouts(plan, JOB), {})
        clouds.append(load_dataset(store, NetworkConfig()))
    assert clouds[0].objects == clouds[1].objects


@pytest.mark.parametrize("command", [["info"], ["verify"], ["digest"]])
def test_commands_take_urls(s3_url: str, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    store = Store.create(s3_url, SETTING)
    store.commit(PLAN, JOB, fabricate_rollouts(PLAN, JOB), {})
    assert run(["store", *command, s3_url]) == 0
    out = capsys.readouterr().out
    assert {"info": s3_url, "verify": "no problems", "digest": store.digest()}[command[0]] in out


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("s3://key:secret@bucket/x", "a URL may hold no credentials"),
        ("s3://", "no place for a store"),
        ("s3://bucket/../x", "no place for a store"),
        ("s3://bucket/a//b", "no place for a store"),
        ("s3://bucket/x?versionId=1", "no place for a store"),
        ("gs://bucket/x", "no place for a store"),
        ("http://127.0.0.1/x", "no place for a store"),
    ],
)
def test_urls_that_are_not_allowed_are_refused(url: str, message: str, s3_url: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        Store.open(url)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


def test_credentials_come_from_the_environment_alone(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    with pytest.raises(UsageError, match="no credentials; set AWS_ACCESS_KEY_ID"):
        Store.open(s3_url)


def test_what_is_missing_in_a_bucket_is_said_in_one_line(s3_url: str) -> None:
    for url, message in ((s3_url, "is no store"), ("s3://no-such-bucket/x", "there is no such bucket")):
        with pytest.raises(StoreError, match=message) as caught:
            Store.open(url)
        assert not re.search(r"\n", str(caught.value))


def test_a_server_that_fails_is_asked_again(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.store.backends.s3.MAX_RETRIES", 1)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StoreError, match=r"check the network and the AWS_\* variables") as caught:
        Store.open(s3_url)
    assert "\n" not in str(caught.value)


def test_a_bucket_place_needs_no_locks(s3_url: str) -> None:
    place = S3Backend.of(s3_url)
    with place.only_one("driver"), place.only_one("driver"):
        assert place.sweep(["", "shards"]) == 0


def test_one_of_several_writers_wins_and_the_check_leaves_nothing_behind(place: StorageBackend) -> None:
    check_place(place, writers=16, rounds=5)
    assert place.leaves("") == []


class ForgetsTheCondition(LocalBackend):
    def create(self, key: str, data: bytes) -> bool:
        self.replace(key, data)
        return True


class LooksAndThenWrites(LocalBackend):
    """As servers do that read the condition, take the data, and write: with writers that all look before one writes."""

    looked = threading.Barrier(4)

    def create(self, key: str, data: bytes) -> bool:
        found = self.exists(key)
        if not found:
            self.looked.wait()
            self.replace(key, data)
        return not found


class KeepsTheLast(LocalBackend):
    """Tells one writer that it won, and keeps what another wrote."""

    def create(self, key: str, data: bytes) -> bool:
        won = super().create(key, data)
        if data[:1] == b"\x03":
            self.replace(key, b"of another" * 10)
        return won


class ListsLate(LocalBackend):
    def names(self, folder: str) -> list[str]:
        return []


class RemovesLater(LocalBackend):
    def remove(self, key: str) -> None:
        return


class LosesAll(LocalBackend):
    def create(self, key: str, data: bytes) -> bool:
        super().create(key, data)
        return False


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (ForgetsTheCondition, "4 of 4 concurrent writers of one new file were told that they made it"),
        (LooksAndThenWrites, "4 of 4 concurrent writers"),
        (LosesAll, "0 of 4 concurrent writers"),
        (KeepsTheLast, "does not hold what its one successful writer wrote"),
        (ListsLate, "not listed directly after it was written"),
        (RemovesLater, "still there after it was removed"),
    ],
)
def test_a_place_that_breaks_a_promise_is_found_out(
    kind: Callable[[Path], LocalBackend], what: str, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match=f"{what}.*a bucket needs a server that obeys"):
        check_place(kind(tmp_path), writers=4)


def test_no_store_is_created_in_a_bucket_where_every_writer_wins(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def forgets(self: S3Backend, key: str, data: bytes) -> bool:
        self.replace(key, data)
        return True

    monkeypatch.setattr(S3Backend, "create", forgets)
    with pytest.raises(StoreError, match=r"8 of 8 concurrent writers .* could lose data"):
        Store.create(s3_url, SETTING)
    assert backend_of(s3_url).leaves("") == []


def test_check_place_prints_a_line(where: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "://" not in where:
        assert run(["store", "check-place", where]) == 2
        assert "there is no such folder" in capsys.readouterr().err
        Path(where).mkdir()
    assert run(["store", "check-place", where, "--rounds", "2"]) == 0
    assert capsys.readouterr().out == f"{where}: no problems in 2 rounds of 16 concurrent writers\n"


@pytest.mark.parametrize(("flag", "allowed"), [("--writers", "2 to 64"), ("--rounds", "1 to 10000")])
@pytest.mark.parametrize("given", ["0", "-1", "1000000"])
def test_check_place_refuses_numbers_out_of_bounds(
    flag: str, allowed: str, given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["store", "check-place", str(tmp_path), flag, given]) != 0
    assert capsys.readouterr().err == f"adaafford: {flag} {given}: allowed: {allowed}\n"
