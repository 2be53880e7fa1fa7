"""Stores, runs, policies and histories of earlier versions open, and what newer software wrote is kept."""

import dataclasses
import hashlib
import json
import logging
import tarfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cluster.cli.main import run
from collector.setting import in_fidelity_of
from shared.config import CollectionConfig, Fidelity, FidelityVersion
from shared.errors import SchemaVersionError, StoreError
from shared.io.documents import with_checksum
from shared.plan import Job, Plan, RolloutStatus
from shared.store import Store, compact, export, info, merge, repair, verify
from shared.store.codecs.columns import ROLLOUT_COLUMNS, Column
from shared.store.codecs.tables import read_table
from shared.store.layout import Quarantined
from shared.store.maintenance.export import splits_by_share
from shared.store.provenance import changed_versions
from tests.support.documents import without_checksum
from tests.support.fabricate import fabricate_rollout, fabricate_rollouts, fabricate_setting

FIXTURE = Path(__file__).parents[1] / "fixtures" / "a96b627.tar.xz"
DIGESTS = {
    "run/store": "9e96c05a3ddbd81f57b9ee3472c08d0477b16da41d91d975bb66b8566257741b",
    "run/evaluation": "49e91b28fee2a62900606abbc3ca5744bb1a238f9a97ddb8c91f720df040eac4",
}
"""As that commit printed them."""
SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """What the first version under schema version 1 wrote."""
    with tarfile.open(FIXTURE) as archive:
        # Python before 3.11.4 has no filters, and ignores this.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(tmp_path / "old")  # noqa: S202 - our own file
    return tmp_path / "old"


def make(path: Path, shards: int = 2) -> Store:
    store = Store.create(path, SETTING)
    for start in range(shards):
        job = Job(PLAN.key, start, start + 1)
        store.commit(PLAN, job, fabricate_rollouts(PLAN, job, 2), {})
    return store


