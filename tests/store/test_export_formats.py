"""Formats of `store export`: each is read back without the code that wrote it, and compared with the records."""

import dataclasses
import importlib.util
import io
import itertools
import json
import socket
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from cluster.cli.main import run
from shared.errors import StoreError, UsageError
from shared.io.files import exclusive_lock
from shared.plan import InteractionRecord, Job, Plan, RolloutRecord
from shared.store import Store, export
from shared.store.maintenance import destinations
from shared.store.maintenance.datacard import SplitFigures, size_category
from shared.store.maintenance.formats import EXPORT_FORMATS, word
from shared.store.maintenance.steps import Content, survey
from tests.support.fabricate import fabricate_rollout, fabricate_setting
from tests.support.faults import Fault, disk_faults
from tests.support.killed_writers import kill_while_writing
from tests.support.synced import Synced

SETTING = fabricate_setting(objects=3, points=64)
PLANS = Plan(setting=SETTING), Plan(setting=SETTING, proposer="aip", policy_version=1)
SPLITS = {"train": frozenset({"object-0", "object-2"}), "test": frozenset({"object-1"})}
CLOUDS = {
    "observation.points": "points",
    "observation.normals": "normals",
    "observation.movable": "movable",
    "observation.part_ids": "part_ids",
    "observation.camera": "world_from_camera",
}
Row = dict[str, Any]
"""A step: its columns by name."""
Rows = dict[str, list[Row]]
"""Of each split."""


def make(where: Path) -> Store:
    """A store of several shards and two plans, one rollout of which has no interaction."""
    store = Store.create(where, SETTING)
    for plan, starts in zip(PLANS, ((0, 3, 7, 9), (0, 4)), strict=True):
        for start, stop in itertools.pairwise(starts):
            sizes = [0 if index == 1 else 3 for index in range(start, stop)]
            rollouts = [fabricate_rollout(plan, start + k, size, 2) for k, size in enumerate(sizes)]
            store.commit(plan, Job(plan.key, start, stop), rollouts, {})
    return store


def columns_of(rollout: RolloutRecord, each: InteractionRecord) -> Row:
    """What a row must hold, as far as it comes from the records and not from the columns of the store."""
    seen = rollout.observations[each.observation]
    return {
        **{name: getattr(seen, field) for name, field in CLOUDS.items()},
        "action.point": each.action.point,
        "action.approach": each.action.approach,
        "action.forward": each.action.forward,
        "rotation": each.action.rotation.ravel(),
        "plan_key": rollout.plan_key,
        "rollout": rollout.index,
        "step": each.step,
        "object_id": rollout.object.id,
        "object_category": rollout.object.category,
        "part_mass": rollout.dynamics["part_mass"],
        "joint_friction": rollout.dynamics["joint_friction"],
        "surface_friction": rollout.dynamics["surface_friction"],
        "direction": str(rollout.dynamics.direction),
        "primitive": each.primitive,
        "proposer": each.proposer,
        "policy_version": each.policy_version,
        "outcome": str(each.outcome.kind),
        "success": each.outcome.success,
        "motion": each.outcome.motion,
        "displacement": each.outcome.displacement,
        "joint_positions": each.joint_positions,
    }


def expected(store: Store) -> Rows:
    """The rows of each split, from the records of the store."""
    rows: Rows = {}
    for split, objects in SPLITS.items():
        rollouts = [rollout for part in store.parts() for rollout in store.rollouts_of(part)]
        kept = [rollout for rollout in rollouts if rollout.object.id in objects and rollout.interactions]
        rows[split] = [
            columns_of(rollout, each) | {"episode_index": episode, "frame_index": frame}
            for episode, rollout in enumerate(kept)
            for frame, each in enumerate(rollout.interactions)
        ]
    return rows


def rows_of(table: Any) -> list[Row]:
    """The rows of a Parquet file."""
    columns = {name: table.column(name).to_pylist() for name in table.column_names}
    return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]


def read_hf(out: Path) -> Rows:
    return {
        split: [row for f in sorted(out.glob(f"data/{split}-*")) for row in rows_of(pq.read_table(f))]
        for split in SPLITS
    }


