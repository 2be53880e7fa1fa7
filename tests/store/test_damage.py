"""Damaged and hostile stores: every flipped bit is found, and no claim is believed before it is checked."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numcodecs.blosc import Blosc

from learner.data.dataset import load_dataset
from shared.errors import StoreError
from shared.io.documents import MAX_VALUES, canonical, parse_object, with_checksum
from shared.networks.network_config import NetworkConfig
from shared.plan import Job, Plan
from shared.store import Store, info, verify
from shared.store.codecs.columns import INTERACTION_COLUMNS, MAX_JOINT_NAMES, MAX_TEXT
from shared.store.codecs.observations import ARRAYS
from shared.store.codecs.tables import read_table
from shared.store.maintenance.repair import repair
from tests.support.documents import without_checksum
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING, proposer="aip", policy_version=1)
CLOUDS = "observations.zarr"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound store of two shards and a policy."""
    path = tmp_path_factory.mktemp("original") / "store"
    store = Store.create(path, SETTING)
    for start in (0, 2):
        job = Job(PLAN.key, start, start + 2)
        store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
    store.publish_policy(1, {"weights.safetensors": bytes(1000), "policy.json": b"{}"})
    assert verify(store) == []
    return path


@pytest.fixture
def store(original: Path, tmp_path: Path) -> Store:
    """A copy of it to damage."""
    shutil.copytree(original, tmp_path / "store")
    return Store.open(tmp_path / "store")


@pytest.fixture
def shard(store: Store) -> Path:
    """The copy's first shard."""
    return store.path / "shards" / store.committed()[0].shard_id


def forge(shard: Path, contents: dict[str, bytes], **changes: Any) -> None:
    """Put files into a shard and make its manifest vouch for them, as somebody with ill intent would."""
    manifest = without_checksum((shard / "manifest.json").read_bytes(), "manifest")
    for name, data in contents.items():
        (shard / name).write_bytes(data)
        manifest["files"][name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (shard / "manifest.json").write_bytes(with_checksum(manifest | changes))


def packed(table: Any, **options: Any) -> bytes:
    """A Parquet file of the kinds of pages that the store writes, unless the options say otherwise."""
    texts = [field.name for field in table.schema if field.type == pa.string()]
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, **({"use_dictionary": texts, "compression": "zstd"} | options))
    data: bytes = sink.getvalue().to_pybytes()
    return data


def refused(act: Callable[[], object], message: str) -> None:
    with pytest.raises(StoreError, match=message) as caught:
        act()
    assert "\n" not in str(caught.value)


def test_a_flipped_bit_is_found_wherever_it_is(store: Store) -> None:
    rng = np.random.default_rng(0)
    files = sorted(path for path in store.path.rglob("*") if path.is_file() and not path.name.startswith(".lock-"))
    files = [path for path in files if path.parent.parent != store.path / "shards" or "00000000-" in path.parent.name]
    assert len(files) > 20
    for path in files:
        sound = path.read_bytes()
        for place in (0, len(sound) - 1, int(rng.integers(len(sound)))):
            damaged = bytearray(sound)
            damaged[place] ^= 1 << int(rng.integers(8))
            path.write_bytes(damaged)
            if path.name == "store.json":
                refused(lambda: Store.open(store.path), "store.json")
            else:
                problems = verify(store)
                assert problems, f"{path}, byte {place}"
                name = str(path.relative_to(store.path))
                assert any(name.startswith(problem.where) for problem in problems), problems
        path.write_bytes(sound)
    assert verify(store) == []


def test_lost_cut_and_foreign_files_are_found(store: Store, shard: Path) -> None:
    inside = str(shard.relative_to(store.path))
    (shard / "rollouts.parquet").unlink()
    (shard / "interactions.parquet").write_bytes((shard / "interactions.parquet").read_bytes()[:-1])
    (shard / "notes.txt").write_bytes(b"x")
    (store.path / "notes.txt").write_bytes(b"x")
    (store.path / "shards" / "backup").mkdir()
    (store.path / "plans" / "aip-v2.json").write_bytes(canonical(PLAN.model_dump(mode="json")))
    (store.path / "policies" / "000001" / "extra").write_bytes(b"x")
    (store.path / "policies" / "latest").mkdir()
    assert sorted(problem.where for problem in verify(store)) == sorted(
        [
            f"{inside}/rollouts.parquet",
            f"{inside}/interactions.parquet",
            f"{inside}/notes.txt",
            "notes.txt",
            "shards/backup",
            "plans/aip-v2.json",
            "policies/000001/extra",
            "policies/latest",
        ]
    )


