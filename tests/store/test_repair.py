"""Stores that were damaged at random: all that changes data is found, and a repair leaves a store that verifies."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run
from shared.errors import AdaAffordError, StoreError
from shared.plan import Plan, missing_jobs
from shared.store import Store, repair, verify
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

SETTING = fabricate_setting()
PLANS = (Plan(setting=SETTING), Plan(setting=SETTING, proposer="aip", policy_version=1))
"""Of the second one, half as much is collected."""
ROLLOUTS, PER_SHARD, TRIES = 2, 1, 1


def fill(store: Store) -> None:
    """Collect what is missing."""
    for plan in PLANS:
        done = [(manifest.start, manifest.stop) for manifest in store.committed(plan.key)]
        for job in missing_jobs(plan.key, ROLLOUTS - plan.policy_version, done, PER_SHARD):
            store.commit(plan, job, fabricate_rollouts(plan, job, TRIES), {})


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound store of two plans, three shards and a policy."""
    store = Store.create(tmp_path_factory.mktemp("original") / "store", SETTING)
    fill(store)
    store.publish_policy(1, {"weights.safetensors": bytes(1000), "policy.json": b"{}"})
    assert verify(store) == []
    return store.path


def files_of(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith(".lock-"))


def damage(path: Path, rng: np.random.Generator) -> str:
    """Change the store's files in one way; returns which, "" if all bytes stayed the same."""
    files = files_of(path)
    one, other = (files[k] for k in rng.choice(len(files), 2, replace=False))
    before = one.read_bytes()
    match rng.choice(["flip", "cut", "delete", "swap"]):
        case "flip":
            data = bytearray(before)
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            one.write_bytes(data)
            return f"flip in {one}"
        case "cut":
            one.write_bytes(before[: int(rng.integers(len(before)))])
            return f"cut of {one}"
        case "delete":
            one.unlink()
            return f"delete of {one}"
    if before == other.read_bytes():
        return ""
    one.rename(path / "hold")
    other.rename(one)
    (path / "hold").rename(other)
    return f"swap of {one} and {other}"


def found_in(path: Path) -> bool:
    """Whether opening or verifying says that something is wrong."""
    try:
        return bool(verify(Store.open(path)))
    except StoreError as error:
        assert "\n" not in str(error)
        return True


def ruin_and_repair(original: Path, path: Path, rng: np.random.Generator) -> bool:
    """One case; returns whether it changed anything."""
    sound = Store.open(original)
    shutil.copytree(original, path)
    what = damage(path, rng)
    assert found_in(path) == bool(what), what
    files = len(files_of(path))
    try:
        store, done = repair(path)
    except AdaAffordError as error:
        raise AssertionError(what) from error
    assert len(files_of(path)) >= files, "nothing is ever deleted"
    assert bool(done.problems or done.made_anew) == bool(what), what
    again = repair(path)[1]
    assert not (again.problems or again.set_aside or again.made_anew), what
    fill(store)
    assert store.digest() == sound.digest(), what
    return bool(what)


def ruin_many(original: Path, folder: Path, cases: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    changed = 0
    for case in range(cases):
        changed += ruin_and_repair(original, folder / str(case), rng)
        shutil.rmtree(folder / str(case))
    print(f"{cases} damaged stores, {changed} with changed data: all found, all repaired")


@pytest.mark.slow
def test_random_damage_is_found_and_repaired(original: Path, tmp_path: Path) -> None:
    ruin_many(original, tmp_path, 10, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_random_damage_is_found_and_repaired_a_thousand_times(original: Path, tmp_path: Path) -> None:
    ruin_many(original, tmp_path, 1000, seed=2)


def test_a_sound_store_is_left_alone(original: Path, tmp_path: Path) -> None:
    shutil.copytree(original, tmp_path / "store")
    before = {p: p.read_bytes() for p in files_of(tmp_path / "store")}
    _, done = repair(tmp_path / "store")
    assert not (done.problems or done.set_aside or done.made_anew or done.to_collect or done.lost_policies)
    assert before == {p: p.read_bytes() for p in files_of(tmp_path / "store")}


def test_repair_says_what_to_collect_again(original: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "store"
    shutil.copytree(original, path)
    (path / "shards" / "random-v0-00000001-00000002" / "rollouts.parquet").write_bytes(b"x")
    assert run(["store", "verify", str(path)]) == 1
    capsys.readouterr()
    assert run(["store", "repair", str(path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["to_collect"] == ["random-v0-00000001-00000002"]
    assert said["set_aside"] == ["shards/random-v0-00000001-00000002"]
    assert said["commands"] == [f"adaafford store replay {path} random-v0-00000001-00000002 --objects OBJECTS"]
    assert (path / "aside" / "shards" / "random-v0-00000001-00000002" / "manifest.json").exists()
    assert run(["store", "repair", str(path)]) == 0
    assert "nothing to repair" in capsys.readouterr().out


def test_a_lost_policy_is_noted_and_its_shards_stay(original: Path, tmp_path: Path) -> None:
    path = tmp_path / "store"
    shutil.copytree(original, path)
    shutil.rmtree(path / "policies")
    store, done = repair(path)
    assert done.lost_policies == (1,)
    assert done.set_aside == ()
    assert verify(store) == []
    assert store.digest() == Store.open(original).digest()


def test_nothing_is_repaired_where_nothing_tells_the_setting(tmp_path: Path) -> None:
    Store.create(tmp_path, SETTING)
    (tmp_path / "store.json").write_bytes(b"x")
    with pytest.raises(StoreError, match=r"store\.json"):
        repair(tmp_path)
    assert (tmp_path / "store.json").read_bytes() == b"x"


@pytest.mark.slow
def test_a_bucket_is_repaired_too(s3_url: str) -> None:
    store = Store.create(s3_url, SETTING)
    fill(store)
    store.publish_policy(1, {"policy.json": b"{}"})
    digest = store.digest()
    broken = [f"shards/{plan.key}-00000000-00000001" for plan in PLANS]
    store.backend.move(f"{broken[0]}/rollouts.parquet", "aside/rollouts.parquet")
    store.backend.move(f"{broken[1]}/manifest.json", "aside/manifest.json")
    store.backend.create(f"{broken[0]}/rollouts.parquet", b"something else")
    assert [problem.where for problem in verify(store)] == [f"{broken[0]}/rollouts.parquet"]
    repaired, done = repair(s3_url)
    assert sorted(done.set_aside) == sorted(broken)
    assert verify(repaired) == []
    fill(repaired)
    assert repaired.digest() == digest
    assert verify(repaired) == []