def contents(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def edit(file: Path, **changes: Any) -> None:
    """Seal a document with other fields, as other software would have written it."""
    file.write_bytes(with_checksum(without_checksum(file.read_bytes(), "document") | changes))


def add_column(shard: Path, file: str, name: str, values: list[Any]) -> None:
    """Add a column to a table of a shard, as newer software would have written it."""
    table = pq.read_table(shard / file)
    pq.write_table(table.append_column(name, pa.array(values)), shard / file, use_dictionary=False)
    data = (shard / file).read_bytes()
    manifest = without_checksum((shard / "manifest.json").read_bytes(), "manifest")
    manifest["files"][file] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (shard / "manifest.json").write_bytes(with_checksum(manifest))


def shards_of(store: Store) -> list[Path]:
    return [store.path / "shards" / job.shard_id for job in store.jobs()]


@pytest.mark.parametrize("name", DIGESTS)
def test_a_store_of_the_first_version_opens_and_is_what_it_was(old: Path, tmp_path: Path, name: str) -> None:
    store = Store.open(old / name)
    assert store.digest() == DIGESTS[name]
    assert verify(store) == []
    assert info(store).rollouts == len(store.rollouts())
    before = contents(old / name)
    assert not repair(store.where)[1].problems
    assert {path: data for path, data in contents(old / name).items() if ".lock-" not in path} == before
    assert merge([store], tmp_path / "merged")[0].digest() == DIGESTS[name]
    compact(store, 64)
    assert store.digest() == DIGESTS[name]


def test_copies_leave_out_what_older_software_said_of_machines(tmp_path: Path) -> None:
    one, other = make(tmp_path / "one", 1), Store.create(tmp_path / "other", SETTING)
    one.commit(PLAN, Job(PLAN.key, 1, 3), fabricate_rollouts(PLAN, Job(PLAN.key, 1, 3), 2), {})
    # Rollout 2 is in both, so that part of this shard is written anew, and the others are copied.
    job = Job(PLAN.key, 2, 5)
    last = dataclasses.replace(fabricate_rollout(PLAN, 4, 0), status=RolloutStatus.QUARANTINED)
    reason = Quarantined(rollout=4, reason="it failed", command="")
    other.commit(PLAN, job, [*fabricate_rollouts(PLAN, Job(PLAN.key, 2, 4), 2), last], {}, [reason])
    for shard in [*shards_of(one), *shards_of(other)]:
        described = without_checksum((shard / "manifest.json").read_bytes(), "manifest")
        for each in described["quarantined"]:
            each["command"] = "adaafford store replay /home/somebody/store"
        provenance = {"host": "lab-7", "physics_s": "6.1"}
        edit(shard / "manifest.json", provenance=provenance, quarantined=described["quarantined"])
    digest = merge([one, other], tmp_path / "merged")[0].digest()
    merge([Store.open(tmp_path / "merged")], tmp_path / "again")
    compact(one, 8)
    assert [manifest.provenance.get("host") for manifest in one.manifests()] == [None]
    for name in ("merged", "again"):
        store = Store.open(tmp_path / name)
        assert verify(store) == []
        assert (store.digest(), len(store.rollouts())) == (digest, 5)
        assert [m.provenance["physics_s"] for m in store.manifests()] == ["6.1"] * 3
        assert not [path for path, data in contents(store.path).items() if b"lab-7" in data or b"somebody" in data]


def test_a_store_of_the_first_version_is_collected_into_trained_from_and_exported(
    old: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    where, toml = old / "run/store", tmp_path / "settings.toml"
    setting = Store.open(where).setting
    toml.write_text(
        "[collection.camera]\nimage_size = 64\npoints = 64\ncandidates = 64\n[collection.rollout]\ninteractions = 4\n"
    )
    objects = tmp_path / "list.txt"
    objects.write_text("".join(f"{ref.id} {ref.category}\n" for ref in setting.objects))
    flags = ["--task", "push-faucet", "--workers", "0", "--config", str(toml), "--object-list", str(objects)]
    with caplog.at_level(logging.WARNING):
        command = ["collect", "--store", str(where), "--objects", str(old / "run/objects"), "--rollouts", "8", *flags]
        assert run(command) == 0
    store = Store.open(where)
    assert len(store.rollouts()) == 10
    assert verify(store) == []
    assert store.setting.collection.fidelity == Fidelity()
    assert "begun with fidelity version 1; it goes on with that" in caplog.text
    learner = tmp_path / "learner.toml"
    learner.write_text((old / "run/training/prior/learner.toml").read_text())
    assert run(["train", "prior", "--store", str(where), "--out", str(tmp_path / "out"), "--config", str(learner)]) == 0
    assert run(["store", "export", str(where), "--out", str(tmp_path / "data")]) == 0


@pytest.mark.parametrize("version", [1, 2])
def test_only_who_asks_for_the_default_fidelity_goes_on_with_that_of_a_store(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, version: FidelityVersion
) -> None:
    default, first = CollectionConfig(), CollectionConfig(fidelity=Fidelity(version=version))
    older = SETTING.model_copy(update={"collection": first})
    other = CollectionConfig(fidelity=Fidelity(version=3, solver_iterations=30))
    for name, setting in (
        ("newer", SETTING),
        ("older", older),
        ("other", older.model_copy(update={"collection": other})),
    ):
        Store.create(tmp_path / name, setting)
    names = ("newer", "older", "other", "none")
    found = [in_fidelity_of(name, Store.begun_with(tmp_path / name), default) for name in names]
    assert found == [default, first, default, default]
    assert caplog.messages == [f"older: was begun with fidelity version {version}; it goes on with that"]
    assert in_fidelity_of("older", Store.begun_with(tmp_path / "older"), other) == other


def test_a_run_a_policy_and_a_history_of_the_first_version_open(
    old: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["status", str(old / "run")]) == 0
    assert run(["export-policy", str(old / "run"), "--out", str(tmp_path / "policy")]) == 0
    assert (tmp_path / "policy/weights.safetensors").read_bytes() == (old / "policy/weights.safetensors").read_bytes()
    capsys.readouterr()
    adapt = ["adapt", "--policy", str(old / "policy"), "--history", str(old / "history.json"), "--points", "64"]
    assert run([*adapt, "--cloud", str(old / "scan-2.npz"), "--out", str(tmp_path / "heat.npz")]) == 0
    assert json.loads(capsys.readouterr().out)["tries"] == 1


@pytest.mark.parametrize("version", [0, 5])
@pytest.mark.parametrize("place", ["store.json", "manifest.json", "index.json"])
@pytest.mark.parametrize("action", ["verify", "repair", "compact", "digest", "info", "merge", "export"])
def test_another_schema_version_is_refused_in_a_line_and_nothing_is_touched(
    action: str, place: str, version: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = make(tmp_path / "store")
    store.publish_policy(1, {"policy.json": b"{}"})
    if place == "index.json" and action not in ("verify", "repair", "merge"):
        return  # These read no policy.
    file = next(iter(sorted(store.path.rglob(place))))
    edit(file, schema_version=version)
    before = contents(store.path)
    out = ["--out", str(tmp_path / "out")] if action in ("merge", "export") else []
    assert run(["store", action, str(store.path), *out]) == 2
    said = capsys.readouterr().err
    assert f"schema version {version}" in said
    assert said.count("\n") == 1
    assert {path: data for path, data in contents(store.path).items() if ".lock-" not in path} == {
        path: data for path, data in before.items() if ".lock-" not in path
    }


def test_a_lost_description_of_a_store_of_another_version_is_not_made_anew(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    for shard in shards_of(store):
        edit(shard / "manifest.json", schema_version=5)
    (store.path / "store.json").unlink()
    before = contents(store.path)
    with pytest.raises(SchemaVersionError, match="schema version 5"):
        repair(store.path)
    assert contents(store.path) == before


def test_a_flipped_bit_in_the_version_itself_is_damage(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    file = store.path / "store.json"
    file.write_bytes(file.read_bytes().replace(b'"schema_version": 1', b'"schema_version": 5'))
    with pytest.raises(StoreError, match="names no schema version"):
        Store.open(store.path)
    assert repair(store.path)[1].made_anew == ("store.json",)


def test_what_newer_software_wrote_is_ignored_and_kept(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    digest = store.digest()
    for k, shard in enumerate(shards_of(store)):
        add_column(shard, "interactions.parquet", "finger_force", [1.5 + k, 2.5 + k])
        add_column(shard, "rollouts.parquet", "weather", [f"day {k}"])
        edit(shard / "manifest.json", more={"a": 1})
    setting = without_checksum((store.path / "store.json").read_bytes(), "store")["setting"]
    setting["collection"]["camera"]["noise"] = 0.5
    setting["objects"][0]["maker"] = "somebody"
    edit(store.path / "store.json", more=7, setting=setting)
    edit(store.path / f"plans/{PLAN.key}.json", setting=setting, why="because")
    store = Store.open(store.path)
    assert verify(store) == []
    assert store.digest() == digest
    assert not repair(store.path)[1].problems
    assert "finger_force" not in store.interactions().column_names
    with pytest.raises(StoreError, match=r"objects\[0\]\.maker: the store has somebody, given nothing"):
        Store.create(store.path, SETTING)
    merged, _ = merge([store], tmp_path / "merged")
    assert contents(merged.path)["store.json"].count(b'"more": 7') == 1
    compact(store, 9)
    for each in (store, merged):
        assert each.digest() == digest
        assert each.setting.as_document() == setting
        assert b"because" in contents(each.path)[f"plans/{PLAN.key}.json"]
        tables = [pq.read_table(shard / "interactions.parquet") for shard in shards_of(each)]
        assert [v for table in tables for v in table.column("finger_force").to_pylist()] == [1.5, 2.5, 2.5, 3.5]
        names = [pq.read_table(shard / "rollouts.parquet").column("weather").to_pylist() for shard in shards_of(each)]
        assert [name for some in names for name in some] == ["day 0", "day 1"]
        assert all(manifest.more == {"more": {"a": 1}} for manifest in each.committed())
        assert verify(each) == []
    export(store, tmp_path / "data", splits_by_share(store, 0.0, 1))
    exported = pq.read_table(tmp_path / "data/train/interactions.parquet")
    assert exported.column("finger_force").to_pylist() == [1.5, 2.5, 2.5, 3.5]
    assert json.loads((tmp_path / "data/setting.json").read_text()) == setting


def test_a_column_that_only_some_shards_have_is_kept_where_it_is(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    add_column(shards_of(store)[1], "interactions.parquet", "finger_force", [1.0, 2.0])
    export(store, tmp_path / "data", splits_by_share(store, 0.0, 1))
    compact(store, 9)
    wanted = [None, None, 1.0, 2.0]
    assert pq.read_table(shards_of(store)[0] / "interactions.parquet").column("finger_force").to_pylist() == wanted
    exported = pq.read_table(tmp_path / "data/train/interactions.parquet")
    assert exported.column("finger_force").to_pylist() == wanted
    assert verify(store) == []


def test_a_column_that_was_added_later_has_its_default_in_older_shards(tmp_path: Path) -> None:
    shard = shards_of(make(tmp_path / "store", 1))[0]
    added: tuple[Column[Any], ...] = (
        Column("weather", "", 0, "for this test", lambda _: "rain", content=False, default="unknown"),
        Column("wind", "<f8", 3, "for this test", lambda _: [0.0] * 3, content=False, default=(1.0, 2.0, 3.0)),
    )
    columns: Any = (*ROLLOUT_COLUMNS, *added)
    table = read_table((shard / "rollouts.parquet").read_bytes(), columns, 1, "table")
    assert table.column("weather").to_pylist() == ["unknown"]
    assert table.column("wind").to_pylist() == [[1.0, 2.0, 3.0]]
    assert table.schema.names == [column.name for column in columns]
    add_column(shard, "rollouts.parquet", "weather", [None])
    (shard / "rollouts.parquet").write_bytes(
        _with_nulls(shard / "rollouts.parquet", "weather", pa.string(), tmp_path / "nulls")
    )
    table = read_table((shard / "rollouts.parquet").read_bytes(), columns, 1, "table", ["weather"])
    assert table.column("weather").to_pylist() == ["unknown"], "as where shards with and without it were compacted"
    with pytest.raises(AssertionError, match="must be no content"):
        Column("weather", "", 0, "for this test", lambda _: "rain", default="unknown")


def _with_nulls(file: Path, name: str, kind: Any, out: Path) -> bytes:
    table = pq.read_table(file).drop_columns([name])
    pq.write_table(table.append_column(name, pa.nulls(len(table), kind)), out, use_dictionary=False)
    return out.read_bytes()


def test_a_store_says_which_software_began_it_and_what_differs(tmp_path: Path) -> None:
    store = make(tmp_path / "store")
    software = store.document.software
    assert len(software["schema"]) == 16
    assert changed_versions(software) == ""
    edit(store.path / "store.json", software=software | {"numpy": "0.1", "git_commit": "0" * 40})
    assert changed_versions(Store.open(store.path).document.software) == f"numpy 0.1 (now {software['numpy']})"