def test_verify_reports_progress_and_missing_plans(store: Store) -> None:
    (store.path / "plans" / "aip-v1.json").unlink()
    calls = []
    problems = verify(store, lambda done, total: calls.append((done, total)))
    assert calls == [(1, 2), (2, 2)]
    assert [problem.where for problem in problems] == ["plans/aip-v1.json"]


def test_a_shard_under_another_name_is_found(store: Store, shard: Path) -> None:
    shutil.copytree(shard, store.path / "shards" / "aip-v1-00000001-00000003")
    assert any("belongs to shard" in problem.what for problem in verify(store))
    refused(store.committed, "belongs to shard aip-v1-00000000-00000002")


def test_overlapping_shards_are_found(store: Store, tmp_path: Path) -> None:
    other = Store.create(tmp_path / "other", SETTING)
    job = Job(PLAN.key, 1, 3)
    other.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
    shutil.copytree(other.path / "shards" / job.shard_id, store.path / "shards" / job.shard_id)
    assert ["holds rollouts that" in problem.what for problem in verify(store)] == [True, True]


def test_rollouts_of_another_seed_are_found(store: Store, tmp_path: Path) -> None:
    setting = fabricate_setting(seed=8)
    plan = Plan(setting=setting, proposer="aip", policy_version=1)
    other = Store.create(tmp_path / "other", setting)
    job = Job(plan.key, 4, 5)
    other.commit(plan, job, fabricate_rollouts(plan, job), {})
    shutil.copytree(other.path / "shards" / job.shard_id, store.path / "shards" / job.shard_id)
    assert ["another object or seed" in problem.what for problem in verify(store)] == [True]


def test_data_swapped_for_other_valid_data_is_found_by_the_digest(store: Store, shard: Path) -> None:
    table = pq.read_table(shard / "interactions.parquet")
    flipped = [not success for success in table.column("success").to_pylist()]
    index = table.schema.get_field_index("success")
    forge(
        shard, {"interactions.parquet": packed(table.set_column(index, table.schema.field(index), pa.array(flipped)))}
    )
    assert any("not the one whose digest" in problem.what for problem in verify(store))


def test_a_frame_that_disagrees_is_found(store: Store, shard: Path) -> None:
    table = pq.read_table(shard / "interactions.parquet")
    for name in ("rotation_camera", "joint_friction", "object_category"):
        index = table.schema.get_field_index(name)
        column = table.column(index).take(pa.array([0] * len(table)))
        forge(shard, {"interactions.parquet": packed(table.set_column(index, table.schema.field(index), column))})
        assert any(f"column {name} does not agree" in problem.what for problem in verify(store))


def changed(shard: Path, name: str, value: Any, file: str = "interactions.parquet") -> bytes:
    """A table with every cell of a column replaced."""
    table = pq.read_table(shard / file)
    index = table.schema.get_field_index(name)
    field = table.schema.field(index)
    return packed(table.set_column(index, field, pa.array([value] * len(table), field.type)))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("point", [float("nan")] * 3, "column point holds a number that is not finite"),
        ("motion", float("inf"), "not finite"),
        ("motion", float("nan"), "not finite"),
        ("motion", -1.0, "motion is -1.0"),
        ("part_mass", float("nan"), "not finite"),
        ("joint_limits", [float("-inf")] * 2, "not finite"),
        ("rollout_observation", 7, "refers to observation 7 of 1"),
        ("observation", 2**31 - 1, "column observation goes from 2147483647"),
        ("point_index", -1, "column point_index goes from -1"),
        ("target_part", 200, "target part 200"),
        ("target_part", 2**31 - 1, "column target_part goes from"),
        ("outcome", "splendid", "column outcome holds 'splendid'"),
        ("order", "", "column order holds ''"),
        ("target_link", "x" * 1000, "text of 1000 characters"),
        ("object_id", "x" * 3_000_000, "text of 3000000 characters|unpacks to more than"),
        ("proposer", "a\x1b[2Jb", r"'a\\x1b\[2Jb'"),
        ("joint_names", "[" * 20_000, "not a record|recursion"),
        ("joint_names", '{"a": 1}', "joint_names is no list of names"),
        ("joint_names", "[[]]", "joint_names is no list of names"),
        ("step", 0, "steps must grow"),
    ],
)
def test_rows_that_are_no_records_are_refused(store: Store, shard: Path, name: str, value: Any, message: str) -> None:
    forge(shard, {"interactions.parquet": changed(shard, name, value)})
    refused(lambda: store.read_rollouts(shard.name), message)
    assert verify(store)