def read_lerobot(out: Path) -> Rows:
    frames = [row for path in sorted(out.glob("data/*/*")) for row in rows_of(pq.read_table(path))]
    rows: Rows = {}
    for split, span in json.loads((out / "meta/info.json").read_text())["splits"].items():
        first, stop = map(int, span.split(":"))
        mine = [row for row in frames if first <= row["episode_index"] < stop]
        rows[split] = [row | {"episode_index": row["episode_index"] - first} for row in mine]
    return rows


def read_webdataset(out: Path) -> Rows:
    rows: Rows = {split: [] for split in SPLITS}
    for split in SPLITS:
        for path in sorted(out.glob(f"{split}-*.tar")):
            with tarfile.open(path) as tar:
                members = [(member.name, tar.extractfile(member).read()) for member in tar]  # type: ignore[union-attr]
            for key, files in itertools.groupby(members, lambda member: member[0].partition(".")[0]):
                found = {name.partition(".")[2]: data for name, data in files}
                row = json.loads(found.pop("json"))
                assert key == f"{row['plan_key']}-{row['rollout']:08d}-{row['step']:03d}"
                arrays = {f"observation.{name[:-4]}": np.load(io.BytesIO(data)) for name, data in found.items()}
                row["displacement"] = [np.nan if each is None else each for each in row["displacement"]]
                rows[split].append(row | arrays)
    return rows


def read_minari(out: Path) -> Rows:
    rows: Rows = {split: [] for split in SPLITS}
    for split in SPLITS:
        data = out / f"adaafford/push-{split}-v0/data"
        told = json.loads((data / "metadata.json").read_text())
        assert told["dataset_id"] == f"adaafford/push-{split}-v0"
        spaces = json.loads(told["observation_space"])["subspaces"]
        for number in range(told["total_episodes"]):
            steps = json.loads((data / str(number) / "metadata.json").read_text())["total_steps"]
            found = pq.read_table(data / str(number) / "part-0.parquet").to_pylist()
            assert [row["truncations"] for row in found] == [False] * (steps - 1) + [True, False]
            assert found[-1]["observations"] == found[-2]["observations"]
            for row in found[:steps]:
                assert row["rewards"] == row["infos"]["success"]
                seen = {name: np.reshape(row["observations"][name], box["shape"]) for name, box in spaces.items()}
                acted = {f"action.{name}": each for name, each in row["actions"].items()}
                rows[split].append({f"observation.{name}": each for name, each in seen.items()} | acted | row["infos"])
        assert told["total_steps"] == len(rows[split])
    return rows


READERS: dict[str, Callable[[Path], Rows]] = {
    "hf": read_hf,
    "lerobot": read_lerobot,
    "webdataset": read_webdataset,
    "minari": read_minari,
}
LACKING = {"lerobot": ("action.point", "action.approach", "action.forward", "joint_positions")}
"""Columns that a format has in another form, or not at all."""


