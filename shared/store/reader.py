"""Reading of shards, which are untrusted until sizes, checksums, schemas and references have been checked."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import islice
from typing import Any, TypeVar

import numpy as np
from pydantic_core import from_json

from shared.errors import StoreError
from shared.plan import InteractionRecord, Job, ObjectRef, RolloutRecord, RolloutStatus
from shared.store.backends.base import Folder, StorageBackend
from shared.store.codecs import observations
from shared.store.codecs.columns import INTERACTION_COLUMNS, MAX_TEXT, ROLLOUT_COLUMNS, added_in, hidden_names
from shared.store.codecs.observations import ObservationArrays
from shared.store.codecs.tables import column_values, read_table, size_limit, unknown_columns, with_added
from shared.store.coverage import ROLLOUT_COLUMN, Part
from shared.store.layout import (
    INTERACTIONS_FILE,
    MANIFEST_FILE,
    MAX_DOCUMENT_BYTES,
    OBSERVATIONS_FOLDER,
    ROLLOUTS_FILE,
    SHARDS_FOLDER,
    ShardManifest,
    parse_manifest,
    parse_shard_id,
)
from shared.store.validity import MAX_PARTS, check_quarantined, check_rollouts
from shared.types import Action, Direction, HiddenDynamics, Observation, Order, Outcome, OutcomeKind, Role

Item = TypeVar("Item")

_COUNTING = ("observations", "interactions", "first_observation", ROLLOUT_COLUMN)
"""Columns of rollouts that say which rows of the shard are theirs."""
_BATCH = 128
"""Shards whose manifests or tables are in memory at once."""


def shard_folder(backend: StorageBackend, shard_id: str) -> Folder:
    """The folder of a shard, which need not exist."""
    return Folder(backend, f"{SHARDS_FOLDER}/{shard_id}")


def is_committed(shard: Folder) -> bool:
    """Whether a shard's folder holds a manifest."""
    return shard.has(MANIFEST_FILE)


def named_jobs(backend: StorageBackend, plan_key: str | None = None) -> Iterator[Job]:
    """The jobs of all shard folders, committed or not, sorted by name."""
    for name in backend.names(SHARDS_FOLDER):
        job = parse_shard_id(name)
        if job is not None and plan_key in (None, job.plan_key):
            yield job


def committed_jobs(backend: StorageBackend, plan_key: str | None = None) -> list[Job]:
    """The jobs of all committed shards, sorted by name; no manifest is read."""
    found = []
    for jobs in _batches(named_jobs(backend, plan_key)):
        there = backend.exist([f"{SHARDS_FOLDER}/{job.shard_id}/{MANIFEST_FILE}" for job in jobs])
        found += [job for job, is_there in zip(jobs, there, strict=True) if is_there]
    return found


def read_manifests(backend: StorageBackend, jobs: Iterable[Job]) -> Iterator[ShardManifest]:
    """The manifests of some committed shards, in their order; a bucket gives several at once.

    Raises:
        StoreError: one is damaged, foreign, of another schema version, or another shard's.
    """
    for batch in _batches(jobs):
        shards = [shard_folder(backend, job.shard_id) for job in batch]
        contents = backend.read_all([(f"{shard.key}/{MANIFEST_FILE}", MAX_DOCUMENT_BYTES) for shard in shards])
        for shard, data in zip(shards, contents, strict=True):
            yield checked_manifest(shard, data)


def read_manifest(shard: Folder) -> ShardManifest:
    """The manifest of a shard; raises as `checked_manifest` does."""
    return checked_manifest(shard, shard.read(MANIFEST_FILE, MAX_DOCUMENT_BYTES))