def test_tables_of_other_columns_are_refused(store: Store, shard: Path) -> None:
    table = pq.read_table(shard / "interactions.parquet").drop_columns(["motion"])
    forge(shard, {"interactions.parquet": packed(table)})
    refused(store.interactions, "has other columns")
    forge(shard, {"interactions.parquet": b"PAR1 but not really PAR1"})
    refused(lambda: info(store), "cannot be decoded")


def test_tables_of_other_length_are_refused(store: Store, shard: Path) -> None:
    forge(shard, {"interactions.parquet": packed(pq.read_table(shard / "interactions.parquet").slice(0, 3))})
    refused(store.interactions, "the manifest says 16 rows")


@pytest.mark.parametrize("name", ["../../store.json", "/etc/passwd", "observations.zarr/../x", "a\n", "extra"])
def test_paths_of_a_manifest_are_never_followed(store: Store, shard: Path, name: str) -> None:
    manifest = without_checksum((shard / "manifest.json").read_bytes(), "manifest")
    entry = manifest["files"]["rollouts.parquet"]
    forge(shard, {}, files=manifest["files"] | {name: entry})
    refused(store.committed, "lists other files")


@pytest.mark.parametrize(
    "changes",
    [
        {"interactions": 10**15},
        {"interactions": -1},
        {"observations": 10**9},
        {"points": 10**9},
        {"points": 0},
        {"stop": 10**9},
        {"digests": ["x", "y"]},
        {"plan_key": "../../x-v1"},
        {"observations": 2**16, "points": 2**14},
        {"observations": 2**11, "points": 2**14},
    ],
)
def test_absurd_manifests_are_refused(store: Store, shard: Path, changes: dict[str, Any]) -> None:
    forge(shard, {}, **changes)
    refused(lambda: store.read_observations(shard.name), "manifest.json|claim")


def test_absurd_file_sizes_are_refused(store: Store, shard: Path) -> None:
    manifest = without_checksum((shard / "manifest.json").read_bytes(), "manifest")
    manifest["files"]["rollouts.parquet"]["size"] = 10**12
    forge(shard, {}, files=manifest["files"])
    refused(store.committed, "claims 1000000000000 bytes for rollouts.parquet")


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": [10**9, 64, 3]},
        {"data_type": "float64"},
        {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [10**6, 64, 3]}}},
        {"codecs": [{"name": "bytes"}, {"name": "gzip", "configuration": {"level": 9}}]},
        {"node_type": "group"},
        {"codecs": 7},
        {"chunk_grid": []},
    ],
)
def test_absurd_zarr_metadata_are_refused(store: Store, shard: Path, changes: dict[str, Any]) -> None:
    name = f"{CLOUDS}/points/zarr.json"
    metadata = json.loads((shard / name).read_bytes())
    forge(shard, {name: json.dumps(metadata | changes).encode()})
    refused(lambda: store.read_observations(shard.name), "observations.zarr/points")


def test_chunks_that_would_unpack_to_gigabytes_are_refused(store: Store, shard: Path) -> None:
    name = f"{CLOUDS}/points/c.0.0.0"
    data = bytearray((shard / name).read_bytes())
    data[4:8] = (2**31 - 1).to_bytes(4, "little")
    forge(shard, {name: bytes(data)})
    refused(lambda: store.read_observations(shard.name), "claims another size")