def same(found: Any, wanted: Any) -> bool:
    """Whether a cell holds a value, bit for bit; readers without numpy give lists, and JSON has null for NaN."""
    if isinstance(wanted, np.ndarray):
        numbers = np.array(found, dtype=wanted.dtype)
        return bool(numbers.shape == wanted.shape and numbers.tobytes() == wanted.tobytes())
    return bool(found == wanted)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return make(tmp_path_factory.mktemp("formats") / "store")


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A piece ends with each shard, and a table with each row."""
    monkeypatch.setattr(Content, "step_bytes", property(lambda content: 1 << 40))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("small", [False, True])
def test_what_is_read_back_is_what_the_store_holds(
    name: str, small: bool, store: Store, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if small:
        request.getfixturevalue("small_pieces")
    done = export(store, tmp_path / "out", SPLITS, format=name)
    found, wanted = READERS[name](tmp_path / "out"), expected(store)
    for split in SPLITS:
        assert len(found[split]) == len(wanted[split]) == done.splits[split].interactions
        for row, other in zip(found[split], wanted[split], strict=True):
            kept = [column for column in other if column not in LACKING.get(name, ())]
            wrong = [column for column in kept if not same(row[column], other[column])]
            assert not wrong, (split, wrong, row[wrong[0]], other[wrong[0]])


def test_hf_files_are_numbered_and_their_clouds_are_fixed_size_lists(
    store: Store, tmp_path: Path, small_pieces: None
) -> None:
    export(store, tmp_path / "out", SPLITS, format="hf")
    files = sorted(path.name for path in (tmp_path / "out/data").iterdir())
    assert files[0] == "test-00000-of-00002.parquet"
    assert len([name for name in files if name.startswith("train-")]) == 4
    schema = pq.read_schema(tmp_path / "out/data" / files[0])
    three = schema.field("observation.points").type
    assert (three.list_size, three.value_type.list_size, three.value_type.value_type) == (64, 3, pa.float32())
    assert all(field.metadata[b"description"] for field in schema)
    wanted = {name for name in store.interactions().column_names if name not in ("observation", "point", "shard")}
    assert wanted < set(schema.names)


def test_names_of_a_foreign_store_lead_no_file_out_of_the_export() -> None:
    for text in ("../../home", "/etc/passwd", "a b\n", "push"):
        assert set(word(text)) <= set("abcdefghijklmnopqrstuvwxyz-")


def test_tar_files_say_nothing_of_their_writer(store: Store, tmp_path: Path) -> None:
    export(store, tmp_path / "out", SPLITS, format="webdataset")
    with tarfile.open(tmp_path / "out/train-000000.tar") as tar:
        assert {(each.uid, each.gid, each.uname, each.gname, each.mtime) for each in tar} == {(0, 0, "", "", 0)}


@pytest.mark.usefixtures("small_pieces")
def test_lerobot_frames_follow_its_rules(store: Store, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(store, out, SPLITS, format="lerobot")
    info = json.loads((out / "meta/info.json").read_text())
    files = sorted(out.glob("data/*/*"))
    assert [f"{path.parent.name}/{path.name}" for path in files] == [
        *(f"chunk-000/file-00{k}.parquet" for k in range(4)),
        *(f"chunk-001/file-00{k}.parquet" for k in range(2)),
    ]
    assert [path.relative_to(out / "meta/episodes") for path in sorted(out.glob("meta/episodes/*/*"))] == [
        path.relative_to(out / "data") for path in files
    ]
    wanted = [row for rows in expected(store).values() for row in rows]
    frames = [row for path in files for row in rows_of(pq.read_table(path))]
    assert info["total_frames"] == len(frames) == len(wanted)
    assert [row["index"] for row in frames] == list(range(len(frames)))
    assert [row["timestamp"] for row in frames] == [row["frame_index"] for row in wanted]
    assert [row["next.success"] for row in frames] == [row["success"] for row in wanted]
    for row, other in zip(frames, wanted, strict=True):
        parts = [other[f"action.{name}"] for name in ("point", "approach", "forward")]
        assert same(row["action"], np.concatenate(parts).astype(np.float32))
    check_lerobot_features(info, pq.read_schema(files[0]))
    check_lerobot_episodes(out, info, frames)
    stats = json.loads((out / "meta/stats.json").read_text())
    points = np.array([row["observation.points"] for row in wanted], np.float64).reshape(-1, 3)
    assert np.allclose(stats["observation.points"]["mean"], points.mean(axis=0))
    assert np.allclose(stats["observation.points"]["std"], points.std(axis=0))
    assert stats["observation.points"]["max"] == points.max(axis=0).tolist()
    moved = np.array([row["displacement"] for row in wanted])
    assert np.allclose(stats["displacement"]["mean"], np.nanmean(moved, axis=0)), "NaN is left out"
    assert stats["success"]["count"] == [len(frames)]


def check_lerobot_features(info: dict[str, Any], schema: Any) -> None:
    assert list(info["features"]) == schema.names
    for field in schema:
        kind, shape = field.type, []
        while pa.types.is_fixed_size_list(kind):
            shape.append(kind.list_size)
            kind = kind.value_type
        assert info["features"][field.name]["shape"] == (shape or [1])
        dtype = info["features"][field.name]["dtype"]
        assert (pa.string() if dtype == "string" else pa.from_numpy_dtype(np.dtype(dtype))) == kind


def check_lerobot_episodes(out: Path, info: dict[str, Any], frames: list[Row]) -> None:
    episodes = [row for path in sorted(out.glob("meta/episodes/*/*")) for row in rows_of(pq.read_table(path))]
    assert [row["episode_index"] for row in episodes] == list(range(info["total_episodes"]))
    for row in episodes:
        mine = frames[row["dataset_from_index"] : row["dataset_to_index"]]
        assert {each["episode_index"] for each in mine} == {row["episode_index"]}
        assert [each["next.done"] for each in mine] == [False] * (row["length"] - 1) + [True]
        numbers = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        there = pq.read_table(out / info["data_path"].format(**numbers)).column("index").to_pylist()
        assert {each["index"] for each in mine} <= set(there)
    tasks = pq.read_table(out / "meta/tasks.parquet")
    index = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]
    assert [tasks.column(name).to_pylist() for name in ("task_index", *index)] == [[0], ["push"]]
    assert episodes[0]["tasks"] == ["push"]


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
@pytest.mark.usefixtures("small_pieces")
def test_an_export_that_was_stopped_goes_on(name: str, store: Store, tmp_path: Path) -> None:
    export(store, tmp_path / "whole", SPLITS, format=name)
    wanted = contents(tmp_path / "whole")
    out, said = tmp_path / "out", list[tuple[int, int]]()

    def stop(done: int, total: int) -> None:
        said.append((done, total))
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(store, out, SPLITS, stop, format=name)
    assert not out.exists()
    before = len(said)
    assert export(store, out, SPLITS, lambda *counts: said.append(counts), format=name).out == str(out)
    assert contents(out) == wanted
    assert not out.with_name("out.unfinished").exists()
    written = [done for done, total in said[before:] if total == said[before - 1][1]]
    assert len(written) < before - 5, "pieces that were finished are not written again"


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
def test_an_export_that_has_its_name_survives_a_power_cut(
    name: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = Synced(monkeypatch)
    export(store, tmp_path / "out", SPLITS, format=name)
    assert synced.lacks(tmp_path / "out") == []


def test_an_export_that_has_all_but_its_name_is_not_written_again(store: Store, tmp_path: Path) -> None:
    with disk_faults(Fault("ENOSPC", 0)) as steps:
        export(store, tmp_path / "whole", SPLITS, format="hf")
    last = max(number for number, step in enumerate(steps, 1) if step == "rename")
    with disk_faults(Fault("ENOSPC", last)), pytest.raises(UsageError, match="No space left on device"):
        export(store, tmp_path / "out", SPLITS, format="hf")
    said = list[tuple[int, int]]()
    export(store, tmp_path / "out", SPLITS, lambda *counts: said.append(counts), format="hf")
    assert len(said) == len(store.parts()), "each shard was looked through, and none was written"
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_an_export_that_was_stopped_with_its_notes_in_it_goes_on(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    export(store, tmp_path / "whole", SPLITS, format="hf")
    remove = destinations.remove_tree

    def stop(path: Path) -> None:
        if path == out / destinations.NOTES:
            raise KeyboardInterrupt
        remove(path)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(destinations, "remove_tree", stop)
        export(store, out, SPLITS, format="hf")
    assert (out / destinations.NOTES).is_dir()
    with pytest.raises(UsageError, match="is there already"):
        export(store, out, SPLITS, format="plain")
    export(store, out, SPLITS, format="hf")
    assert contents(out) == contents(tmp_path / "whole")


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
def test_a_complete_export_is_left_as_it_is_by_the_same_command_alone(name: str, store: Store, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = export(store, out, SPLITS, format=name)
    before, times = contents(out), [path.stat().st_mtime_ns for path in sorted(out.rglob("*"))]
    assert export(store, out, SPLITS, format=name) == done
    assert [path.stat().st_mtime_ns for path in sorted(out.rglob("*"))] == times
    others = ((SPLITS, "plain" if name == "hf" else "hf"), ({"train": SPLITS["train"]}, name))
    for splits, format_ in others:
        with pytest.raises(UsageError, match="is there already; name a new folder"):
            export(store, out, splits, format=format_)
    assert contents(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def contents(out: Path) -> dict[str, bytes]:
    """All files; Zarr's metadata say nothing of time."""
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}