def checked_manifest(shard: Folder, data: bytes) -> ShardManifest:
    """The manifest of a shard, from untrusted bytes.

    Raises:
        StoreError: it is damaged, foreign, of another schema version, or another shard's.
    """
    path = f"{shard}/{MANIFEST_FILE}"
    manifest = parse_manifest(data, path)
    if manifest.shard_id != shard.name:
        raise StoreError(f"{path}: belongs to shard {manifest.shard_id}; put the folder back under its own name")
    expected = expected_files(manifest)
    if manifest.files.keys() != expected.keys():
        odd = sorted(manifest.files.keys() ^ expected.keys())[0]
        raise StoreError(f"{path}: lists other files than a shard of this size has ({odd[:80]!r}); it is foreign")
    for name, entry in manifest.files.items():
        if entry.size > expected[name]:
            raise StoreError(f"{path}: claims {entry.size} bytes for {name}, at most {expected[name]} are possible")
    return manifest


def expected_files(manifest: ShardManifest) -> dict[str, int]:
    """Paths of all files that the shard must have, and the most bytes each may have, from the counts alone."""
    clouds = observations.file_limits(manifest.observations, manifest.points, manifest.depth_size)
    return {
        ROLLOUTS_FILE: size_limit(manifest.rollouts),
        INTERACTIONS_FILE: size_limit(manifest.interactions),
        **{f"{OBSERVATIONS_FOLDER}/{name}": limit for name, limit in clouds},
    }


def read_file(shard: Folder, manifest: ShardManifest, name: str) -> bytes:
    """A file of a shard, of the size and checksum that the manifest states.

    Raises:
        StoreError: it is missing, or is not what was committed.
    """
    return _checked(shard, manifest, name, shard.read(name, manifest.files[name].size))


def read_files(shard: Folder, manifest: ShardManifest) -> dict[str, bytes]:
    """All files of a shard but its manifest, by path within it; raises as `read_file` does."""
    return dict(zip(manifest.files, _read_files(shard, manifest, list(manifest.files)), strict=True))


def _read_files(shard: Folder, manifest: ShardManifest, names: Sequence[str]) -> Iterator[bytes]:
    contents = shard.read_all([(name, manifest.files[name].size) for name in names])
    return (_checked(shard, manifest, name, data) for name, data in zip(names, contents, strict=True))


def _checked(shard: Folder, manifest: ShardManifest, name: str, data: bytes) -> bytes:
    path, entry = f"{shard}/{name}", manifest.files[name]
    if len(data) != entry.size:
        raise StoreError(f"{path}: has {len(data)} bytes, the manifest says {entry.size}; restore it from a copy")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise StoreError(f"{path}: its SHA-256 is not the manifest's; the file is damaged: restore it from a copy")
    return data


def read_interactions(shard: Folder, manifest: ShardManifest) -> Any:
    """The table of a shard's interactions."""
    return _table(shard, manifest, INTERACTIONS_FILE, read_file(shard, manifest, INTERACTIONS_FILE))


def read_rollout_table(shard: Folder, manifest: ShardManifest) -> Any:
    """The table of a shard's rollouts."""
    return _table(shard, manifest, ROLLOUTS_FILE, read_file(shard, manifest, ROLLOUTS_FILE))


def read_tables(
    backend: StorageBackend, parts: Iterable[Part], file: str, names: Sequence[str] | None = None
) -> Iterator[tuple[Part, ShardManifest, Any]]:
    """One of the two tables of many shards, with the rows that count; a bucket gives several at once.

    Args:
        backend: of the store.
        parts: what counts of which shard.
        file: which table.
        names: read these columns only.

    Raises:
        StoreError: a file is damaged or foreign.
    """
    for batch in _batches(parts):
        manifests = list(read_manifests(backend, [part.shard for part in batch]))
        shards = [shard_folder(backend, manifest.shard_id) for manifest in manifests]
        wanted = [(f"{shard.key}/{file}", m.files[file].size) for shard, m in zip(shards, manifests, strict=True)]
        for part, shard, manifest, data in zip(batch, shards, manifests, backend.read_all(wanted), strict=True):
            read = names if names is None or part.is_whole else list(dict.fromkeys([*names, ROLLOUT_COLUMN]))
            table = part.of(_table(shard, manifest, file, _checked(shard, manifest, file, data), read))
            yield part, manifest, table if names is None else table.select(list(names))