@pytest.mark.parametrize("size", [0, 15, 16, 17, 2**20, 2**31 - 1, 2**32 - 1])
@pytest.mark.parametrize("name", ["points/c.0.0.0", "movable/c.0.0", "world_from_camera/c.0.0.0"])
def test_chunks_that_claim_another_packed_size_are_refused(store: Store, shard: Path, name: str, size: int) -> None:
    data = (shard / CLOUDS / name).read_bytes()
    forge(shard, {f"{CLOUDS}/{name}": data[:12] + size.to_bytes(4, "little") + data[16:]})
    refused(lambda: store.read_observations(shard.name), "claims another size")
    repair(store.path)
    assert verify(store) == []


@pytest.mark.parametrize(
    ("name", "place", "number", "message"),
    [
        ("points", 1, 0x7C00, "not finite"),
        ("world_from_camera", 0, 0x7FF0000000000000, "not finite"),
        ("world_from_camera", 0, 0x4010000000000000, "no pose of a camera"),
        ("movable", 3, 7, "neither true nor false"),
    ],
)
def test_clouds_that_are_none_are_refused(
    store: Store, shard: Path, name: str, place: int, number: int, message: str
) -> None:
    (file,) = (shard / CLOUDS / name).glob("c.*")
    kept = next(kind.kept for kind in ARRAYS if kind.name == name)
    numbers = np.frombuffer(Blosc().decode(file.read_bytes()), f"<u{np.dtype(kept).itemsize}").copy()
    numbers[place] = number
    forge(shard, {str(file.relative_to(shard)): Blosc(cname="zstd").encode(numbers)})
    refused(lambda: store.read_observations(shard.name), message)


@pytest.mark.parametrize(
    "metadata",
    [
        {"zarr_format": 3, "node_type": "array"},
        {"zarr_format": 3, "node_type": "group", "consolidated_metadata": {"metadata": {"points": {"shape": [2**60]}}}},
    ],
)
def test_a_group_that_says_more_than_a_plain_one_is_refused(store: Store, shard: Path, metadata: Any) -> None:
    forge(shard, {f"{CLOUDS}/zarr.json": json.dumps(metadata).encode()})
    refused(lambda: store.read_observations(shard.name), "not a plain group's")
    forge(shard, {f"{CLOUDS}/zarr.json": b"[" * 50_000})
    refused(lambda: store.read_observations(shard.name), "not valid JSON")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"use_dictionary": True}, "has a page in encoding"),
        ({"use_dictionary": False, "column_encoding": {"step": "DELTA_BINARY_PACKED"}}, "has a page in encoding 5"),
        ({"use_dictionary": False, "column_encoding": {"motion": "BYTE_STREAM_SPLIT"}}, "has a page in encoding 9"),
        ({"compression": "brotli"}, "in BROTLI"),
        ({"row_group_size": 3}, "the manifest says 16 rows"),
    ],
)
def test_pages_whose_size_no_header_tells_are_refused(
    store: Store, shard: Path, options: dict[str, Any], message: str
) -> None:
    forge(shard, {"interactions.parquet": packed(pq.read_table(shard / "interactions.parquet"), **options)})
    refused(store.interactions, message)


def test_pages_that_unpack_to_more_than_rows_may_take_are_refused_before_that(store: Store, shard: Path) -> None:
    bomb = changed(shard, "joint_positions", [0.0] * 100_000)
    assert len(bomb) < 100_000
    forge(shard, {"interactions.parquet": bomb})
    refused(store.interactions, "unpacks to more than")


def test_a_long_text_that_a_dictionary_repeats_is_refused_before_it_is_repeated(shard: Path) -> None:
    rows = pq.read_table(shard / "interactions.parquet").take(pa.array([0] * 1000))
    names = ("object_id", "object_category", "target_link", "target_joint", "method", "proposer", "fidelity")
    texts = dict.fromkeys(names, "x" * MAX_TEXT)
    for name, text in (texts | {"joint_names": "x" * MAX_JOINT_NAMES}).items():
        index = rows.schema.get_field_index(name)
        field = rows.schema.field(index)
        rows = rows.set_column(index, field, pa.array([text] * len(rows), field.type))
    assert len(packed(rows)) < 300_000
    refused(lambda: read_table(packed(rows), INTERACTION_COLUMNS, 1000, "rows"), "unpacks to")


