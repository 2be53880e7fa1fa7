"""Errors of a disk, a network or a server in reading a store: they end the command, and nothing is set aside or lost.

Every error at every step is for the exhaustive tests; otherwise each command meets errors at some of its steps.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from cluster.cli.main import run
from learner.data.dataset import load_dataset
from shared.errors import AdaAffordError, UnreadableError
from shared.networks.network_config import NetworkConfig
from shared.plan import Job, Plan
from shared.store import Store, compact, export, info, merge, repair, verify
from shared.store.backends.base import is_url
from shared.store.maintenance.export import splits_by_share
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.faults import (
    BUCKET_READ_CALLS,
    BUCKET_READ_FAULTS,
    DISK_READ_FAULTS,
    Fault,
    bucket_faults,
    disk_read_faults,
)

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING, proposer="aip", policy_version=1)
NETWORK = NetworkConfig(
    centres=(8,), radii=(0.5,), neighbours=2, abstraction=((8,),), propagation=((8,),), feature_width=8
)


def make(where: str) -> Store:
    """A sound store of two shards and a policy."""
    store = Store.create(where, SETTING)
    for start in (0, 1):
        job = Job(PLAN.key, start, start + 1)
        store.commit(PLAN, job, fabricate_rollouts(PLAN, job, 1), {})
    store.publish_policy(1, {"weights.safetensors": bytes(99), "policy.json": b"{}"})
    return store


def do_verify(where: str, _: Path) -> None:
    assert verify(Store.open(where)) == []


def do_repair(where: str, _: Path) -> None:
    done = repair(where)[1]
    assert not (done.problems or done.set_aside or done.made_anew or done.to_collect or done.lost_policies)


def do_merge(where: str, out: Path) -> None:
    store = Store.open(where)
    assert merge([store], out / "merged")[0].digest() == store.digest()


def do_export(where: str, out: Path) -> None:
    store = Store.open(where)
    done = export(store, out / "exported", splits_by_share(store, 0.0, 1))
    assert done.splits["train"].interactions == 2


def do_info(where: str, _: Path) -> None:
    assert info(Store.open(where)).rollouts == 2


def do_learn(where: str, _: Path) -> None:
    assert len(load_dataset(Store.open(where), NETWORK).rows) == 2


COMMANDS: dict[str, Callable[[str, Path], object]] = {
    "verify": do_verify,
    "repair": do_repair,
    "compact": lambda where, _: compact(Store.open(where), 9),
    "merge": do_merge,
    "export": do_export,
    "info": do_info,
    "digest": lambda where, _: Store.open(where).digest(),
    "learn": do_learn,
}


def faults_of(where: str, fault: Fault) -> AbstractContextManager[list[str]]:
    return bucket_faults(fault, BUCKET_READ_CALLS) if is_url(where) else disk_read_faults(fault, where)


def disturb(name: str, where: str, digest: str, fault: Fault, out: Path) -> tuple[int, bool]:
    """A command on a sound store, and a fault in its reading; returns how many steps it had, and if it failed."""
    failed = False
    with faults_of(where, fault) as steps:
        try:
            COMMANDS[name](where, out)
        except AdaAffordError as error:
            failed = True
            assert fault.step, error
            assert "\n" not in str(error)
            # Locks and listings of one moment may be refused in other words; what is read never is. Where a file has
            # vanished, the message names the place and says what is not there.
            words = (where, str(out)) if fault.kind == "vanished" else ("cannot", "no such")
            assert isinstance(error, UnreadableError) or any(said in str(error) for said in words), error
        except OSError:
            failed = True  # The command line says it in one line.
    what = f"{name}, {fault.kind} at step {fault.step}: {steps[fault.step - 1 : fault.step]}"
    taken = len(steps)
    after = Store.open(where)
    assert after.digest() == digest, what
    assert verify(after) == [], what
    aside = after.backend.names("aside/shards")
    assert not aside or (name == "compact" and len(aside) <= 2), what
    assert not after.backend.names("aside/plans"), what
    shutil.rmtree(out, ignore_errors=True)
    return taken, failed


def disturb_all(
    name: str, places: Iterator[str], kinds: tuple[str, ...], out: Path, most: int | None = None
) -> tuple[int, int]:
    """Faults in the reading of a command, at each step or at a few; how many were injected, and how many ended it."""
    store = make(next(places))
    digest = store.digest()

    def place() -> str:
        """The same again, since it must be as it was after each fault; only a compaction makes another of it."""
        return make(next(places)).where if name == "compact" else store.where

    steps, _ = disturb(name, store.where, digest, Fault("none", 0), out)
    assert steps > 5
    tried = range(1, steps + 1) if most is None else sorted({1 + (steps - 1) * k // most for k in range(1, most + 1)})
    faults = [Fault(kinds[k % len(kinds)], step) for k, step in enumerate(tried)]
    ended = [disturb(name, place(), digest, fault, out)[1] for fault in faults]
    return len(ended), sum(ended)


def places_of(root: str) -> Iterator[str]:
    number = 0
    while True:
        number += 1
        yield f"{root}/{number}"


@pytest.mark.parametrize("name", COMMANDS)
def test_an_error_in_reading_ends_the_command_and_harms_nothing(name: str, tmp_path: Path) -> None:
    injected, ended = disturb_all(name, places_of(f"{tmp_path}/stores"), DISK_READ_FAULTS, tmp_path / "out", most=8)
    assert ended > injected // 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["verify", "repair", "compact", "learn"])
def test_an_error_of_a_bucket_ends_the_command_and_harms_nothing(name: str, s3_url: str, tmp_path: Path) -> None:
    _, ended = disturb_all(name, places_of(s3_url), BUCKET_READ_FAULTS, tmp_path / "out", most=3)
    assert ended


@pytest.mark.exhaustive
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", DISK_READ_FAULTS)
def test_every_error_at_every_step_of_reading_a_disk_harms_nothing(kind: str, tmp_path: Path) -> None:
    places = places_of(f"{tmp_path}/stores")
    counts = {name: disturb_all(name, places, (kind,), tmp_path / "out") for name in COMMANDS}
    print(f"{kind}: errors injected, and commands that ended: {counts}")


@pytest.mark.exhaustive
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", BUCKET_READ_FAULTS)
def test_every_error_at_every_step_of_reading_a_bucket_harms_nothing(kind: str, s3_url: str, tmp_path: Path) -> None:
    places = places_of(s3_url)
    counts = {name: disturb_all(name, places, (kind,), tmp_path / "out") for name in COMMANDS}
    print(f"{kind}: errors injected, and commands that ended: {counts}")


def test_the_commands_name_the_place_and_the_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make(str(tmp_path / "store"))
    for action in ("verify", "repair"):
        with disk_read_faults(Fault("EIO", 40), str(tmp_path / "store/shards")):
            assert run(["store", action, str(tmp_path / "store")]) == 2
        said = capsys.readouterr().err
        assert "Input/output error" in said
        assert str(tmp_path / "store/shards") in said
        assert said.count("\n") == 1


def test_a_file_that_is_missing_for_good_is_damage(tmp_path: Path) -> None:
    store = make(str(tmp_path / "store"))
    (store.path / "shards" / "aip-v1-00000000-00000001" / "rollouts.parquet").unlink()
    assert [problem.broken for problem in verify(store)] == ["shards/aip-v1-00000000-00000001"]