def _table(shard: Folder, manifest: ShardManifest, file: str, data: bytes, names: Sequence[str] | None = None) -> Any:
    """One of the two tables of a shard, whose figures are those of its manifest."""
    source = f"{shard}/{file}"
    if file == INTERACTIONS_FILE:
        table = read_table(data, INTERACTION_COLUMNS, manifest.interactions, source, names)
        _check_interactions(table, source, manifest)
        return table
    # What counts the rest is read always, since it is checked.
    read = None if names is None else list(dict.fromkeys([*names, *_COUNTING]))
    table = read_table(data, ROLLOUT_COLUMNS, manifest.rollouts, source, read)
    _check_rollouts(table, source, manifest)
    return table if names is None else table.select(list(names))


def _check_interactions(table: Any, source: str, manifest: ShardManifest) -> None:
    """Check that the references of a shard's interactions lead to what the shard has."""
    ranges = {
        "rollout": (manifest.start, manifest.stop),
        "observation": (0, manifest.observations),
        "point_index": (0, manifest.points),
        "target_part": (1, MAX_PARTS + 1),
    }
    for name, (low, high) in ranges.items():
        if name not in table.column_names or not len(table):
            continue
        numbers = table.column(name).to_numpy()
        if numbers.min() < low or numbers.max() >= high:
            raise StoreError(
                f"{source}: column {name} goes from {numbers.min()} to {numbers.max()}, the manifest allows {low} to "
                f"{high - 1}; the file is foreign"
            )


def _check_rollouts(table: Any, source: str, manifest: ShardManifest) -> None:
    """Check that the rollouts of a shard add up to what the manifest says."""
    clouds, tries, firsts, numbers = (table.column(name).to_numpy() for name in _COUNTING)
    most = max(manifest.observations, manifest.interactions)
    if min(clouds.min(), tries.min()) < 0 or max(clouds.max(), tries.max()) > most:
        raise StoreError(f"{source}: a rollout has more or fewer rows than the shard; it is foreign")
    if (clouds.sum(), tries.sum()) != (manifest.observations, manifest.interactions):
        raise StoreError(f"{source}: the rollouts do not add up to the shard's rows and observations; it is foreign")
    if (firsts != np.cumsum(clouds) - clouds).any() or (numbers != np.arange(manifest.start, manifest.stop)).any():
        raise StoreError(f"{source}: the rollouts do not follow each other; it is foreign")


def unknown_of(shard: Folder, manifest: ShardManifest) -> dict[str, Any]:
    """What the two tables hold that this software does not know, by file; see `tables.unknown_columns`."""
    return {
        ROLLOUTS_FILE: unknown_columns(read_rollout_table(shard, manifest), ROLLOUT_COLUMNS, ROLLOUT_COLUMN),
        INTERACTIONS_FILE: unknown_columns(read_interactions(shard, manifest), INTERACTION_COLUMNS, ROLLOUT_COLUMN),
    }


def read_observations(shard: Folder, manifest: ShardManifest) -> ObservationArrays:
    """All clouds of a shard."""
    prefix = f"{OBSERVATIONS_FOLDER}/"
    names = [name for name in manifest.files if name.startswith(prefix)]
    contents = _read_files(shard, manifest, names)
    files = {name.removeprefix(prefix): data for name, data in zip(names, contents, strict=True)}
    sizes = (manifest.observations, manifest.points, manifest.depth_size)
    return observations.decode(files, *sizes, f"{shard}/{OBSERVATIONS_FOLDER}")