def test_a_footer_that_claims_gigabytes_is_refused(store: Store, shard: Path) -> None:
    data = (shard / "interactions.parquet").read_bytes()
    forge(shard, {"interactions.parquet": data[:-8] + (2**31 - 1).to_bytes(4, "little") + b"PAR1"})
    refused(store.interactions, "a footer of more than")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("observations", 2**62, "more or fewer rows"),
        ("interactions", -1, "more or fewer rows"),
        ("observations", 2, "add up"),
        ("first_observation", 5, "follow each other"),
        ("rollout", 5, "follow each other"),
        ("status", "splendid", "column status holds 'splendid'"),
    ],
)
def test_rollouts_that_do_not_fit_the_shard_are_refused(
    store: Store, shard: Path, name: str, value: Any, message: str
) -> None:
    forge(shard, {"rollouts.parquet": changed(shard, name, value, "rollouts.parquet")})
    refused(store.rollouts, message)
    assert verify(store)


@pytest.mark.parametrize(("name", "value"), [("outcome", "splendid"), ("motion", float("nan"))])
def test_a_learner_is_given_no_rows_that_are_no_records(store: Store, shard: Path, name: str, value: Any) -> None:
    forge(shard, {"interactions.parquet": changed(shard, name, value)})
    refused(lambda: load_dataset(store, NetworkConfig()), f"column {name} holds")


@pytest.mark.parametrize(
    "text", [b'{"a": [' + b"{}," * MAX_VALUES + b"{}]}", b"[" * 50_000, b'{"a":' * 50_000, b'{"a": 1, "a": 2}']
)
def test_documents_that_are_too_large_or_too_deep_or_ambiguous_are_refused(text: bytes) -> None:
    refused(lambda: parse_object(text, "manifest", unique=True), "manifest: (holds more|not valid JSON)")


def test_chunks_of_rubbish_are_refused(store: Store, shard: Path) -> None:
    name = f"{CLOUDS}/points/c.0.0.0"
    data = (shard / name).read_bytes()
    forge(shard, {name: data[:16] + bytes(len(data) - 16)})
    refused(lambda: store.read_observations(shard.name), "cannot be decoded")
    forge(shard, {name: b""})
    refused(lambda: store.read_observations(shard.name), "claims another size")


def test_links_are_not_followed(store: Store, shard: Path, tmp_path: Path) -> None:
    shutil.move(shard / CLOUDS, tmp_path / "elsewhere")
    (shard / CLOUDS).symlink_to(tmp_path / "elsewhere")
    refused(lambda: store.read_observations(shard.name), "symbolic link")
    shutil.move(shard / "rollouts.parquet", tmp_path / "rollouts.parquet")
    (shard / "rollouts.parquet").symlink_to(tmp_path / "rollouts.parquet")
    refused(store.rollouts, "cannot be read")


def test_a_hostile_policy_is_refused(store: Store) -> None:
    folder = store.path / "policies" / "000001"
    index = without_checksum((folder / "index.json").read_bytes(), "index")
    entry = index["files"]["policy.json"]
    for files in ({"../../store.json": entry}, {"policy.json": entry | {"size": 2**40}}, {"policy.json": {"size": 2}}):
        (folder / "index.json").write_bytes(with_checksum(index | {"files": files}))
        refused(lambda: store.read_policy(1), "index.json")
    (folder / "index.json").write_bytes(with_checksum(index | {"version": 2}))
    refused(lambda: store.read_policy(1), "not the index of policy 1")


def test_problems_are_single_lines(store: Store, shard: Path) -> None:
    for path in shard.rglob("*"):
        if path.is_file():
            path.write_bytes(b"\n\n")
    problems = verify(store)
    assert problems
    assert all("\n" not in problem.what and dataclasses.is_dataclass(problem) for problem in problems)