def test_an_export_begins_anew_where_the_store_or_the_command_is_another(store: Store, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == total:
            raise KeyboardInterrupt

    for splits, name in ((SPLITS, "plain"), ({"train": SPLITS["train"]}, "hf")):
        with pytest.raises(KeyboardInterrupt):
            export(store, tmp_path / "out", splits, stop, format=name)
    export(store, tmp_path / "out", SPLITS, format="hf")
    export(store, tmp_path / "whole", SPLITS, format="hf")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_what_others_commit_during_an_export_is_in_neither_its_files_nor_its_digest(tmp_path: Path) -> None:
    growing = make(tmp_path / "growing")
    before, steps = growing.digest(), len(growing.interactions())

    def commit_another(done: int, total: int) -> None:
        job = Job(PLANS[1].key, 4, 6)
        if not growing.holds(job):
            growing.commit(PLANS[1], job, [fabricate_rollout(PLANS[1], index, 3, 2) for index in (4, 5)], {})

    content = survey(growing, SPLITS, commit_another)
    assert growing.digest() != before
    assert content.digest == before
    assert sum(piece.steps for piece in content.pieces(None)) == steps


def test_a_file_that_was_lost_of_an_unfinished_export_is_written_again(
    store: Store, tmp_path: Path, small_pieces: None
) -> None:
    def stop(done: int, total: int) -> None:
        if done == total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(store, tmp_path / "out", SPLITS, stop, format="hf")
    first = tmp_path / "out.unfinished/data/train-00000-of-00004.parquet"
    first.write_bytes(first.read_bytes()[:99])
    (tmp_path / "out.unfinished/.export/1.json").write_text("{")
    left = kill_while_writing(tmp_path / "out.unfinished/README.md")
    export(store, tmp_path / "out", SPLITS, format="hf")
    assert not (tmp_path / "out" / left.name).exists()
    assert sum(map(len, read_hf(tmp_path / "out").values())) == sum(map(len, expected(store).values()))


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
def test_the_card_is_for_programs_too_and_names_no_person_or_machine(
    name: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "somebody-s-machine")
    for variable in ("USER", "LOGNAME", "HOME"):
        monkeypatch.setenv(variable, "/home/somebody")
    export(store, tmp_path / "out", SPLITS, format=name)
    text = (tmp_path / "out/README.md").read_text()
    front = yaml.safe_load(text.split("---\n")[1])
    assert front["size_categories"] == ["n<1K"]
    found = json.loads((tmp_path / "out/croissant.json").read_text())
    for config in front.get("configs", ()):
        assert [each["split"] for each in config["data_files"]] == list(SPLITS)
        globbed = [list((tmp_path / "out").glob(path)) for each in config["data_files"] for path in each["path"]]
        assert all(globbed)
    for records in found["recordSet"]:
        files = next(each for each in found["distribution"] if each["@id"] == records["@id"].split("/")[0])["includes"]
        schema = pq.read_schema(next((tmp_path / "out").glob(files if isinstance(files, str) else files[0])))
        assert [field["source"]["extract"]["column"] for field in records["field"]] == schema.names
    everything = b"".join(contents(tmp_path / "out").values())
    assert not [each for each in ("somebody", str(tmp_path), str(store.path)) if each.encode() in everything]


def test_the_size_of_a_card_is_that_of_the_steps() -> None:
    for steps, said in ((0, "n<1K"), (999, "n<1K"), (1000, "1K<n<10K"), (99_999, "10K<n<100K"), (10**6, "1M<n<10M")):
        figures = dataclasses.replace(SplitFigures.nothing(), interactions=steps)
        assert size_category([figures]) == said


def refused(args: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command was refused with."""
    capsys.readouterr()
    assert run(["store", "export", *args]) == 2
    said = capsys.readouterr().err.splitlines()
    lines = [line for line in said if not line.startswith("exporting into")]
    assert len(lines) == 1, said
    return lines[0]


def test_what_cannot_be_exported_is_refused_in_one_line(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where, out = str(store.path), tmp_path / "out"
    said = refused([where, "--out", str(out), "--format", "../hf"], capsys)
    assert "unknown export format '../hf'; allowed: plain, hf" in said
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("file", "link"):
        assert "is there already" in refused([where, "--out", str(tmp_path / name), "--format", "hf"], capsys)
    assert "Not a directory" in refused([where, "--out", str(tmp_path / "file/out"), "--format", "hf"], capsys)
    (tmp_path / "out.unfinished").mkdir()
    (tmp_path / "out.unfinished/thesis.tex").write_text("mine")
    assert "is no unfinished export" in refused([where, "--out", str(out), "--format", "hf"], capsys)
    assert (tmp_path / "out.unfinished/thesis.tex").read_text() == "mine"
    with pytest.raises(UsageError, match="a name has lower-case letters"):
        export(store, tmp_path / "new", {"../train": SPLITS["train"]}, format="hf")
    with pytest.raises(StoreError, match="'train' has no interaction"):
        export(store, tmp_path / "new", {"train": frozenset()}, format="hf")
    assert not out.exists()
    assert not (tmp_path / "new.unfinished").exists()


def test_two_exports_into_one_folder_do_not_mix(store: Store, tmp_path: Path) -> None:
    notes = tmp_path / "out.unfinished/.export"
    notes.mkdir(parents=True)
    with exclusive_lock(notes / ".lock-driver"), pytest.raises(UsageError, match="is in use by process"):
        export(store, tmp_path / "out", SPLITS, format="hf")


@pytest.mark.parametrize("name", EXPORT_FORMATS.names())
@pytest.mark.parametrize("step", [3, 24])
def test_a_full_disk_ends_an_export_in_one_line_and_it_goes_on(
    name: str, step: int, store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = [str(store.path), "--out", str(tmp_path / "out"), "--format", name]
    with disk_faults(Fault("ENOSPC", step)):
        said = refused(args, capsys)
    assert "cannot be written (No space left on device); what is finished is in" in said
    assert not (tmp_path / "out").exists()
    assert run(["store", "export", *args]) == 0


FAKE_HUB = """
class Answer:
    status_code = 401
class Refused(Exception):
    response = Answer()
class HfApi:
    def __init__(self, endpoint, token):
        assert (endpoint, token) == ("http://127.0.0.1:1", "hf_of_somebody")
    def create_repo(self, *args, **kwargs):
        import os
        if "REFUSE" in os.environ:
            raise Refused("no, hf_of_somebody")
    def upload_folder(self, folder_path, ignore_patterns, **kwargs):
        assert (folder_path / "README.md").is_file()
        assert ignore_patterns == [".export/*"]
"""


def test_what_is_known_before_a_push_is_said_before_the_work(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    args = [str(store.path), "--out", str(tmp_path / "out"), "--format", "hf", "--push"]
    for name in ("data", "me/../data", "me/da ta", "/data", "me/data/x"):
        assert "is no name of a data set; give USER/NAME" in refused([*args, name], capsys)
    if importlib.util.find_spec("huggingface_hub") is None:
        assert "pip install huggingface_hub" in refused([*args, "me/data"], capsys)
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake/huggingface_hub.py").write_text(FAKE_HUB)
    monkeypatch.syspath_prepend(tmp_path / "fake")
    monkeypatch.delitem(sys.modules, "huggingface_hub", raising=False)
    monkeypatch.delenv("HF_TOKEN", raising=False)
    assert "as HF_TOKEN" in refused([*args, "me/data"], capsys)
    assert not (tmp_path / "out.unfinished").exists()
    monkeypatch.setenv("HF_TOKEN", "hf_of_somebody")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:1")
    monkeypatch.setenv("REFUSE", "1")
    said = refused([*args, "me/data"], capsys)
    assert "the Hub answered 401 (the token in HF_TOKEN is not accepted); the same command goes on" in said
    assert not (tmp_path / "out").exists()
    monkeypatch.delenv("REFUSE")
    assert run(["store", "export", *args, "me/data"]) == 0
    assert not (tmp_path / "out/.export").exists()
    sys.modules.pop("huggingface_hub")