def read_rollouts(shard: Folder, manifest: ShardManifest) -> tuple[RolloutRecord, ...]:
    """The records of a shard, bit for bit as they were committed.

    Raises:
        StoreError: a file is damaged or foreign, or a row breaks the rules of a record.
    """
    table = read_rollout_table(shard, manifest)
    heads = _rows(table, with_added(ROLLOUT_COLUMNS, table.column_names))
    rows = _rows(read_interactions(shard, manifest), INTERACTION_COLUMNS)
    arrays = read_observations(shard, manifest)
    rollouts, row = [], 0
    try:
        for head in heads:
            first, clouds, tries = (int(head[name]) for name in ("first_observation", "observations", "interactions"))
            seen = tuple(arrays.observation(k) for k in range(first, first + clouds))
            rollouts.append(_rollout(head, seen, rows[row : row + tries]))
            row += tries
    except ValueError as error:
        line = " ".join(str(error).split())[:120]
        raise StoreError(f"{shard}: a row is not a record ({line}); the file is foreign") from None
    job = Job(manifest.plan_key, manifest.start, manifest.stop)
    check_rollouts(rollouts, job, manifest.points, str(shard))
    check_quarantined(rollouts, manifest.quarantined, str(shard))
    return tuple(rollouts)


def _batches(items: Iterable[Item]) -> Iterator[list[Item]]:
    """Lists of at most `_BATCH` of some items."""
    left = iter(items)
    while batch := list(islice(left, _BATCH)):
        yield batch


def _rows(table: Any, columns: Sequence[Any]) -> list[dict[str, Any]]:
    names = [column.name for column in columns]
    values = [column_values(table, column) for column in columns]
    return [dict(zip(names, cells, strict=True)) for cells in zip(*values, strict=True)]


def _rollout(
    head: dict[str, Any], observations: tuple[Observation, ...], rows: Sequence[dict[str, Any]]
) -> RolloutRecord:
    return RolloutRecord(
        index=int(head["rollout"]),
        plan_key=head["plan_key"],
        object=ObjectRef(id=head["object_id"], category=head["object_category"], content_hash=head["object_hash"]),
        dynamics=HiddenDynamics(
            {name: float(head[column]) for name, column in hidden_names(added_in(list(head))).items()},
            Direction(head["direction"]),
        ),
        azimuth_deg=float(head["azimuth_deg"]),
        elevation_deg=float(head["elevation_deg"]),
        seed=int(head["seed"]),
        fidelity=head["fidelity"],
        status=RolloutStatus(head["status"]),
        observations=observations,
        interactions=tuple(_interaction(row) for row in rows),
        arm_base=tuple(head["arm_base"].tolist()),
    )


def _interaction(row: dict[str, Any]) -> InteractionRecord:
    return InteractionRecord(
        step=int(row["step"]),
        observation=int(row["rollout_observation"]),
        action=Action(point_index=int(row["point_index"]), point=row["point"], rotation=row["rotation"].reshape(3, 3)),
        outcome=Outcome(
            kind=OutcomeKind(row["outcome"]),
            motion=float(row["motion"]),
            success=bool(row["success"]),
            start_joint_position=float(row["start_joint_position"]),
            end_joint_position=float(row["end_joint_position"]),
            displacement=row["displacement"],
            grasp_opening=float(row["grasp_opening"]),
            steps=int(row["steps"]),
        ),
        normal=row["normal"],
        primitive=row["primitive"],
        order=Order(row["order"]),
        role=Role(row["role"]),
        proposer=row["proposer"],
        policy_version=int(row["policy_version"]),
        method=row["method"],
        budget=int(row["budget"]),
        target_part=int(row["target_part"]),
        target_link=row["target_link"],
        target_joint=row["target_joint"],
        joint_names=_joint_names(row["joint_names"]),
        joint_positions=row["joint_positions"],
        joint_limits=row["joint_limits"].reshape(-1, 2),
        joint_twist=row["joint_twist"],
        hand_start=row["hand_start"],
        seconds=float(row["seconds"]),
    )


@lru_cache(maxsize=1024)
def _joint_names(text: str) -> tuple[str, ...]:
    """The names in a cell; a store has few different ones.

    Raises:
        ValueError: it is no list of names.
    """
    names = from_json(text)
    if not isinstance(names, list) or not all(isinstance(name, str) and len(name) <= MAX_TEXT for name in names):
        raise ValueError(f"joint_names is no list of names: {text[:40]!r}")
    return tuple(names)
